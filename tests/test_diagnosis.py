"""A policy that can give no actions: the env or the parameter is named, whatever K is."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gcr import GCRPPO, RewardSpec
from sb3_gcr.diagnosis import in_plain_words, why_no_actions
from tests.envs import SPEC, Env

ONE = RewardSpec(("only",), (0,))
SMALL: dict[str, Any] = {"n_steps": 32, "batch_size": 16, "n_epochs": 1, "seed": 0, "device": "cpu"}


class Blinded(Env):
    """One number of the observation is spoilt at a step."""

    def __init__(self, spec: RewardSpec, at: int, number: float = np.nan, **kwargs: Any):
        super().__init__(spec, p_end=0.0, limit=10**6, **kwargs)
        self.at, self.number = at, number

    def step(self, action: Any) -> Any:
        observation, *others = super().step(action)
        if self.t == self.at:
            part = observation["a"] if isinstance(observation, dict) else observation
            part[2] = self.number
        return observation, *others


def weights(model: Any) -> th.Tensor:
    return th.cat([parameter.detach().flatten() for parameter in model.policy.parameters()])


def refused(model: Any, message: str, timesteps: int = 64, **kwargs: Any) -> None:
    before = weights(model)
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        model.learn(timesteps, **kwargs)
    assert th.equal(before, weights(model))


def blinded(spec: RewardSpec, number: float, action: str) -> Any:
    """The second of two envs is spoilt at its step 20."""
    return DummyVecEnv(
        [
            lambda: Blinded(spec, 10**9, action=action),
            lambda: Blinded(spec, 20, number, action=action),
        ]
    )


@pytest.mark.parametrize("spec", [ONE, SPEC], ids=["one", "three"])
@pytest.mark.parametrize("action", ["Box", "Discrete", "MultiDiscrete", "MultiBinary"])
def test_nan_in_an_observation_names_env_and_timestep(spec: RewardSpec, action: str) -> None:
    refused(
        GCRPPO("MlpPolicy", blinded(spec, np.nan, action), **SMALL),
        "Env index 1 at timestep 40: the observation must be finite, found nan in "
        "observation[2]. The policy is as it was; VecCheckNan finds where it comes from.",
    )


@pytest.mark.parametrize("spec", [ONE, SPEC], ids=["one", "three"])
@pytest.mark.parametrize("action", ["Box", "Discrete"])
def test_infinity_in_an_observation_names_the_env(spec: RewardSpec, action: str) -> None:
    """tanh makes a number of it, and the gradient NaN."""
    refused(
        GCRPPO("MlpPolicy", blinded(spec, np.inf, action), **SMALL),
        "The rollout's `observations` must be finite, found NaN or infinity for env index 1 before "
        "the update at timestep 64. The policy is as it was; check rewards and observations, e.g. "
        "with VecCheckNan.",
    )


@pytest.mark.parametrize("spec", [ONE, SPEC], ids=["one", "three"])
def test_a_spoilt_observation_in_a_dictionary(spec: RewardSpec) -> None:
    env = DummyVecEnv([lambda: Blinded(spec, 20, observation="Dict")])
    refused(
        GCRPPO("MultiInputPolicy", env, **SMALL),
        "Env index 0 at timestep 20: the observation must be finite, found nan in "
        "observation['a'][2]. The policy is as it was; VecCheckNan finds where it comes from.",
    )


@pytest.mark.parametrize("spec", [ONE, SPEC], ids=["one", "three"])
def test_the_last_observation_of_a_rollout_names_its_env(spec: RewardSpec) -> None:
    """The critic alone has seen it."""
    envs = DummyVecEnv([lambda: Blinded(spec, 10**9), lambda: Blinded(spec, 32)])
    refused(
        GCRPPO("MlpPolicy", envs, **SMALL),
        "The rollout's `advantages` must be finite, found NaN or infinity for env index 1 before "
        "the update at timestep 64. The policy is as it was; check rewards and observations, e.g. "
        "with VecCheckNan.",
    )


@pytest.mark.parametrize("spec", [ONE, SPEC], ids=["one", "three"])
def test_a_deviation_of_zero_names_the_parameter(spec: RewardSpec) -> None:
    kwargs = {"log_std_init": -120.0}
    refused(
        GCRPPO("MlpPolicy", Env(spec), policy_kwargs=kwargs, **SMALL),
        "The policy's standard deviation exp(log_std) must be finite and above 0, found "
        "exp(-120) = 0 for action index 0 at timestep 0. Set `log_std_init` in `policy_kwargs`; a "
        "larger `ent_coef` keeps it from shrinking in training.",
    )


@pytest.mark.parametrize("spec", [ONE, SPEC], ids=["one", "three"])
def test_a_deviation_without_bound_is_named_before_the_update(spec: RewardSpec) -> None:
    kwargs = {"log_std_init": 100.0}
    refused(
        GCRPPO("MlpPolicy", Env(spec), policy_kwargs=kwargs, **SMALL),
        "The rollout's `log_probs` must be finite, found NaN or infinity for env index 0 before "
        "the update at timestep 32. The policy is as it was; check observations and `log_std`, "
        "e.g. with VecCheckNan.",
    )


class Vanish(BaseCallback):
    """Takes away the deviation of the second action behind the rollout."""

    def _on_rollout_end(self) -> None:
        with th.no_grad():
            self.model.policy.log_std[1] = -200.0

    def _on_step(self) -> bool:
        return True


@pytest.mark.parametrize("spec", [ONE, SPEC], ids=["one", "three"])
def test_a_deviation_that_vanishes_before_an_update(spec: RewardSpec) -> None:
    model = GCRPPO("MlpPolicy", Env(spec), gramian_method="passes", **SMALL)
    message = (
        "The policy's standard deviation exp(log_std) must be finite and above 0, found "
        "exp(-200) = 0 for action index 1 at timestep 32. Set `log_std_init` in `policy_kwargs`; "
        "a larger `ent_coef` keeps it from shrinking in training."
    )
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        model.learn(64, callback=Vanish())


@pytest.mark.parametrize("spec", [ONE, SPEC], ids=["one", "three"])
def test_a_weight_that_is_no_number_is_named(spec: RewardSpec) -> None:
    model = GCRPPO("MlpPolicy", Env(spec), **SMALL)
    with th.no_grad():
        model.policy.action_net.bias[1] = th.nan
    message = (
        "The policy's parameter `action_net.bias` must be finite, found nan at timestep 0. A "
        "smaller `learning_rate`, or scaled returns (VecNormalize), may help; go on from an "
        "earlier checkpoint."
    )
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        model.learn(32)


def test_numbers_that_are_too_large_together() -> None:
    model = GCRPPO("MlpPolicy", Env(SPEC), **SMALL)
    message = (
        "The policy must give numbers that make a distribution of actions, found none at timestep "
        "7: observations and weights are finite, but too large together. Scaled observations "
        "(VecNormalize), or a smaller `learning_rate`, may help."
    )
    assert why_no_actions(model.policy, np.full((1, 4), 1e38), 7) == message
    assert why_no_actions(model.policy, None, 7) == message


@pytest.mark.parametrize("spec", [ONE, SPEC], ids=["one", "three"])
def test_errors_of_others_keep_their_words(spec: RewardSpec) -> None:
    class Fails(Env):
        def step(self, action: Any) -> Any:
            raise ValueError("The gripper is open.")

    with pytest.raises(ValueError, match=r"^The gripper is open\.$"):
        GCRPPO("MlpPolicy", Fails(spec), **SMALL).learn(32)
    with pytest.raises(RuntimeError, match=r"^mine$"), in_plain_words(lambda: "not this"):
        raise RuntimeError("mine")
    with pytest.raises(ValueError, match=r"^this$"), in_plain_words(lambda: "this"):
        th.distributions.Normal(th.zeros(1), th.zeros(1))

"""Saving, loading, other envs, and resuming exactly."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gcr import GCRPPO, MlpPolicy, MultiInputPolicy, RewardSpec
from tests.envs import SPEC, Env

SMALL: dict[str, Any] = {"n_steps": 32, "batch_size": 16, "n_epochs": 2, "seed": 0, "device": "cpu"}


def exactly(message: str) -> str:
    return f"^{re.escape(message)}$"


def parameters(model: Any) -> Any:
    return th.cat([parameter.detach().flatten() for parameter in model.policy.parameters()])


def my_resolver(gramian: Any, levels: Any, rng: Any, factor: float = 1.0) -> Any:
    return factor * rng.random(len(levels))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "model.zip"


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"resolver": "guaranteed", "desired_kl": 0.01},
        {"resolver": my_resolver, "resolver_kwargs": {"factor": 2.0}},
        {
            "use_sde": True,
            "clip_range_vf": 0.2,
            "clip_range": lambda progress: 0.1 + 0.1 * progress,
        },
        {
            "policy_kwargs": {
                "net_arch": {"pi": [8], "vf": [9, 9]},
                "share_features_extractor": False,
            }
        },
        {
            "policy_kwargs": {
                "optimizer_class": th.optim.AdamW,
                "optimizer_kwargs": {"weight_decay": 0.1},
            }
        },
        {
            "gramian_samples": 8,
            "gramian_method": "passes",
            "advantage_scope": "minibatch",
            "kappa_max": 3.0,
        },
    ],
)
def test_everything_comes_back(path: Path, kwargs: Any) -> None:
    env = make_vec_env(Env, 2, seed=0)
    model = GCRPPO("MlpPolicy", env, **SMALL, **kwargs).learn(128)
    model.save(path)
    loaded = GCRPPO.load(path, make_vec_env(Env, 3))
    assert th.equal(parameters(model), parameters(loaded))
    assert loaded.reward_spec == SPEC
    assert loaded.n_components == 3
    for name in (
        "resolver",
        "resolver_kwargs",
        "advantage_scope",
        "kappa_max",
        "desired_kl",
        "gramian_method",
        "gramian_samples",
    ):
        assert getattr(loaded, name) == getattr(model, name) or callable(getattr(model, name))
    assert loaded._adaptive_learning_rate == model._adaptive_learning_rate
    assert loaded._resolver_rng.bit_generator.state == model._resolver_rng.bit_generator.state
    assert loaded.policy_kwargs == model.policy_kwargs
    assert "n_components" not in loaded.policy_kwargs
    assert loaded.rollout_buffer_class is None
    np.testing.assert_array_equal(
        np.array(loaded.ep_component_buffer), np.array(model.ep_component_buffer)
    )
    observation = np.ones((5, 4), np.float32)
    np.testing.assert_array_equal(
        model.predict(observation, deterministic=True)[0],
        loaded.predict(observation, deterministic=True)[0],
    )
    loaded.learn(96, reset_num_timesteps=False)
    assert th.isfinite(parameters(loaded)).all()


def test_resuming_is_training_on(path: Path) -> None:
    """train(2n) = train(n), save, load, train(n): same env object at an episode boundary,
    generators restored.
    """

    def start() -> Any:
        # 16 divides n_steps: every rollout ends an episode in every env
        env = make_vec_env(lambda: Env(limit=16, p_end=0.0), 2, seed=0)
        return GCRPPO("MlpPolicy", env, desired_kl=0.01, **SMALL).learn(128)

    whole = start().learn(128, reset_num_timesteps=False)
    first = start()
    states = np.random.get_state(), th.get_rng_state()
    first.save(path)
    resumed = GCRPPO.load(path, first.get_env(), force_reset=False)
    np.random.set_state(states[0])
    th.set_rng_state(states[1])
    resumed.learn(128, reset_num_timesteps=False)
    assert resumed.num_timesteps == whole.num_timesteps == 256
    assert th.equal(parameters(resumed), parameters(whole))
    assert resumed._resolver_rng.bit_generator.state == whole._resolver_rng.bit_generator.state
    np.testing.assert_array_equal(
        np.array(resumed.ep_component_buffer), np.array(whole.ep_component_buffer)
    )


def test_policies_save_and_load_alone(path: Path) -> None:
    for policy_class, observation in ((MlpPolicy, "Box"), (MultiInputPolicy, "Dict")):
        env = make_vec_env(lambda observation=observation: Env(observation=observation), 1)
        model = GCRPPO(
            policy_class, env, policy_kwargs={"share_features_extractor": False}, **SMALL
        )
        model.policy.save(path)
        loaded = policy_class.load(path)
        assert loaded.n_components == 3
        assert loaded.share_features_extractor is False
        obs = model.policy.obs_to_tensor(env.reset())[0]
        assert th.equal(loaded.predict_values(obs), model.policy.predict_values(obs))


def test_parameters_can_be_read_and_set() -> None:
    model, other = (
        GCRPPO("MlpPolicy", make_vec_env(Env, 1), **{**SMALL, "seed": seed}) for seed in (0, 1)
    )
    model.learn(32)
    other.set_parameters(model.get_parameters())
    assert th.equal(parameters(model), parameters(other))


def test_another_order_of_the_components_is_permuted_by_name(path: Path) -> None:
    """The value heads keep their meaning: head ``save`` still learns ``save``."""
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL).learn(32)
    model.save(path)

    class Permuted(Env):
        def __init__(self) -> None:
            super().__init__()
            self.reward_spec = RewardSpec(("save", "go", "stay"), (1, 0, 0))

        def step(self, action: Any) -> Any:
            *rest, info = super().step(action)
            return *rest, {"reward_components": np.roll(info["reward_components"], 1)}

    results = []
    for env_class in (Env, Permuted):
        loaded = GCRPPO.load(path, make_vec_env(env_class, 1, seed=3))
        assert loaded.reward_spec == SPEC
        th.manual_seed(0)
        np.random.seed(0)
        results.append(parameters(loaded.learn(64)))
    assert th.equal(*results)


def test_other_levels_replace_the_models_with_a_warning(path: Path) -> None:
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL).save(path)
    levels = RewardSpec(SPEC.names, (0, 1, 2))
    message = (
        "The env's levels replace those of the model: now go (task), stay (regulariser), save "
        "(level 2); "
        "before go (task), stay (task), save (regulariser)."
    )
    with pytest.warns(UserWarning, match=exactly(message)):
        loaded = GCRPPO.load(path, make_vec_env(lambda: Env(levels), 1))
    assert loaded.reward_spec == levels


@pytest.mark.parametrize("how", ["load", "set_env"])
def test_other_names_are_refused_with_both_lists(path: Path, how: str) -> None:
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL)
    model.save(path)
    other = DummyVecEnv([lambda: Env(RewardSpec(("go", "stay", "shine"), (0, 0, 1)))])
    message = (
        "The env's reward components must be those of the model: the model has ['go', 'stay', "
        "'save'], "
        "found ['go', 'stay', 'shine'] in the env."
    )
    before = model.get_env()
    with pytest.raises(ValueError, match=exactly(message)):
        GCRPPO.load(path, other) if how == "load" else model.set_env(other)
    assert model.get_env() is before
    assert model.reward_spec == SPEC


def test_an_env_without_components_is_fine_for_predict_and_not_for_learn(path: Path) -> None:
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL).save(path)
    plain = make_vec_env(lambda: Env(None), 1)
    loaded = GCRPPO.load(path, plain)
    assert loaded.predict(plain.reset())[0].shape == (1, 2)
    message = (
        "The env reports no reward components, but the model has 3: go (task), stay (task), save "
        "(regulariser). "
        "Wrap it with `RewardDecomposition`, or set another with `set_env`; `predict` works "
        "without."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        loaded.learn(32)
    loaded.set_env(make_vec_env(Env, 1))
    loaded.learn(32)


def test_a_model_without_components_stays_one(path: Path) -> None:
    GCRPPO("MlpPolicy", make_vec_env(lambda: Env(None), 1), **SMALL).learn(32).save(path)
    GCRPPO.load(path, make_vec_env(lambda: Env(None), 2)).learn(64)
    message = (
        "The env's reward components must be those of the model: the model has ['reward'], "
        "found ['go', 'stay', 'save'] in the env."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        GCRPPO.load(path, make_vec_env(Env, 1))


def test_arguments_can_be_changed_at_load(path: Path) -> None:
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL).learn(32).save(path)
    loaded = GCRPPO.load(
        path, make_vec_env(Env, 1), resolver="guaranteed", n_steps=16, learning_rate=1e-5
    )
    assert loaded.resolver == "guaranteed"
    loaded.learn(16)
    with pytest.raises(ValueError, match=r"^Parameter `resolver` must be one of"):
        GCRPPO.load(path, resolver="other")

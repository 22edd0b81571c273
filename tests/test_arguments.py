"""Numbers and switches of the constructor, as YAML files and scripts may give them."""

from __future__ import annotations

import inspect
import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gcr import GCRPPO, RewardSpec
from sb3_gcr.arguments import FLAGS, NUMBERS, check_arguments
from tests.envs import SPEC, Env

ONE = RewardSpec(("only",), (0,))


def refuse(error: Any, message: str, spec: RewardSpec = SPEC, **kwargs: Any) -> None:
    """Before the env is even reset."""
    env = Env(spec)
    with pytest.raises(error, match=f"^{re.escape(message)}$"):
        GCRPPO("MlpPolicy", env, device="cpu", **kwargs)
    assert not hasattr(env, "t")


@pytest.mark.parametrize("spec", [ONE, SPEC])
@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("learning_rate", "a number ≥ 0 or a schedule"),
        ("n_steps", "an integer ≥ 1"),
        ("batch_size", "an integer ≥ 1"),
        ("n_epochs", "an integer ≥ 1"),
        ("gamma", "a number from 0 to 1"),
        ("gae_lambda", "a number from 0 to 1"),
        ("clip_range", "a number > 0 or a schedule"),
        ("clip_range_vf", "a number > 0, a schedule or None"),
        ("ent_coef", "a number"),
        ("vf_coef", "a number ≥ 0"),
        ("max_grad_norm", "a number > 0"),
        ("sde_sample_freq", "an integer ≥ -1"),
        ("target_kl", "a number > 0 or None"),
        ("stats_window_size", "an integer ≥ 1"),
        ("seed", "an integer ≥ 0 or None"),
        ("kappa_max", "a number > 0"),
        ("desired_kl", "a number > 0 or None"),
        ("gramian_samples", "an integer ≥ 1 or None"),
    ],
)
def test_text_is_no_number(name: str, expected: str, spec: RewardSpec) -> None:
    message = f"Parameter `{name}` must be {expected}, found "
    hint = " That is text: YAML needs a dot in 1.0e-2."
    refuse(TypeError, f"{message}'1e-2'.{hint}", spec, **{name: "1e-2"})
    refuse(TypeError, f"{message}'auto'.", spec, **{name: "auto"})
    refuse(TypeError, f"{message}[1].", spec, **{name: [1]})
    refuse(TypeError, f"{message}True.", spec, **{name: True})
    refuse(ValueError, f"{message}nan.", spec, **{name: np.nan})


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("learning_rate", -1e-3, "a number ≥ 0 or a schedule"),
        ("n_steps", 0, "an integer ≥ 1"),
        ("n_steps", 64.0, "an integer ≥ 1"),
        ("batch_size", 0, "an integer ≥ 1"),
        ("batch_size", 1, "an integer ≥ 2"),
        ("n_epochs", 0, "an integer ≥ 1"),
        ("n_epochs", -3, "an integer ≥ 1"),
        ("gamma", 1.01, "a number from 0 to 1"),
        ("gae_lambda", -0.1, "a number from 0 to 1"),
        ("clip_range", 0, "a number > 0 or a schedule"),
        ("clip_range_vf", -0.2, "a number > 0, a schedule or None"),
        ("vf_coef", -0.5, "a number ≥ 0"),
        ("max_grad_norm", 0.0, "a number > 0"),
        ("sde_sample_freq", -2, "an integer ≥ -1"),
        ("target_kl", 0, "a number > 0 or None"),
        ("stats_window_size", 0, "an integer ≥ 1"),
        ("seed", -1, "an integer ≥ 0 or None"),
        ("seed", 1.5, "an integer ≥ 0 or None"),
    ],
)
def test_numbers_out_of_range(name: str, value: float, expected: str) -> None:
    message = f"Parameter `{name}` must be {expected}, found {value!r}."
    refuse(ValueError, message, **{name: value})


@pytest.mark.parametrize("name", FLAGS)
def test_text_is_no_switch(name: str) -> None:
    """ "False" would count as true."""
    message = f"Parameter `{name}` must be True or False, found 'False'."
    refuse(TypeError, message, **{name: "False"})


def test_numpys_numbers_and_schedules_are_welcome() -> None:
    model = GCRPPO(
        "MlpPolicy",
        Env(),
        learning_rate=lambda progress: 1e-3 * progress,
        n_steps=np.int64(32),
        batch_size=np.int32(16),
        n_epochs=1,
        gamma=np.float32(0.9),
        clip_range=lambda progress: 0.2,
        clip_range_vf=np.float64(0.2),
        max_grad_norm=np.inf,
        seed=np.int64(3),
        device="cpu",
    )
    assert model.learn(32).num_timesteps == 32


def test_every_number_of_the_constructor_is_checked() -> None:
    numbers = {
        name
        for name, parameter in inspect.signature(GCRPPO.__init__).parameters.items()
        if re.search(r"\b(int|float)\b", str(parameter.annotation))
    }
    assert numbers - {*NUMBERS} == {"verbose"}  # True is common there
    flags = {
        name
        for name, parameter in inspect.signature(GCRPPO.__init__).parameters.items()
        if parameter.annotation == "bool"
    }
    assert flags - {*FLAGS} == {"_init_setup_model"}


def test_what_is_missing_is_not_checked() -> None:
    check_arguments({"gamma": 0.5, "other": "text"})


def test_a_gymnasium_vector_env_is_named() -> None:
    vector = gym.vector.SyncVectorEnv([Env])
    message = (
        "Parameter `env` must be a Gymnasium env, its id or a VecEnv of SB3, found a Gymnasium "
        "vector env, SyncVectorEnv. Use SB3's `make_vec_env(id, n_envs)`; for the envs of this "
        "package with `vec_env_cls=sb3_gcr.envs.BatchedVecEnv`."
    )
    with pytest.raises(TypeError, match=f"^{re.escape(message)}$"):
        GCRPPO("MlpPolicy", vector)  # type: ignore[arg-type]
    model = GCRPPO("MlpPolicy", DummyVecEnv([Env]), device="cpu")
    with pytest.raises(TypeError, match=f"^{re.escape(message)}$"):
        model.set_env(vector)  # type: ignore[arg-type]

"""VecNormalize's statistics come back exactly, and an env that they do not fit is told."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gcr import GCRPPO
from tests.envs import Env

SMALL: dict[str, Any] = {"n_steps": 32, "batch_size": 16, "n_epochs": 2, "seed": 0, "device": "cpu"}


def exactly(message: str) -> str:
    return f"^{re.escape(message)}$"


def normalized(observation: str = "Box", **kwargs: Any) -> VecNormalize:
    return VecNormalize(make_vec_env(lambda: Env(observation=observation), 2, seed=0), **kwargs)


def statistics(env: VecNormalize) -> Any:
    observations = getattr(env, "obs_rms", {})
    moments = (
        [*observations.values(), env.ret_rms]
        if isinstance(observations, dict)
        else [observations, env.ret_rms]
    )
    return np.concatenate([np.append(np.ravel((m.mean, m.var)), m.count) for m in moments])


@pytest.mark.parametrize(
    ("observation", "kwargs"),
    [
        ("Box", {}),
        ("Box", {"norm_obs": False}),
        ("DictImage", {"norm_obs_keys": ["a"]}),
        ("Image", {"norm_reward": False}),
    ],
)
def test_statistics_come_back_exactly(tmp_path: Path, observation: str, kwargs: Any) -> None:
    policy = {"Box": "MlpPolicy", "DictImage": "MultiInputPolicy", "Image": "MlpPolicy"}[
        observation
    ]
    env = normalized(observation, **kwargs)
    model = GCRPPO(policy, env, **SMALL).learn(64)
    model.save(tmp_path / "model")
    fresh = normalized(observation, **kwargs)
    GCRPPO.load(tmp_path / "model", env=fresh)
    np.testing.assert_array_equal(statistics(fresh), statistics(env))
    actions = np.zeros((2, 2))
    for venv in (fresh, env):
        venv.seed(1)
        venv.reset()
    np.testing.assert_equal(fresh.step(actions)[:2], env.step(actions)[:2])  # and go on as before


def test_a_vec_normalize_that_has_seen_something_keeps_its_own(tmp_path: Path) -> None:
    model = GCRPPO("MlpPolicy", normalized(), **SMALL).learn(64)
    model.save(tmp_path / "model")
    env = normalized()
    env.reset()
    before = statistics(env)
    GCRPPO.load(tmp_path / "model", env=env)
    np.testing.assert_array_equal(statistics(env), before)


def test_statistics_of_other_observations_are_refused(tmp_path: Path) -> None:
    GCRPPO("MultiInputPolicy", normalized("DictImage", norm_obs_keys=["a"]), **SMALL).save(
        tmp_path / "model"
    )
    message = (
        "VecNormalize must normalise the observations that it did for the saved model, ['a'], "
        "found ['i']."
    )
    env = normalized("DictImage", norm_obs_keys=["i"])
    env.observation_space = normalized("DictImage", norm_obs_keys=["a"]).observation_space
    with pytest.raises(ValueError, match=exactly(message)):
        GCRPPO.load(tmp_path / "model", env=env)


# === What does not fit is told once ===

WITHOUT = (
    "The model has learned under VecNormalize, whose statistics are in its file, and the env has "
    "none: its {} are in other units. Wrap it with `VecNormalize(env)`; to evaluate, with "
    "`VecNormalize(env, training=False, norm_reward=False)`."
)
LEFT = (
    "The model has learned from observations that VecNormalize has normalised, and that of the env "
    "leaves them as they are. Set its `norm_obs=True`."
)
NORMALISED = (
    "The model has learned from observations as they are, and the env's VecNormalize normalises "
    "them. Set its `norm_obs=False`."
)


def switched_off() -> VecNormalize:
    env = normalized()
    env.norm_obs = False
    return env


@pytest.mark.parametrize("weights_only", [False, True])
@pytest.mark.parametrize(
    ("saved", "env", "message"),
    [
        (normalized, lambda: make_vec_env(Env, 2), WITHOUT.format("observations")),
        (normalized, lambda: normalized(norm_obs=False), LEFT),
        (normalized, switched_off, LEFT),
        (normalized, normalized, None),
        (
            lambda: normalized(norm_obs=False),
            lambda: make_vec_env(Env, 2),
            WITHOUT.format("rewards"),
        ),
        (lambda: normalized(norm_obs=False), normalized, NORMALISED),
        (lambda: make_vec_env(Env, 2), normalized, NORMALISED),
        (lambda: make_vec_env(Env, 2), lambda: normalized(norm_obs=False), None),
        (lambda: make_vec_env(Env, 2), lambda: make_vec_env(Env, 2), None),
    ],
)
def test_an_env_with_other_units_is_warned_about_once(
    tmp_path: Path, saved: Any, env: Any, message: str | None, weights_only: bool
) -> None:
    GCRPPO("MlpPolicy", saved(), **SMALL).learn(64).save(tmp_path / "model")
    for load in (GCRPPO.load, GCRPPO.warm_start):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            load(tmp_path / "model", env=env(), device="cpu", weights_only=weights_only)
        assert [str(warning.message) for warning in caught] == ([message] if message else [])
        assert all(warning.filename == __file__ for warning in caught)


def test_statistics_wait_for_an_env(tmp_path: Path) -> None:
    """They come with ``set_env`` where ``load`` had none, and are saved again in the meantime."""
    model = GCRPPO("MlpPolicy", normalized(), **SMALL).learn(64)
    model.save(tmp_path / "first")
    GCRPPO.load(tmp_path / "first").save(tmp_path / "second")
    loaded = GCRPPO.load(tmp_path / "second")
    with pytest.warns(match=exactly(WITHOUT.format("observations"))):
        loaded.set_env(make_vec_env(Env, 2))
    env = normalized()
    loaded.set_env(env)
    np.testing.assert_array_equal(statistics(env), statistics(model.get_env()))
    other = normalized()
    loaded.set_env(other)  # the model's statistics are that env's now
    assert statistics(other).max() == 1


def test_a_model_that_has_learned_without_has_none(tmp_path: Path) -> None:
    GCRPPO("MlpPolicy", normalized(), **SMALL).learn(64).save(tmp_path / "model")
    with pytest.warns(match="the env has none"):
        model = GCRPPO.load(tmp_path / "model", env=make_vec_env(Env, 2))
    model.learn(64).save(tmp_path / "model")
    GCRPPO.load(tmp_path / "model", env=make_vec_env(Env, 2))

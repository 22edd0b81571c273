"""Saving, loading, other envs, and resuming exactly."""

from __future__ import annotations

import pickle
import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.save_util import load_from_zip_file
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
        "found ['go', 'stay', 'shine'] in the env. `GCRPPO.warm_start(path, env)` begins a new "
        "model with what a saved one has learned of other components."
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
        "found ['go', 'stay', 'save'] in the env. `GCRPPO.warm_start(path, env)` begins a new "
        "model with what a saved one has learned of other components."
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


# === What the caller gives counts more than what was saved ===


def rate_of_the_next_step(model: Any) -> float:
    """Let the model learn, and stop at its optimiser's first step."""

    class Stopped(Exception):
        pass

    def stop(*args: Any) -> None:
        raise Stopped

    model.policy.optimizer.register_step_pre_hook(stop)
    with pytest.raises(Stopped):
        model.learn(32, reset_num_timesteps=False)
    return float(model.policy.optimizer.param_groups[0]["lr"])


def by_sb3s_recipe(path: Path, env: Any) -> Any:
    model = GCRPPO.load(path, env, device="cpu")
    model.learning_rate = 1e-6
    model._setup_lr_schedule()
    return model


def by_keyword(path: Path, env: Any, **others: Any) -> Any:
    return GCRPPO.load(path, env, device="cpu", learning_rate=1e-6, **others)


def by_custom_objects(path: Path, env: Any, **others: Any) -> Any:
    return GCRPPO.load(path, env, device="cpu", custom_objects={"learning_rate": 1e-6}, **others)


WAYS = {
    "keyword": by_keyword,
    "keyword, weights only": partial(by_keyword, weights_only=True),
    "custom objects": by_custom_objects,
    "custom objects, weights only": partial(by_custom_objects, weights_only=True),
    "SB3's recipe": by_sb3s_recipe,
    "without the target": partial(by_keyword, desired_kl=None),
    "warm start": partial(GCRPPO.warm_start, device="cpu", learning_rate=1e-6),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("desired_kl", [None, 0.01])
def test_a_learning_rate_that_is_given_is_that_of_the_next_step(
    path: Path, way: str, desired_kl: float | None
) -> None:
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 1), desired_kl=desired_kl, **SMALL).learn(64)
    model.save(path)
    assert rate_of_the_next_step(WAYS[way](path, make_vec_env(Env, 1))) == 1e-6


@pytest.mark.parametrize("weights_only", [False, True])
def test_without_one_the_adapted_rate_goes_on(path: Path, weights_only: bool) -> None:
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 1), desired_kl=0.01, **SMALL).learn(64)
    adapted = model.policy.optimizer.param_groups[0]["lr"]
    assert adapted > 3e-4
    model.save(path)
    loaded = GCRPPO.load(path, make_vec_env(Env, 1), device="cpu", weights_only=weights_only)
    assert rate_of_the_next_step(loaded) == adapted


@pytest.mark.parametrize("weights_only", [False, True])
def test_the_rate_that_the_model_began_with_can_be_given_again(
    path: Path, weights_only: bool
) -> None:
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 1), desired_kl=0.01, **SMALL).learn(64)
    model.save(path)
    again = {"learning_rate": 3e-4, "weights_only": weights_only}
    loaded = GCRPPO.load(path, make_vec_env(Env, 1), device="cpu", **again)  # type: ignore[arg-type]
    assert rate_of_the_next_step(loaded) == 3e-4


@pytest.mark.parametrize("weights_only", [False, True])
def test_other_arguments_that_are_given_count_too(path: Path, weights_only: bool) -> None:
    """A seed seeds the resolver's generator; SB3 keeps one argument under another name."""
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 1), resolver="gcr", **SMALL).learn(32)
    model.set_random_seed(1)
    assert model._resolver_rng is not None
    model._resolver_rng.random(100)
    model.save(path)
    env = make_vec_env(Env, 1)
    given = {"seed": 7, "stats_window_size": 3, "num_timesteps": 5, "weights_only": weights_only}
    loaded = GCRPPO.load(path, env, device="cpu", **given)  # type: ignore[arg-type]
    assert loaded._resolver_rng is not None
    expected = np.random.default_rng(7).bit_generator.state
    assert loaded._resolver_rng.bit_generator.state == expected
    assert (loaded.seed, loaded.num_timesteps) == (7, 5)
    loaded.learn(32)
    assert loaded.ep_component_buffer.maxlen == 3
    assert loaded.ep_info_buffer is not None
    assert loaded.ep_info_buffer.maxlen == 3


# === A file that is none of this model's ===

OTHERS = (
    "The env's reward components must be those of the model: the model has ['reward'], found "
    "['go', 'stay', 'save'] in the env. `GCRPPO.warm_start(path, env)` begins a new model with "
    "what a saved one has learned of other components."
)


def test_the_file_of_a_ppo_is_a_model_of_one_component(path: Path) -> None:
    plain = make_vec_env(lambda: Env(None), 1)
    model = PPO("MlpPolicy", plain, **SMALL).learn(32)
    model.save(path)
    with pytest.raises(ValueError, match=exactly(OTHERS)):
        GCRPPO.load(path, make_vec_env(Env, 1), device="cpu")
    for env in (None, plain):
        loaded = GCRPPO.load(path, env, device="cpu")
        assert th.equal(parameters(loaded), parameters(model))
    with pytest.raises(ValueError, match=exactly(OTHERS)):
        loaded.set_env(make_vec_env(Env, 1))
    loaded.learn(32)


def test_the_id_of_an_env_is_no_env(path: Path) -> None:
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL).save(path)
    message = (
        "Parameter `env` must be an environment, found the id 'Hopper-v5'. Make one with "
        "`gymnasium.make` or SB3's `make_vec_env`."
    )
    for weights_only in (False, True):
        with pytest.raises(ValueError, match=exactly(message)):
            GCRPPO.load(path, "Hopper-v5", weights_only=weights_only)  # type: ignore[arg-type]


# === A subclass with arguments of its own ===


class Explicit(GCRPPO):
    """Writes an argument out, passes the others on, and has a counter and a cache."""

    saved_numbers = ("n_calls",)
    unsaved = ("cache",)
    followers = (("n_calls", "temperature"),)

    def __init__(self, *args: Any, temperature: float = 1.0, label: str = "", **kwargs: Any):
        self.temperature = temperature
        self._label = label
        self.n_calls: int | None = 0
        self.cache = object()
        super().__init__(*args, **kwargs)


@pytest.mark.parametrize("weights_only", [False, True])
def test_a_subclass_keeps_its_own_arguments_and_counters(path: Path, weights_only: bool) -> None:
    model = Explicit(
        "MlpPolicy", make_vec_env(Env, 1), temperature=0.5, label="a", kappa_max=3.0, **SMALL
    ).learn(32)
    model.n_calls = 8
    model.save(path)
    written = load_from_zip_file(path)[0]
    assert written is not None
    assert "cache" not in written
    assert not {"_resolve", "_reader", "rollout_buffer"} & set(written)
    env = make_vec_env(Env, 1)
    loaded = Explicit.load(path, env, device="cpu", weights_only=weights_only)
    assert (loaded.temperature, loaded._label, loaded.kappa_max) == (0.5, "a", 3.0)
    assert (loaded.n_calls, loaded.num_timesteps) == (8, 32)
    started = Explicit.warm_start(path, env, device="cpu", weights_only=weights_only)
    assert (started.temperature, started._label, started.n_calls) == (0.5, "a", 0)
    given = {"temperature": 2.0, "weights_only": weights_only}
    changed = Explicit.load(path, env, device="cpu", **given)  # type: ignore[arg-type]
    assert changed.temperature == 2.0
    assert not changed.n_calls  # it has followed the other temperature
    message = r"^The settings in a file must be arguments of GCRPPO, found \['label', 'temperature"
    with pytest.raises(ValueError, match=message):
        GCRPPO.load(path, env, device="cpu", weights_only=True)


# === Pickle ===


@pytest.mark.parametrize("method", ["auto", "passes"])
def test_a_model_that_has_learned_can_be_pickled(method: str) -> None:
    """As SB3's PPO can."""
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 2), gramian_method=method, **SMALL).learn(64)
    copy = pickle.loads(pickle.dumps(model))
    assert th.equal(parameters(copy), parameters(model))
    copy.learn(64)
    assert th.isfinite(parameters(copy)).all()

"""Reading from VecEnvs of all kinds: the outermost layer wins, in the units of its place."""

from __future__ import annotations

import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_gcr import GCRPPO, RewardDecomposition, RewardSpec, evaluate_components
from sb3_gcr.rewards.reading import ComponentReader, find_reward_spec, match_specs, undecomposed_id
from tests.envs import SPEC, BatchedEnv, Env, Terms


def exactly(message: str) -> str:
    return f"^{re.escape(message)}$"


def test_specs_are_found_through_wrappers() -> None:
    assert find_reward_spec(VecFrameStack(VecNormalize(DummyVecEnv([Env])), 2)) == SPEC
    assert find_reward_spec(VecNormalize(BatchedEnv())) == SPEC
    assert find_reward_spec(DummyVecEnv([lambda: Env(None)])) is None
    env = Env()
    env.reward_spec = {"go": "task", "stay": 0, "save": 1}  # type: ignore[assignment]
    assert find_reward_spec(DummyVecEnv([lambda: env])) == SPEC


class OwnVecEnv(DummyVecEnv):
    """Answers ``get_attr`` as some simulators' VecEnvs do: no integer as indices, None or an error
    for what it lacks.
    """

    def __init__(self, env_fns: Any, missing: Any):
        self.missing = missing
        super().__init__(env_fns)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        n = self.num_envs if indices is None else len(indices)
        if not hasattr(self.envs[0], attr_name):
            if self.missing is not None:
                raise self.missing
            return [None] * n
        return [getattr(self.envs[0], attr_name)] * n


@pytest.mark.parametrize("missing", [None, NotImplementedError(), AttributeError()])
def test_other_peoples_vec_envs(missing: Any) -> None:
    plain = OwnVecEnv([lambda: Env(None)] * 2, missing)
    assert find_reward_spec(plain) is None
    assert undecomposed_id(plain) is None
    ComponentReader(plain, SPEC)
    assert find_reward_spec(OwnVecEnv([Env] * 2, missing)) == SPEC
    env = Env(None)
    env.reward_spec = lambda: "dm_env's"  # type: ignore[assignment,return-value]
    assert find_reward_spec(DummyVecEnv([lambda: env])) is None


def test_envs_that_disagree() -> None:
    other = RewardSpec(("go", "stay", "save"), (0, 1, 1))
    message = (
        f"All envs must have the same `reward_spec`, found ({SPEC}) in env 0 and ({other}) in env "
        "1."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        find_reward_spec(DummyVecEnv([Env, lambda: Env(other)]))
    env = Env()
    env.reward_spec = ("go",)  # type: ignore[assignment]
    message = (
        "An env's `reward_spec` must be a RewardSpec or a mapping of names to levels, found "
        "('go',)."
    )
    with pytest.raises(TypeError, match=exactly(message)):
        find_reward_spec(DummyVecEnv([lambda: env]))


def test_matching_specs() -> None:
    saved = RewardSpec(("a", "b"), (0, 1))
    assert match_specs(saved, None) == saved
    assert match_specs(saved, RewardSpec(("b", "a"), (1, 0))) == saved
    message = (
        "The env's levels replace those of the model: now a (task), b (level 2); before a (task), "
        "b (regulariser)."
    )
    with pytest.warns(UserWarning, match=exactly(message)):
        assert match_specs(saved, RewardSpec(("b", "a"), (2, 0))) == RewardSpec(("a", "b"), (0, 2))
    message = (
        "The env's reward components must be those of the model: the model has ['a', 'b'], found "
        "['a', 'c'] in the env. `GCRPPO.warm_start(path, env)` begins a new model with what a "
        "saved one has learned of other components."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        match_specs(saved, RewardSpec(("a", "c"), (0, 1)))


@pytest.mark.parametrize("clip_reward", [10.0, 0.3])
def test_vec_normalize_scales_every_component_alike(clip_reward: float) -> None:
    """Components keep their ratios and sum to the normalised reward, where the clip struck too."""
    env = VecNormalize(make_vec_env(Env, n_envs=3, seed=0), clip_reward=clip_reward)
    env.reset()
    reader = ComponentReader(env, SPEC)
    struck = 0
    for _ in range(200):
        _, rewards, _, infos = env.step(np.array([env.action_space.sample() for _ in range(3)]))
        components, original = reader.read(rewards, infos, 0)
        np.testing.assert_allclose(components.sum(1), rewards, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(original, [info["reward_components"] for info in infos])
        np.testing.assert_allclose(
            components[:, 0] * original[:, 1],
            components[:, 1] * original[:, 0],
            rtol=1e-6,
            atol=1e-12,
        )
        struck += int((np.abs(rewards) >= clip_reward * 0.999).sum())
    assert (struck > 50) is (clip_reward < 1)


def test_reader_permutes_by_name() -> None:
    env = DummyVecEnv([Env])
    env.reset()
    reader = ComponentReader(env, RewardSpec(("save", "go", "stay"), (1, 0, 0)))
    _, rewards, _, infos = env.step(np.zeros((1, 2)))
    go, stay, save = infos[0]["reward_components"]
    assert reader.read(rewards, infos, 0)[0].tolist() == [[save, go, stay]]


def test_batched_components_are_copied() -> None:
    env = BatchedEnv()
    env.reset()
    reader = ComponentReader(env, SPEC)
    _, rewards, _, infos = env.step(np.zeros((4, 2)))
    components, _ = reader.read(rewards, infos, 0)
    before = components.copy()
    env.step(np.zeros((4, 2)))
    np.testing.assert_array_equal(components, before)
    env.reward_components = np.zeros((4, 2))
    with pytest.raises(
        ValueError, match=exactly("`reward_components` must have shape (4, 3), found (4, 2).")
    ):
        reader.read(rewards, infos, 0)


# ------------------------------------------------------------ layers


class Adding(VecEnvWrapper):
    """Pays 0.5 more to everybody, as a component of its own."""

    def __init__(self, venv: VecEnv, before_the_first_step: Any = None):
        super().__init__(venv)
        self.reward_spec = RewardSpec((*SPEC.names, "bonus"), (*SPEC.levels, 1))
        self.reward_components = before_the_first_step

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        inside = own_rows(self.venv, infos)
        self.reward_components = np.column_stack([inside, np.full(self.num_envs, 0.5)])
        return observations, rewards + np.float32(0.5), dones, infos


def own_rows(venv: Any, infos: Any) -> np.ndarray[Any, Any]:
    """The components that a wrapper's writer knows how to get: from its env, or from the infos."""
    while isinstance(venv, VecEnvWrapper):
        venv = venv.venv
    if isinstance(venv, BatchedEnv):
        return venv.reward_components
    return np.array([info["reward_components"] for info in infos])


class Replacing(VecEnvWrapper):
    """Only replaces the spec."""

    def __init__(self, venv: VecEnv, spec: RewardSpec):
        super().__init__(venv)
        self.reward_spec = spec

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        return self.venv.step_wait()


class Filled(BatchedEnv):
    """With an info for each env, as VecNormalize and evaluate_policy need them."""

    def __init__(self) -> None:
        super().__init__()
        self.infos = [{} for _ in range(4)]


def step(env: VecEnv, n_steps: int = 1) -> Any:
    env.reset()
    for _ in range(n_steps):
        _, rewards, _, infos = env.step(np.zeros((env.num_envs, 2), np.float32))
    return rewards, infos


INSIDE = [Filled, lambda: make_vec_env(Env, n_envs=4, seed=0)]


@pytest.mark.parametrize("make", INSIDE, ids=["array", "infos"])
@pytest.mark.parametrize(
    "around", [lambda env: env, VecMonitor, VecNormalize, lambda env: VecNormalize(VecMonitor(env))]
)
@pytest.mark.filterwarnings("ignore:The environment is already wrapped")
def test_the_outermost_wrapper_says_what_the_components_are(make: Any, around: Any) -> None:
    env = around(Adding(make()))
    spec = find_reward_spec(env)
    assert spec is not None
    assert spec.names == ("go", "stay", "save", "bonus")
    rewards, infos = step(env, 5)
    components, original = ComponentReader(env, spec).read(rewards, infos, 5)
    np.testing.assert_allclose(components.sum(1), rewards, rtol=1e-5)
    np.testing.assert_array_equal(original[:, 3], np.full(4, 0.5))


@pytest.mark.parametrize("make", INSIDE, ids=["array", "infos"])
def test_a_wrapper_outside_vec_normalize_is_not_scaled(make: Any) -> None:
    class Outside(Adding):
        def step_wait(self) -> Any:
            observations, rewards, dones, infos = self.venv.step_wait()
            scale = rewards / self.venv.get_original_reward()  # type: ignore[attr-defined]
            inside = own_rows(self.venv, infos) * scale[:, None]
            self.reward_components = np.column_stack([inside, np.full(4, 0.5)])
            return observations, rewards + np.float32(0.5), dones, infos

    env = Outside(VecNormalize(make()))
    rewards, infos = step(env, 5)
    components, original = ComponentReader(env, env.reward_spec).read(rewards, infos, 5)
    np.testing.assert_array_equal(components, original)
    np.testing.assert_array_equal(components[:, 3], np.full(4, 0.5))


@pytest.mark.parametrize("make", INSIDE, ids=["array", "infos"])
def test_a_wrapper_that_only_replaces_the_spec(make: Any) -> None:
    """Other levels and another order: the columns are found by name. One component is PPO."""
    env = VecNormalize(Replacing(make(), RewardSpec(("save", "go", "stay"), (2, 0, 1))))
    spec = find_reward_spec(env)
    assert spec == RewardSpec(("save", "go", "stay"), (2, 0, 1))
    rewards, infos = step(env)
    _, original = ComponentReader(env, spec).read(rewards, infos, 1)
    np.testing.assert_array_equal(original, own_rows(env, infos)[:, [2, 0, 1]])
    one = VecNormalize(Replacing(make(), RewardSpec(("all",), (0,))))
    model = GCRPPO("MlpPolicy", one, n_steps=8, batch_size=32, n_epochs=1, device="cpu").learn(32)
    assert model.reward_spec.names == ("all",)
    found = evaluate_components(model, one, 4, warn=False)
    assert found.component_means == {"all": found.mean_reward}


def test_a_wrapper_with_names_that_nobody_fills() -> None:
    env = Replacing(Filled(), RewardSpec(("go", "stay"), (0, 0)))
    rewards, infos = step(env)
    message = (
        "Replacing names the reward components ['go', 'stay'], but the `reward_components` of "
        "Filled inside it are ['go', 'stay', 'save']: a wrapper with other components must have "
        "`reward_components` of its own, shape (N, 2)."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        ComponentReader(env, env.reward_spec).read(rewards, infos, 1)


@pytest.mark.parametrize("early", [None, np.zeros((4, 4))])
def test_components_that_are_there_from_the_first_step_on(early: Any) -> None:
    env = Adding(Filled(), early)
    reader = ComponentReader(env, env.reward_spec)
    rewards, infos = step(env)
    assert reader.read(rewards, infos, 1)[0][:, 3].tolist() == [0.5] * 4
    del env.reward_components
    inner = Filled()
    del inner.reward_components
    reader = ComponentReader(inner, SPEC)
    rewards, infos = step_after(inner)
    assert reader.read(rewards, infos, 1)[0].shape == (4, 3)


def step_after(env: Filled) -> Any:
    env.reward_components = np.zeros((4, 3))
    return step(env)


@pytest.mark.parametrize("twice", [lambda env: VecNormalize(VecNormalize(env))])
@pytest.mark.parametrize("clip", [10.0, 0.3])
def test_two_vec_normalize_multiply(twice: Any, clip: float) -> None:
    env = VecNormalize(VecNormalize(make_vec_env(Env, 3, seed=0), clip_reward=clip), gamma=0.9)
    reader = ComponentReader(env, SPEC)
    env.reset()
    for timestep in range(50):
        _, rewards, _, infos = env.step(np.zeros((3, 2), np.float32))
        components, original = reader.read(rewards, infos, timestep)
        np.testing.assert_allclose(components.sum(1), rewards, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(
            original, [info["reward_components"] for info in infos], rtol=1e-12
        )


def test_observations_and_returns_normalised_apart() -> None:
    """As SB3's PPO learns the same from one VecNormalize, whichever is outside."""
    losses = []
    for outside in ({"norm_obs": False}, {"norm_reward": False}):
        inside = {"norm_reward": False} if "norm_obs" in outside else {"norm_obs": False}
        env = VecNormalize(VecNormalize(make_vec_env(Env, 2, seed=0), **inside), **outside)
        model = GCRPPO("MlpPolicy", env, n_steps=64, n_epochs=1, seed=0, device="cpu").learn(128)
        losses.append(model.rollout_buffer.rewards)
    np.testing.assert_allclose(*losses, rtol=1e-6)


def test_a_wrapper_that_changes_the_reward_outside_vec_normalize() -> None:
    class Halving(Replacing):
        def step_wait(self) -> Any:
            observations, rewards, dones, infos = self.venv.step_wait()
            return observations, rewards / 2, dones, infos

    env = Halving(VecNormalize(make_vec_env(Env, 1, seed=0)), SPEC)
    env.reward_spec = None  # type: ignore[assignment]
    rewards, infos = step(env)
    message = (
        f"Env index 0 at timestep 7: the reward must be the {2 * rewards[0]:.6g} that VecNormalize "
        f"gave, found {rewards[0]:.6g}: a wrapper outside VecNormalize changes it after the terms "
        "were collected. Put it inside."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        ComponentReader(env, SPEC).read(rewards, infos, 7)


def test_a_wrapper_that_changes_the_reward_after_the_terms_were_collected() -> None:
    def make(function: Any) -> VecEnv:
        terms = Terms([{"a": 0.766109, "b": -0.0570107}], [0.766109 - 0.0570107])
        return DummyVecEnv(
            [
                lambda: gym.wrappers.TransformReward(
                    RewardDecomposition(terms, {"a": 0, "b": 1}), function
                )
            ]
        )

    start = (
        "Env index 0 at timestep 1: The reward components must sum to the reward {}, found "
        "0.709098 (a=0.766109, b=-0.0570107). They did where RewardDecomposition stands: a wrapper "
        "outside it changes the reward"
    )
    spec = RewardSpec(("a", "b"), (0, 1))
    for function, message in (
        (
            lambda reward: 0.01 * reward,
            start.format("0.00709098") + ", here by a factor of 0.01. Wrap that wrapper instead, "
            "with `RewardDecomposition(weights=0.01)`, or scale with VecNormalize, which scales "
            "the terms along.",
        ),
        (
            lambda reward: min(reward, 0.5123456),
            start.format("0.512346") + ". Leave it out, or scale with VecNormalize, which scales "
            "the terms along.",
        ),
    ):
        env = make(function)
        env.reset()
        _, rewards, _, infos = env.step(np.zeros((1, 1)))
        with pytest.raises(ValueError, match=exactly(message)):
            ComponentReader(env, spec).read(rewards, infos, 1)


# ------------------------------------------------------------ other people's


class Own(Env):
    """Its components are a dictionary by name."""

    def step(self, action: Any) -> Any:
        *others, info = super().step(action)
        go, stay, save = info["reward_components"]
        return *others, {"reward_components": {"save": save, "go": go, "stay": stay, "x": 9.0}}


def test_components_of_an_env_by_name() -> None:
    env = DummyVecEnv([Own])
    rewards, infos = step(env)
    expected = [infos[0]["reward_components"][name] for name in SPEC.names]
    assert ComponentReader(env, SPEC).read(rewards, infos, 1)[0].tolist() == [expected]
    del infos[0]["reward_components"]["stay"]
    message = (
        "Env index 0 at timestep 1: Reward component 'stay' is missing: parameter `components` "
        "must name keys of `info[\"reward_components\"]`, found only ['go', 'save', 'x']."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        ComponentReader(env, SPEC).read(rewards, infos, 1)


def test_components_of_a_simulator_by_name_and_as_tensors() -> None:
    env = Filled()
    rewards, infos = step(env)
    rows = env.reward_components.copy()
    env.reward_components = {  # type: ignore[assignment]
        name: th.tensor(column, requires_grad=True)
        for name, column in zip(SPEC.names, rows.T, strict=True)
    }
    np.testing.assert_array_equal(ComponentReader(env, SPEC).read(rewards, infos, 1)[1], rows)
    del env.reward_components["stay"]  # type: ignore[attr-defined]
    message = (
        "Reward component 'stay' is missing in `reward_components`, found only ['go', 'save']."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        ComponentReader(env, SPEC).read(rewards, infos, 1)


class Foreign(VecEnvWrapper):
    """A VecEnv around something that is none, as SuperSuit's: no ``has_attr``, no ``env_method``,
    and an ``__init__`` of its own.
    """

    class Simulator:
        num_envs, render_mode = 4, None
        observation_space, action_space = Filled().observation_space, Filled().action_space

        def __init__(self) -> None:
            self.env = Filled()
            self.reset, self.step_async = self.env.reset, self.env.step_async
            self.step_wait, self.close = self.env.step_wait, self.env.close

        def get_attr(self, name: str, indices: Any = None) -> Any:
            raise AttributeError(name)

        def env_is_wrapped(self, wrapper: Any, indices: Any = None) -> list[bool]:
            return [False] * 4

    def __init__(self) -> None:
        self.venv: Any = self.Simulator()
        self.num_envs, self.render_mode = 4, None
        self.observation_space = self.venv.observation_space
        self.action_space = self.venv.action_space
        self.reset_infos = []

    def getattr_recursive(self, name: str) -> Any:
        raise AttributeError(name)

    def getattr_depth_check(self, name: str, already_found: bool) -> Any:
        return None

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, rewards, dones, _ = self.venv.step_wait()
        rows = self.venv.env.reward_components
        return observations, rewards, dones, [{"reward_components": row.copy()} for row in rows]


@pytest.mark.parametrize("around", [lambda env: env, lambda env: VecNormalize(VecMonitor(env))])
@pytest.mark.filterwarnings("ignore:The `render_mode` attribute is not defined")
def test_a_vec_env_around_something_else(around: Any) -> None:
    small = {"n_steps": 8, "batch_size": 32, "n_epochs": 1, "device": "cpu"}
    assert GCRPPO("MlpPolicy", around(Foreign()), **small).learn(32).reward_spec.names == (
        "reward",
    )
    env = Foreign()
    env.reward_spec = SPEC  # type: ignore[attr-defined]
    assert GCRPPO("MlpPolicy", around(env), **small).learn(32).reward_spec == SPEC

"""Names, levels, the wrapper, and the words of every error."""

from __future__ import annotations

import json
import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_gcr import RewardDecomposition, RewardSpec
from sb3_gcr.rewards.decomposition import GYMNASIUM_ENVS
from sb3_gcr.rewards.reading import ComponentReader, find_reward_spec, match_specs, undecomposed_id
from tests.envs import SPEC, BatchedEnv, Env, Terms

LEVELS = (
    "valid choices are ['regulariser', 'regularizer', 'task'] and integers from 0 (highest "
    "priority) on"
)


def exactly(message: str) -> str:
    return f"^{re.escape(message)}$"


def test_spec_from_words_and_integers() -> None:
    spec = RewardSpec.from_dict(
        {"run": "task", "torque": "regulariser", "jerk": "regularizer", "style": 2}
    )
    assert spec == RewardSpec(["run", "torque", "jerk", "style"], np.array([0, 1, 1, 2]))  # type: ignore[arg-type]
    assert spec.to_dict() == {"run": 0, "torque": 1, "jerk": 1, "style": 2}
    assert len(spec) == 4
    assert hash(spec) == hash(RewardSpec(spec.names, spec.levels))
    assert str(spec) == "run (task), torque (regulariser), jerk (regulariser), style (level 2)"
    with pytest.raises(AttributeError):
        spec.names = ("other",)  # type: ignore[misc]


@pytest.mark.parametrize(
    ("names", "levels", "error", "message"),
    [
        (
            [],
            [],
            ValueError,
            "Parameter `names` must name at least one reward component, found none.",
        ),
        (
            ["a", ""],
            [0, 0],
            ValueError,
            "Parameter `names` must not contain an empty name, found ['a', ''].",
        ),
        (["a", 3], [0, 0], TypeError, "Parameter `names` must contain strings, found 3."),
        (
            ["a,b"],
            [0],
            ValueError,
            "Parameter `names` must not contain commas, quotes or line breaks, found 'a,b'.",
        ),
        ("ab", [0, 0], TypeError, "Parameter `names` must be a sequence, found 'ab'."),
        (
            ["a", "b", "a"],
            [0, 0, 1],
            ValueError,
            "Parameter `names` must be unique, found ['a'] more than once in ['a', 'b', 'a'].",
        ),
        (
            ["a", "b"],
            [0],
            ValueError,
            "Parameter `levels` must have one level for each of the 2 names, found 1.",
        ),
        (
            ["a"],
            [0.5],
            TypeError,
            f"The level of reward component 'a' must be an integer or a word, found 0.5: {LEVELS}.",
        ),
        (
            ["a"],
            [True],
            TypeError,
            "The level of reward component 'a' must be an integer or a word, found True: "
            f"{LEVELS}.",
        ),
        (
            ["a"],
            [-1],
            ValueError,
            f"The level of reward component 'a' must not be negative, found -1: {LEVELS}.",
        ),
        (["a"], ["boss"], ValueError, f"Unknown level 'boss' of reward component 'a': {LEVELS}."),
    ],
)
def test_bad_specs(names: Any, levels: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=exactly(message)):
        RewardSpec(names, levels)


def test_from_dict_needs_a_mapping() -> None:
    with pytest.raises(
        TypeError, match=exactly("Parameter `components` must map names to levels, found ['a'].")
    ):
        RewardSpec.from_dict(["a"])  # type: ignore[arg-type]


@pytest.mark.parametrize("env_id", list(GYMNASIUM_ENVS))
def test_gymnasium_terms_sum_to_the_reward(env_id: str) -> None:
    """Every env of the table, 300 random steps: components are fresh, finite, in order, and add up
    to the reward.
    """
    env = RewardDecomposition(gym.make(env_id))
    env.reset(seed=0)
    env.action_space.seed(0)
    previous = None
    names = list(env.reward_spec.names)
    assert names[: len(GYMNASIUM_ENVS[env_id]["components"])] == list(
        GYMNASIUM_ENVS[env_id]["components"]
    )
    for _ in range(300):
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        components = info["reward_components"]
        assert components.shape == (len(names),)
        assert components.sum() == pytest.approx(float(reward), rel=1e-9, abs=1e-9)
        assert components is not previous
        previous = components
        if terminated or truncated:
            env.reset()
    if env_id == "HumanoidStandup-v5":
        assert names[-1] == "alive"
        assert components[-1] == pytest.approx(1)
    env.close()


@pytest.mark.filterwarnings(
    "ignore:.*(is different from the unwrapped version|A Box observation space)"
)
def test_wrapper_passes_gymnasiums_checks_and_its_arguments_are_json() -> None:
    kwargs = {
        "components": {"reward_forward": "task", "reward_ctrl": 1},
        "residual": None,
        "tolerance": 1e-4,
    }
    env = RewardDecomposition(gym.make("HalfCheetah-v5"), **json.loads(json.dumps(kwargs)))
    assert env._saved_kwargs == kwargs
    check_env(env, skip_render_check=True)


def test_residual_takes_the_rest() -> None:
    env = RewardDecomposition(Terms([{"a": 1.0}], [3.0]), {"a": "task"}, residual="rest")
    env.reset()
    assert env.step(np.zeros(1))[4]["reward_components"].tolist() == [1.0, 2.0]
    assert str(env.reward_spec) == "a (task), rest (task)"
    env = RewardDecomposition(
        Terms([{"a": 1.0}], [3.0]), {"a": "task"}, residual={"rest": "regulariser"}
    )
    assert str(env.reward_spec) == "a (task), rest (regulariser)"


def test_vectors_and_their_weights() -> None:
    components = {"vector_reward": {"speed": "task", "energy": "regulariser"}, "bonus": 2}
    info = {
        "vector_reward": np.array([2.0, -4.0]),
        "reward_weights": np.array([1.0, 0.5]),
        "bonus": 1.0,
    }
    env = RewardDecomposition(Terms([info], [1.0]), components)  # type: ignore[arg-type]
    env.reset()
    assert env.step(np.zeros(1))[4]["reward_components"].tolist() == [2.0, -2.0, 1.0]
    assert str(env.reward_spec) == "speed (task), energy (regulariser), bonus (level 2)"


@pytest.mark.parametrize(
    ("info", "reward", "message"),
    [
        (
            {"a": 1.0},
            1.0,
            "Reward component 'b' is missing: parameter `components` must name keys of `info`, "
            "found only ['a'].",
        ),
        (
            {"a": 1.0, "b": np.nan},
            1.0,
            "Reward component 'b' must be finite, found nan (a=1, b=nan).",
        ),
        (
            {"a": -np.inf, "b": 1.0},
            -np.inf,
            "Reward component 'a' must be finite, found -inf (a=-inf, b=1).",
        ),
        ({"a": [1.0, 2.0], "b": 1.0}, 1.0, '`info["a"]` must have shape (1,), found (2,).'),
        (
            {"a": 1.0, "b": 2.0},
            2.5,
            "The reward components must sum to the reward 2.5, found 3 (a=1, b=2). Name the "
            "missing terms, or collect the "
            'rest in a component of its own with `RewardDecomposition(residual="name")`.',
        ),
    ],
)
def test_wrapper_reports_faults_in_info(info: Any, reward: float, message: str) -> None:
    env = RewardDecomposition(Terms([info], [reward]), {"a": "task", "b": 1})
    env.reset()
    reported = env.step(np.zeros(1))[4]
    assert reported["reward_components_error"] == message
    assert "reward_components" not in reported


def test_tolerance_is_relative() -> None:
    for scale in (1e-6, 1.0, 1e6):
        for error, fine in ((1e-6, True), (1e-2, False)):
            info = {"a": 3 * scale, "b": -2 * scale}
            env = RewardDecomposition(
                Terms([info], [scale * (1 + error)]), {"a": "task", "b": 1}, tolerance=1e-4
            )
            env.reset()
            assert ("reward_components" in env.step(np.zeros(1))[4]) is fine
    loose = RewardDecomposition(Terms([{"a": 1.0}], [3.0]), {"a": "task"}, tolerance=np.inf)
    loose.reset()
    assert loose.step(np.zeros(1))[4]["reward_components"].tolist() == [1.0]


def test_unknown_env_without_components_lists_its_info_keys() -> None:
    message = (
        "Parameter `components` must be given for 'Terms': its reward terms are known only for "
        f"{sorted(GYMNASIUM_ENVS)}. "
        "The keys of its info are ['speed', 'torque']."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        RewardDecomposition(Terms([{"torque": 1.0, "speed": 2.0}], [3.0]))


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        (
            {"components": ["a"]},
            TypeError,
            "Parameter `components` must map info keys to levels, found ['a'].",
        ),
        (
            {"components": {"a": "x"}},
            ValueError,
            f"Unknown level 'x' of reward component 'a': {LEVELS}.",
        ),
        (
            {"components": {"a": 0}, "residual": "a"},
            ValueError,
            "Parameter `names` must be unique, found ['a'] more than once in ['a', 'a'].",
        ),
        (
            {"components": {"a": 0}, "residual": {"b": 0, "c": 0}},
            ValueError,
            "Parameter `residual` must name one component, found ['b', 'c'].",
        ),
        (
            {"components": {"a": 0}, "tolerance": -1},
            ValueError,
            "Parameter `tolerance` must be a number ≥ 0, found -1.",
        ),
    ],
)
def test_bad_wrapper_arguments(kwargs: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=exactly(message)):
        RewardDecomposition(Terms([{}], [0.0]), **kwargs)


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
        "['a', 'c'] in the env."
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

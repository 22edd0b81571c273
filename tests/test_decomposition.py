"""The wrapper: where the terms are, what they are multiplied by, and the words of every error."""

from __future__ import annotations

import json
import re
from fractions import Fraction
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.monitor import Monitor, load_results
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_gcr import GCRPPO, RewardDecomposition
from sb3_gcr.rewards.decomposition import GYMNASIUM_ENVS
from tests.envs import Terms

LEVELS = (
    "valid choices are ['regulariser', 'regularizer', 'task'] and integers from 0 (highest "
    "priority) on"
)


def exactly(message: str) -> str:
    return f"^{re.escape(message)}$"


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


# ------------------------------------------------------------ where the terms are


def report(info: Any, reward: Any, components: Any, **options: Any) -> Any:
    """The components of one step, or the sentence that says why there are none."""
    env = RewardDecomposition(Terms([info], [reward]), components, **options)
    env.reset()
    told = env.step(np.zeros(1))[4]
    return told.get("reward_components_error") or told["reward_components"].tolist()


@pytest.mark.parametrize(
    "components",
    [
        {"rewards": {"near": 0, "effort": 1}},
        {"rewards/near": 0, "rewards/effort": 1},
        {"rewards": {"near": 0}, "rewards/effort": 1},
    ],
)
def test_dictionaries_in_info_by_name_and_by_path(components: Any) -> None:
    info = {"rewards": {"effort": -0.25, "speed": 9.0, "near": 1.0}}
    assert report(info, 0.75, components) == [1.0, -0.25]


def test_paths_through_keys_with_slashes_and_dictionaries_of_dictionaries() -> None:
    info = {"log/rewards": {"a": {"near": 1.0}, "b": -0.25}}
    components = {"log/rewards/a/near": 0, "log/rewards": {"b": 1}}
    assert report(info, 0.75, components) == [1.0, -0.25]
    assert report(info, 0.75, {"log/rewards": {"a": {"near": 0}, "b": 1}}) == [1.0, -0.25]


@pytest.mark.parametrize(
    ("components", "message"),
    [
        (
            {"rewards": {"near": 0, "energy": 1}},
            "Reward component 'energy' is missing: parameter `components` must name keys of "
            "`info[\"rewards\"]`, found only ['effort', 'near'].",
        ),
        (
            {"near": 0, "effort": 1},
            "Reward component 'near' is missing: parameter `components` must name keys of `info`, "
            "found only ['rewards']. It is in `info[\"rewards\"]`.",
        ),
        (
            {"rewards": 0},
            '`info["rewards"]` must be a number, found a dictionary with the keys '
            "['effort', 'near']: name the levels of its entries, as in "
            '`components={"key": {"entry": level}}`.',
        ),
    ],
)
def test_entries_that_are_missing(components: Any, message: str) -> None:
    assert report({"rewards": {"near": 1.0, "effort": -0.25}}, 0.75, components) == message


@pytest.mark.parametrize(
    "value",
    [
        np.float32(0.5),
        np.array([0.5]),
        np.array(0.5, dtype=np.float16),
        th.tensor(0.5),
        th.tensor([0.5], requires_grad=True),
        th.tensor(0.5, dtype=th.bfloat16),
        Fraction(1, 2),
    ],
)
def test_numbers_of_all_kinds(value: Any) -> None:
    assert report({"a": value, "b": True}, 1.5, {"a": 0, "b": 1}) == [0.5, 1.0]


@pytest.mark.parametrize("reward", [np.array([1.5]), th.tensor(1.5, requires_grad=True), 1.5])
def test_sb3_gets_a_number_as_reward(reward: Any) -> None:
    env = RewardDecomposition(Terms([{"a": 0.5, "b": 1.0}], [reward]), {"a": 0, "b": 1})
    env.reset()
    assert isinstance(env.step(np.zeros(1))[1], float)


@pytest.mark.parametrize(
    ("value", "found"),
    [
        (1 + 0j, "must be a real number, found (1+0j)"),
        (th.tensor(1 + 0j), "must be a real number, found tensor(1.+0.j)"),
        (None, "must be a real number, found None"),
        ("fast", "must be a number, found the text 'fast'"),
        ([[1.0], [2.0, 3.0]], "must be a real number, found [[1.0], [2.0, 3.0]]"),
        (np.zeros(3), "must have shape (1,), found (3,)"),
    ],
)
def test_what_is_no_number_is_named(value: Any, found: str) -> None:
    assert report({"a": value, "b": 1.0}, 1.0, {"a": 0, "b": 1}) == f'`info["a"]` {found}.'


def test_a_reward_that_is_no_number() -> None:
    message = "The reward must be a number, found the text 'high'."
    assert report({"a": 1.0}, "high", {"a": 0}, residual="b") == message


def test_an_info_that_is_no_dictionary() -> None:
    class Bare(Terms):
        def step(self, action: Any) -> Any:
            return (*super().step(action)[:4], None)

    env = RewardDecomposition(Bare([{}], [1.0]), {"a": 0})
    env.reset()
    info = env.step(np.zeros(1))[4]
    assert info == {"reward_components_error": "`info` must be a dictionary, found None."}


# ------------------------------------------------------------ weights


def test_weights_by_number_by_name_and_from_the_env() -> None:
    info, names = {"pose": 2.0, "bonus": 0.5}, {"pose": 0, "bonus": 0}
    assert report(info, 12.5, names, weights=5) == [10.0, 2.5]
    assert report(info, 4.0, names, weights={"bonus": 4}) == [2.0, 2.0]

    class Told(Terms):
        weights_of_terms = {"pose": 3.0, "bonus": 4.0, "other": 9.0}  # noqa: RUF012

    env = RewardDecomposition(
        Told([info], [8.0]),
        names,
        weights=lambda env: env.unwrapped.weights_of_terms,  # type: ignore[attr-defined]
    )
    env.reset()
    assert env.step(np.zeros(1))[4]["reward_components"].tolist() == [6.0, 2.0]


def test_weights_that_the_env_does_not_have() -> None:
    message = (
        "Reward component 'bonus' is missing: parameter `components` must name keys of "
        "`weights(env)`, found only ['pose']."
    )
    names = {"pose": 0, "bonus": 0}
    info = {"pose": 2.0, "bonus": 0.5}
    assert report(info, 2.5, names, weights=lambda env: {"pose": 1.0}) == message
    message = "The reward components cannot be read: AttributeError: 'Terms' object has no "
    assert report(info, 2.5, names, weights=lambda env: env.nothing).startswith(message)


def test_weights_in_info_that_the_terms_contain_already() -> None:
    info = {"terms": np.array([2.0, -0.4]), "reward_weights": np.array([1.0, 0.1])}
    components = {"terms": {"near": 0, "effort": 1}}
    message = (
        'The terms add up to the reward without `info["reward_weights"]`, which they seem to '
        "contain already: give `RewardDecomposition(weights=1)`."
    )
    assert report(info, 1.6, components) == message
    assert report(info, 1.6, components, weights=1) == [2.0, -0.4]
    assert report(info, 1.96, components) == pytest.approx([2.0, -0.04])
    info["reward_weights"] = {"effort": 0.1, "near": 1.0}  # type: ignore[assignment]
    assert report(info, 1.96, components) == pytest.approx([2.0, -0.04])
    info["reward_weights"] = np.array([1.0])
    assert report(info, 1.96, components) == (
        '`info["reward_weights"]` must have one weight for each entry of `info["terms"]`, found '
        "(1,) for 2. Parameter `weights` takes them by name instead."
    )


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (
            {"tolerance": "1e-3"},
            TypeError,
            "Parameter `tolerance` must be a number ≥ 0, found '1e-3'. That is text: YAML needs a "
            "dot in 1.0e-2.",
        ),
        (
            {"tolerance": np.nan},
            ValueError,
            "Parameter `tolerance` must be a number ≥ 0, found nan.",
        ),
        (
            {"weights": "5"},
            TypeError,
            "Parameter `weights` must be a number, found '5'. That is text: YAML needs a dot in "
            "1.0e-2.",
        ),
        (
            {"weights": {"b": 5}},
            ValueError,
            "Parameter `weights` must have the names of components, found 'b': valid choices are "
            "['a'].",
        ),
        (
            {"weights": {"a": None}},
            TypeError,
            'Parameter `weights["a"]` must be a number, found None.',
        ),
    ],
)
def test_options_that_are_no_numbers(options: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=exactly(message)):
        RewardDecomposition(Terms([{"a": 1.0}], [1.0]), {"a": 0}, **options)


# ------------------------------------------------------------ vector rewards


class Vector(Terms):
    """Its reward is a vector, as in MO-Gymnasium."""

    reward_space = spaces.Box(-np.inf, np.inf, (2,))


@pytest.mark.parametrize(
    "components", [{"v": {"speed": 0, "energy": 1}}, {"speed": 0, "energy": 1}]
)
def test_a_vector_reward_is_taken_with_its_names(components: Any) -> None:
    env = RewardDecomposition(Vector([{}], [np.array([3.0, -0.5])]), components)  # type: ignore[list-item]
    env.reset()
    _, reward, _, _, info = env.step(np.zeros(1))
    assert reward == 2.5
    assert info["reward_components"].tolist() == [3.0, -0.5]
    assert str(env.reward_spec) == "speed (task), energy (regulariser)"
    weighted = report({}, np.array([3.0, -0.5]), components, weights={"energy": 2})
    assert weighted == [3.0, -1.0]


def test_a_vector_reward_trains() -> None:
    env = RewardDecomposition(
        Vector([{}], [np.array([3.0, -0.5])]),  # type: ignore[list-item]
        {"speed": 0, "energy": 1},
    )
    model = GCRPPO("MlpPolicy", env, n_steps=16, batch_size=16, n_epochs=1, device="cpu").learn(16)
    assert model.rollout_buffer.rewards.sum((0, 1)).tolist() == [48.0, -8.0]


def test_vector_rewards_that_are_not_taken_apart() -> None:
    vector = np.array([3.0, -0.5])
    assert report({}, vector, {"speed": 0}) == (
        "The reward is a vector of 2 entries: parameter `components` must name each of them in "
        "order, without a residual, found ['speed']."
    )
    with pytest.raises(
        ValueError,
        match=exactly(
            "Parameter `components` must be given for 'Vector': its reward is a vector of 2 "
            "entries, and needs their names in order, with levels."
        ),
    ):
        RewardDecomposition(Vector([{}], [vector]))  # type: ignore[list-item]
    with pytest.raises(
        ValueError,
        match=exactly(
            "The env's reward is a vector of 2 entries, and Monitor, which is inside, needs "
            "numbers: put it outside, as in `Monitor(RewardDecomposition(env, ...))`."
        ),
    ):
        RewardDecomposition(Monitor(Vector([{}], [vector])), {"a": 0, "b": 1})  # type: ignore[list-item]
    with pytest.raises(
        ValueError,
        match=exactly(
            "Parameter `env` must have a number as reward, found a vector of 2 entries: name them "
            'with `RewardDecomposition(env, {"first": "task", ...})`, which hands on their sum.'
        ),
    ):
        GCRPPO("MlpPolicy", Vector([{}], [vector]), device="cpu")  # type: ignore[list-item]


# ------------------------------------------------------------ what it leaves alone, and what not


class Robot(Terms):
    """Remembers what it was told to do."""

    def __init__(self) -> None:
        super().__init__([{"a": 1.0}], [1.0])
        self.told: list[str] = []

    def reset(self, **kwargs: Any) -> Any:
        self.told.append("reset")
        return super().reset(**kwargs)

    def step(self, action: Any) -> Any:
        self.told.append("step")
        return super().step(action)


def test_nothing_moves_before_it_is_asked_to() -> None:
    robot = Robot()
    message = (
        "Parameter `components` must be given for 'Robot': its reward terms are known only for "
        f"{sorted(GYMNASIUM_ENVS)}. `sb3_gcr.find_components(env)` looks for them in random steps."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        RewardDecomposition(robot)
    RewardDecomposition(robot, {"a": 0})
    assert robot.told == []


class Reused(Terms):
    """Updates one dictionary for ever; a term is gone after the first step."""

    def __init__(self) -> None:
        super().__init__([{"a": 1.0, "b": 2.0}, {"a": 1.0}], [3.0, 3.0])
        self.info: dict[str, Any] = {}

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = super().step(action)
        self.info.update(info)
        if "b" not in info:
            self.info.pop("b", None)
        return observation, reward, terminated, truncated, self.info


def test_a_reused_info_does_not_hide_the_error() -> None:
    env = RewardDecomposition(Reused(), {"a": 0, "b": 1})
    env.reset()
    assert env.step(np.zeros(1))[4]["reward_components"].tolist() == [1.0, 2.0]
    for _ in range(2):
        info = env.step(np.zeros(1))[4]
        assert "reward_components" not in info
        assert info["reward_components_error"] == (
            "Reward component 'b' is missing: parameter `components` must name keys of `info`, "
            "found only ['a']."
        )


def test_an_info_key_of_our_name_with_the_terms_of_the_env() -> None:
    info = {"reward_components": {"near": 1.0, "effort": -0.25}}
    components = {"reward_components": {"near": 0, "effort": 1}}
    assert report(info, 0.75, components) == [1.0, -0.25]


def test_monitor_writes_the_return_of_each_term(tmp_path: Any) -> None:
    """Three steps of 1 and -0.25, twice; a key of that name that the env fills itself stays."""

    class Short(Terms):
        def step(self, action: Any) -> Any:
            observation, reward, _, _, info = super().step(action)
            return observation, reward, self.t % 3 == 0, False, info

    info = {"near": 1.0, "effort": -0.25, "r_near": 7.0}
    env = RewardDecomposition(Short([info], [0.75]), {"near": 0, "effort": 1})
    monitor = Monitor(env, str(tmp_path / "m"), info_keywords=env.reward_spec.return_keys)
    for _ in range(2):
        monitor.reset()
        for _ in range(3):
            monitor.step(np.zeros(1))
    monitor.close()
    rows = load_results(str(tmp_path))
    assert rows["r"].tolist() == [2.25, 2.25]
    assert rows["r_effort"].tolist() == [-0.75, -0.75]
    assert rows["r_near"].tolist() == [7.0, 7.0]


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_every_failure_arrives_as_a_sentence(vec_env_cls: Any) -> None:
    """From a worker process, too, which would otherwise die with an empty EOFError."""
    infos = [{"rewards": {"a": 1.0}}, {"rewards": {"a": {"deep": 1.0}}}]
    components = {"rewards": {"a": 0}}
    env = vec_env_cls([lambda: RewardDecomposition(Terms(infos, [1.0, 1.0]), components, "b")])
    model = GCRPPO("MlpPolicy", env, n_steps=8, batch_size=8, device="cpu")
    message = (
        'Env index 0 at timestep 2: `info["rewards"]["a"]` must be a number, found a dictionary '
        "with the keys ['deep']: name the levels of its entries, as in "
        '`components={"key": {"entry": level}}`.'
    )
    with pytest.raises(ValueError, match=exactly(message)):
        model.learn(8)
    env.close()


# ------------------------------------------------------------ other places


def test_terms_under_a_key_or_a_path() -> None:
    info = {"log": {"rewards": {"near": 1.0, "effort": -0.25}}, "near": 9.0}
    names = {"near": 0, "effort": 1}
    assert report(info, 0.75, names, under="log/rewards") == [1.0, -0.25]
    assert report(info, 0.75, {"near": 0, "energy": 1}, under="log/rewards") == (
        "Reward component 'energy' is missing: parameter `components` must name keys of "
        "`info[\"log/rewards\"]`, found only ['effort', 'near']."
    )
    assert report(info, 0.75, names, under="near") == (
        '`info["near"]` must be a dictionary of terms by name, found 9.0.'
    )
    assert report(info, 0.75, names, under="rewards") == (
        'Parameter `under` must be a key of `info` with a dictionary of terms, found no "rewards" '
        "among ['log', 'near']."
    )


def test_running_totals() -> None:
    """1, 3 and 6 in total are 1, 2 and 3 a step, and from the start again after a reset."""
    infos = [{"a": 1.0, "b": -1.0}, {"a": 3.0, "b": -2.0}, {"a": 6.0, "b": -3.0}]
    env = RewardDecomposition(Terms(infos, [0.0, 1.0, 2.0]), {"a": 0, "b": 1}, cumulative=True)
    for _ in range(2):
        env.reset()
        env.unwrapped.t = 0  # type: ignore[attr-defined]
        rows = [env.step(np.zeros(1))[4]["reward_components"].tolist() for _ in range(3)]
        assert rows == [[1, -1], [2, -1], [3, -1]]


def test_running_totals_that_do_not_start_with_0() -> None:
    class Starting(Terms):
        def reset(self, **kwargs: Any) -> Any:
            return super().reset(**kwargs)[0], {"a": 5.0}

    env = RewardDecomposition(Starting([{"a": 6.0}], [1.0]), {"a": 0}, cumulative=True)
    env.reset()
    assert env.step(np.zeros(1))[4]["reward_components"].tolist() == [1.0]


def test_running_totals_that_nobody_announced() -> None:
    infos = [{"a": 2.0, "b": -1.0}, {"a": 5.0, "b": -2.0}]
    env = RewardDecomposition(Terms(infos, [1.0, 2.0]), {"a": 0, "b": 1})
    env.reset()
    env.step(np.zeros(1))
    assert env.step(np.zeros(1))[4]["reward_components_error"] == (
        "The terms are running totals: the reward is by how much they have grown since the step "
        "before. Give `RewardDecomposition(cumulative=True)`."
    )


def test_terms_of_a_function() -> None:
    names = {"near": 0, "effort": 1}
    info = {"x": 2.0}

    def terms(env: gym.Env[Any, Any], info: dict[str, Any]) -> dict[str, float]:
        return {"near": info["x"], "effort": -float(env.unwrapped.t)}  # type: ignore[attr-defined]

    assert report(info, 1.0, names, terms=terms) == [2.0, -1.0]
    assert report(info, 1.0, names, terms=lambda env, info: info["y"]) == (
        "The reward components cannot be read: KeyError: 'y'."
    )
    assert report(info, 1.0, names, terms=lambda env, info: 3) == (
        "`terms(env, info)` must be a dictionary of terms by name, found 3."
    )


class Calling(Terms):
    """Its terms are what methods return; one is called twice a step, one only sometimes."""

    class Part:
        def bonus(self) -> float:
            return 10.0

    def __init__(self) -> None:
        super().__init__([{}], [0.0])
        self.part = self.Part()

    def near(self, x: float) -> float:
        return x

    def step(self, action: Any) -> Any:
        observation, _, terminated, truncated, info = super().step(action)
        reward = self.near(1.0) + self.near(0.5)
        if self.t == 2:
            reward += self.part.bonus()
        return observation, reward, terminated, truncated, info


def test_terms_that_methods_return() -> None:
    calls = {"near": "near", "bonus": "part.bonus"}
    env = RewardDecomposition(Calling(), {"near": 0, "bonus": 0}, calls=calls)
    env.reset()
    env.unwrapped.near(99.0)  # type: ignore[attr-defined]
    rows = [env.step(np.zeros(1))[4]["reward_components"].tolist() for _ in range(3)]
    assert rows == [[1.5, 0], [1.5, 10], [1.5, 0]]
    env = RewardDecomposition(Calling(), {"near": 0}, residual="bonus", calls=["near"])
    env.reset()
    assert env.step(np.zeros(1))[4]["reward_components"].tolist() == [1.5, 0]


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (
            {"calls": ["nera"]},
            ValueError,
            "Parameter `calls` must name methods of Calling, found 'nera'. Did you mean one of "
            "['near', …",
        ),
        (
            {"calls": {"near": "part.nothing"}},
            ValueError,
            "Parameter `calls` must name methods of Calling, found 'part.nothing'.…",
        ),
        (
            {"calls": "near"},
            TypeError,
            "Parameter `calls` must be a list of method names, or such names by component, found "
            "'near'.",
        ),
        (
            {"calls": ["near"], "under": "rewards"},
            ValueError,
            "Parameters `under`, `terms` and `calls` each say where the terms are: give one of "
            "them, found `under` and `calls`.",
        ),
    ],
)
def test_places_that_are_none(options: Any, error: Any, message: str) -> None:
    pattern = re.escape(message).replace("…", ".*")
    with pytest.raises(error, match=f"^{pattern}$"):
        RewardDecomposition(Calling(), {"near": 0}, **options)

"""HideObservations: what is hidden, when, and what is refused."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from sb3_gcr.envs import HideObservations


class Counting(gym.Env[Any, Any]):
    """Shows the number of observations so far, four times over, plus 0, 1, 2, 3."""

    observation_space: spaces.Space[Any] = spaces.Box(1, np.inf, (4,), np.float64)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.n = 1
        return self.n + np.arange(4.0), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.n += 1
        return self.n + np.arange(4.0), 0.0, False, False, {}


def watch(env: gym.Env[Any, Any], n_steps: int) -> list[list[float]]:
    seen = [env.reset()[0].tolist()]
    return seen + [env.step(0)[0].tolist() for _ in range(n_steps)]


def test_entries_are_hidden_always() -> None:
    env = HideObservations(Counting(), [1, -1])
    for _ in range(2):
        assert watch(env, 2) == [[1, 0, 3, 0], [2, 0, 4, 0], [3, 0, 5, 0]]


def test_entries_are_shown_at_the_start_of_every_episode() -> None:
    env = HideObservations(Counting(), [0], after=2)
    for _ in range(2):
        assert watch(env, 2) == [[1, 2, 3, 4], [2, 3, 4, 5], [0, 4, 5, 6]]


def test_the_env_itself_is_left_alone_and_zero_is_in_the_space() -> None:
    inner = Counting()
    env = HideObservations(inner, [1])
    assert env.observation_space.low.tolist() == [1, 0, 1, 1]  # type: ignore[attr-defined]
    assert env.observation_space.dtype == np.float64
    assert all(np.array(seen) in env.observation_space for seen in watch(env, 3))
    assert inner.n == 4


def test_it_can_be_made_again_from_its_spec() -> None:
    env = HideObservations(gym.make("CartPole-v1"), [1, 3], after=1)
    again: Any = gym.make(env.spec)  # type: ignore[arg-type]
    assert (again.get_wrapper_attr("indices"), again.get_wrapper_attr("after")) == ([1, 3], 1)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"indices": [0, 4, -5]},
            "Parameter `indices` must be numbers from -4 to 3, found [4, -5].",
        ),
        (
            {"indices": [0], "after": -1},
            "Parameter `after` must be an integer ≥ 0, found -1.",
        ),
    ],
)
def test_bad_arguments(given: Any, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        HideObservations(Counting(), **given)


def test_other_observations_are_refused() -> None:
    env = Counting()
    env.observation_space = spaces.Discrete(3)
    message = (
        "Parameter `env` must have observations that are vectors (a Box of one axis), found "
        "Discrete(3)."
    )
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        HideObservations(env, [0])


def test_the_table_of_the_docs_is_what_was_stored() -> None:
    docs = Path(__file__).parents[1] / "docs"
    text = (docs / "recurrent.md").read_text().replace("−", "-")
    runs = json.loads((docs / "data/memory.json").read_text())["runs"]
    assert [len(run["points"]) for run in runs] == [37] * 4
    for run in runs:
        point = run["points"][-1]
        names = ("reward_survive", "distance_penalty", "velocity_penalty")
        terms = [point[name] for name in names]
        figures = " | ".join([f"{sum(terms):.0f}", *map(str, terms)])
        assert f"| `{run['algorithm']}` | {run['seed']} | {figures} |" in text

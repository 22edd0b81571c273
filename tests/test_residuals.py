"""A residual that hides a mistake is told, with the factor; one that is a term is not."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from sb3_gcr import GCRPPO, RewardDecomposition, RewardSpec, evaluate_components
from sb3_gcr.rewards.residuals import ResidualWatch, explain_residual

Made = Callable[[np.random.Generator, int], "tuple[dict[str, float], float]"]


class Env(gym.Env[Any, Any]):
    """Says whatever terms and reward a function makes of a generator and the step's number."""

    observation_space = spaces.Box(-1, 1, (1,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, make: Made):
        self.make = make

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.t = 0
        self.totals = np.zeros(2)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        info, reward = self.make(self.np_random, self.t)
        return np.zeros(1, np.float32), reward, False, self.t >= 40, info


def draw(rng: np.random.Generator) -> tuple[float, float]:
    return float(rng.uniform(0, 1)), -float(rng.exponential(0.3))


def forgotten_factor(rng: np.random.Generator, t: int) -> Any:
    a, b = draw(rng)
    return {"a": a, "b": b}, 5 * (a + b)


def unweighted(rng: np.random.Generator, t: int) -> Any:
    a, b = draw(rng)
    return {"a": a, "b": b}, 4 * a + 0.5 * b + 0.3


def wrong_sign(rng: np.random.Generator, t: int) -> Any:
    a, b = draw(rng)
    return {"a": a, "b": -b}, a + b


def wrong_sign_and_more(rng: np.random.Generator, t: int) -> Any:
    a, b = draw(rng)
    return {"a": a, "b": -b}, a + b + 0.02 * float(rng.normal())


def not_in_the_reward(rng: np.random.Generator, t: int) -> Any:
    a, b = draw(rng)
    return {"a": a, "b": b}, a


def nothing_in_the_reward(rng: np.random.Generator, t: int) -> Any:
    """As AntMaze: a bonus of 1 for surviving is in the info, the reward is sparse."""
    return {"a": 1.0, "b": -0.01 * float(rng.uniform())}, float(t == 30)


def make_totals() -> Made:
    totals = np.zeros(2)

    def running_totals(rng: np.random.Generator, t: int) -> Any:
        grown = np.array(draw(rng))
        totals[:] = grown + (totals if t > 1 else 0)
        return {"a": totals[0], "b": totals[1]}, float(grown.sum())

    return running_totals


START = "The residual 'rest' "
TOLD: list[tuple[Made, str]] = [
    (
        forgotten_factor,
        START + "follows from the other terms: the reward is 5 x their sum. Give "
        "`RewardDecomposition(weights=5)` and leave `residual` out, if it has nothing else to "
        "take.",
    ),
    (
        unweighted,
        START + "follows from the other terms: the reward is 4 x a + 0.5 x b, and the residual "
        "hides it. Give `RewardDecomposition(weights={'a': 4.0, 'b': 0.5})`.",
    ),
    (
        wrong_sign,
        START + "follows from the other terms: the reward is 1 x a + -1 x b, and the residual "
        "hides it. Give `RewardDecomposition(weights={'a': 1.0, 'b': -1.0})`.",
    ),
    (wrong_sign_and_more, START + "follows (99.…% of it) from the other terms: the reward is …"),
    (
        not_in_the_reward,
        START + "follows from the other terms: the reward is 1 x a, and the residual hides it. It "
        "does not contain 'b': leave that out. Give `RewardDecomposition(weights={'a': 1.0})`.",
    ),
    (
        nothing_in_the_reward,
        START + "cancels the other terms: in a step they paid 0.995, it -0.9…, and the reward is "
        "what is left, 0.02…. They seem not to be in the reward, or not with this sign and factor.",
    ),
    (
        make_totals(),
        START + "takes back what the other terms have paid before: they are running totals, and "
        "the reward is their increase. Give `RewardDecomposition(cumulative=True)` and leave "
        "`residual` out.",
    ),
]


def pattern(message: str) -> str:
    return "^" + re.escape(message).replace("…", ".*") + "$"


def wrap(make: Made) -> gym.Env[Any, Any]:
    return RewardDecomposition(Env(make), {"a": 0, "b": 1}, residual="rest")


@pytest.mark.parametrize(("make", "message"), TOLD)
def test_training_tells_once_after_the_first_few_hundred_steps(make: Made, message: str) -> None:
    model = GCRPPO(
        "MlpPolicy", wrap(make), n_steps=200, batch_size=200, n_epochs=1, seed=0, device="cpu"
    )
    model.learn(200)
    with pytest.warns(UserWarning, match=pattern(message)) as told:
        model.learn(200, reset_num_timesteps=False)
    assert len(told) == 1
    model.learn(400, reset_num_timesteps=False)


@pytest.mark.parametrize(("make", "message"), TOLD)
def test_an_evaluation_tells_too(make: Made, message: str) -> None:
    model = GCRPPO("MlpPolicy", wrap(make), n_steps=40, batch_size=40, device="cpu")
    env = wrap(make)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match=pattern(message)) as told:
        evaluate_components(model, env, 3, warn=False)
    assert len(told) == 1


def healthy(rng: np.random.Generator, t: int) -> Any:
    a, b = draw(rng)
    return {"a": a, "b": b}, a + b + float(np.sin(t))


def alive(rng: np.random.Generator, t: int) -> Any:
    a, b = draw(rng)
    return {"a": a, "b": b}, a + b + 1


def complete(rng: np.random.Generator, t: int) -> Any:
    a, b = draw(rng)
    return {"a": a, "b": b}, a + b


def constants(rng: np.random.Generator, t: int) -> Any:
    return {"a": 2.0, "b": 0.0}, 3.0


@pytest.mark.parametrize("make", [healthy, alive, complete, constants])
def test_a_residual_that_is_a_term_is_not_told(make: Made) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        GCRPPO(
            "MlpPolicy", wrap(make), n_steps=400, batch_size=400, n_epochs=1, device="cpu"
        ).learn(400)


def test_an_env_of_gymnasium_with_a_residual_is_not_told() -> None:
    env = RewardDecomposition(gym.make("Hopper-v5"), {"reward_forward": 0}, residual="rest")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        GCRPPO("MlpPolicy", env, n_steps=400, batch_size=400, n_epochs=1, device="cpu").learn(400)


def test_copies_of_a_term_are_told_as_one() -> None:
    """b is a copy of a, and the reward is 3a: there is no telling a weight of b from one of a."""
    a = np.random.default_rng(0).uniform(size=(100, 1))
    steps = np.stack([a, a, 3 * a - 2 * a], axis=2)
    told = explain_residual(steps, RewardSpec(("a", "b", "rest"), (0, 0, 1)), "rest")
    assert told is not None
    assert "the reward is 2 x a," in told


def test_many_terms_need_many_steps() -> None:
    """With as many terms as rows every residual follows from them."""
    names = tuple(f"t{index}" for index in range(200))
    watch = ResidualWatch(RewardSpec(names, (0,) * 200), "t199")
    rng = np.random.default_rng(0)
    told = [watch.add(rng.normal(size=(20, 200))) for _ in range(60)]
    assert told == [None] * 60

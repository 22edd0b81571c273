"""Small envs that report their terms as other people's packages do; docs/your_own_reward.md has the
recipes.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

Step = tuple[float, dict[str, Any]]


class StandIn(gym.Env[Any, Any]):
    """A cart whose subclasses make a reward and an info of what it does."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = spaces.Box(-1, 1, (2,), np.float32)
    limit = 50

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.v, self.t = float(self.np_random.uniform(-1, 1)), 0.0, 0
        self.start()
        return self.observe(), {}

    def start(self) -> None: ...

    def observe(self) -> Any:
        return np.array([self.x, self.v], np.float32)

    def step(self, action: Any) -> Any:
        self.t += 1
        self.force = float(action[0])
        self.v += 0.1 * self.force - 0.05 * self.v
        self.x += 0.1 * self.v
        reward, info = self.pay(action)
        return self.observe(), reward, False, self.t >= self.limit, info

    def pay(self, action: Any) -> Step:
        raise NotImplementedError


class Myo(StandIn):
    """MyoSuite: ``info["rwd_dict"]`` unweighted, with the total, flat copies of some, and the
    weights in an attribute; ``penalty`` does not occur.
    """

    rwd_keys_wt = {"pose": 1.0, "bonus": 4.0, "act_reg": 1.0, "penalty": 50.0}  # noqa: RUF012

    def pay(self, action: Any) -> Step:
        pose, effort = -abs(self.x), -float(np.linalg.norm(action)) / 2
        terms = {
            "pose": pose,
            "bonus": 1.0 * (pose > -0.5) + 1.0 * (pose > -0.25),
            "act_reg": effort,
            "penalty": -1.0 * (pose < -99),
            "sparse": 10 * pose,
            "solved": pose > -0.1,
            "done": False,
        }
        terms["dense"] = sum(weight * terms[key] for key, weight in self.rwd_keys_wt.items())
        info = {"rwd_dense": terms["dense"], "rwd_sparse": terms["sparse"], "time": self.t}
        return terms["dense"], {**info, "solved": terms["solved"], "rwd_dict": terms}


class MetaWorld(StandIn):
    """MetaWorld's drawer-open: two flat terms, the reward is five times their sum."""

    def pay(self, action: Any) -> Step:
        grasp, place = float(np.exp(-abs(self.x))), float(np.tanh(self.v) ** 2)
        reward = 5 * (grasp + place)
        info = {
            "success": 0.0,
            "near_object": float(abs(self.x) < 0.3),
            "grasp_success": 0.0,
            "grasp_reward": grasp,
            "in_place_reward": place,
            "obj_to_target": abs(self.x - 2),
            "unscaled_reward": reward,
        }
        return reward, info


class Merge(StandIn):
    """highway-env's merge: ``info["rewards"]`` unweighted, weights among other things in a
    dictionary of settings, the sum then brought to [0, 1].
    """

    config = {  # noqa: RUF012
        "lanes": 3,
        "collision_reward": -1.0,
        "right_lane_reward": 0.1,
        "high_speed_reward": 0.2,
        "show": False,
        "observation": {"type": "x"},
    }

    def pay(self, action: Any) -> Step:
        terms = {
            "collision_reward": float(abs(self.x) > 0.9),
            "right_lane_reward": float(self.x > 0),
            "high_speed_reward": float(np.clip(self.v, 0, 1)),
        }
        reward = sum(self.config[name] * value for name, value in terms.items())  # type: ignore[misc]
        return (reward + 1) / 1.3, {"speed": self.v, "crashed": False, "rewards": terms}


class Intersection(Merge):
    """highway-env's intersection: the sum only counts on the road; nobody is always on it."""

    def pay(self, action: Any) -> Step:
        _, info = super().pay(action)
        terms = info["rewards"]
        terms["on_road"] = float(self.force > 0)
        named = ("collision_reward", "high_speed_reward")
        reward = sum(self.config[name] * terms[name] for name in named)  # type: ignore[misc]
        return reward * terms["on_road"], info


def gated(env: Any, info: dict[str, Any]) -> dict[str, float]:
    """The terms of Intersection."""
    terms, config = info["rewards"], env.unwrapped.config
    named = ("collision_reward", "high_speed_reward")
    return {name: config[name] * terms[name] * terms["on_road"] for name in named}


class Sustain(StandIn):
    """SustainGym: running totals of an episode."""

    def start(self) -> None:
        self.totals = np.zeros(2)

    def pay(self, action: Any) -> Step:
        terms = np.array([float(np.exp(-abs(self.x))), -0.1 * self.force**2])
        self.totals += terms
        breakdown = dict(zip(("comfort", "energy"), self.totals.tolist(), strict=True))
        return float(terms.sum()), {"reward_breakdown": breakdown}


class BlueSky(StandIn):
    """bluesky-gym: the terms are what methods return, the info has the running total."""

    def start(self) -> None:
        self.total_reward = 0.0

    def _check_drift(self) -> float:
        return -0.1 * abs(self.x)

    def _check_waypoint(self) -> float:
        return 1.0 if abs(self.x) < 0.2 else 0.0

    def pay(self, action: Any) -> Step:
        reward = self._check_waypoint() + self._check_drift()
        self.total_reward += reward
        return reward, {"total_reward": self.total_reward}


class Lift(StandIn):
    """robosuite: nothing in the info; terms have to be made of what the env knows."""

    def pay(self, action: Any) -> Step:
        self.is_grasping = self.x > 0
        return 1 - float(np.tanh(10 * abs(self.x))) + 0.25 * self.is_grasping, {}


def lift_terms(env: Any, info: dict[str, Any]) -> dict[str, float]:
    """The terms of Lift."""
    reaching = 1 - float(np.tanh(10 * abs(env.unwrapped.x)))
    return {"reaching": reaching, "grasping": 0.25 * env.unwrapped.is_grasping}


class Motor(StandIn):
    """gym-electric-motor: the info is empty, an object keeps the terms."""

    class RewardFunction:
        terms: dict[str, float]

        def __call__(self, x: float, force: float) -> float:
            self.terms = {"speed": -abs(x), "current": -0.1 * force**2}
            return sum(self.terms.values())

    def __init__(self) -> None:
        self.reward_function = self.RewardFunction()

    def pay(self, action: Any) -> Step:
        return self.reward_function(self.x, self.force), {}


class AntMaze(StandIn):
    """gymnasium-robotics' AntMaze: the info has the terms of another reward."""

    def pay(self, action: Any) -> Step:
        info = {"reward_forward": self.v, "reward_survive": 1.0, "reward_ctrl": -(self.force**2)}
        return float(abs(self.x - 0.5) < 0.1), info

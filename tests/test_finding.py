"""find_components: terms and weights exactly or not at all, and no decoys."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

import sb3_gcr
from sb3_gcr import GCRPPO, RewardDecomposition, find_components
from sb3_gcr.rewards import finding
from sb3_gcr.rewards.decomposition import GYMNASIUM_ENVS
from tests import stand_ins
from tests.envs import SPEC, Env, Terms

TERMS_OF_TABLE = {env_id: set(entry["components"]) for env_id, entry in GYMNASIUM_ENVS.items()}


def errors(env: gym.Env[Any, Any], n_steps: int = 120) -> list[str]:
    """What is wrong with the components of random steps."""
    env.action_space.seed(7)
    env.reset(seed=7)
    found = []
    for _ in range(n_steps):
        _, _, terminated, truncated, info = env.step(env.action_space.sample())
        if "reward_components_error" in info:
            found.append(info["reward_components_error"])
        if terminated or truncated:
            env.reset()
    return found


@pytest.mark.parametrize("env_id", GYMNASIUM_ENVS)
def test_gymnasiums_envs_have_the_terms_of_the_table(env_id: str) -> None:
    found = find_components(env_id)
    assert set(found.weights) == TERMS_OF_TABLE[env_id]
    assert found.line == "env = RewardDecomposition(env)"
    assert set(found.weights.values()) == {1.0}


@pytest.mark.parametrize("env_id", sorted(set(GYMNASIUM_ENVS) - {"InvertedPendulum-v5"}))
def test_they_are_found_without_the_table_too(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """InvertedPendulum's one term is the reward itself, which takes nothing apart."""
    monkeypatch.setattr(finding, "GYMNASIUM_ENVS", {})
    found = find_components(gym.make(env_id))
    assert set(found.weights) == TERMS_OF_TABLE[env_id]
    assert set(found.weights.values()) == {1.0}
    env = gym.make(env_id)
    assert errors(found.wrap(env)) == []


FOUND: list[tuple[Any, dict[str, float], str]] = [
    (
        stand_ins.Myo,
        {"pose": 1, "bonus": 4, "act_reg": 1, "penalty": 50},
        'env = RewardDecomposition(env, {"pose": "task", "bonus": "task", "act_reg": '
        '"regulariser", "penalty": "regulariser"}, under="rwd_dict", weights=lambda env: '
        "env.unwrapped.rwd_keys_wt)  # levels are guesses",
    ),
    (
        stand_ins.MetaWorld,
        {"grasp_reward": 5, "in_place_reward": 5},
        'env = RewardDecomposition(env, {"grasp_reward": "task", "in_place_reward": "task"}, '
        "weights=5)  # levels are guesses",
    ),
    (
        stand_ins.Merge,
        {
            "collision_reward": -1 / 1.3,
            "right_lane_reward": 0.1 / 1.3,
            "high_speed_reward": 0.2 / 1.3,
        },
        'env = RewardDecomposition(env, {"collision_reward": "regulariser", "right_lane_reward": '
        '"task", "high_speed_reward": "task"}, under="rewards", weights=lambda env: {name: '
        '0.769230769231 * env.unwrapped.config[name] for name in ["collision_reward", '
        '"right_lane_reward", "high_speed_reward"]}, residual={"offset": "regulariser"})  # levels '
        "are guesses",
    ),
    (
        stand_ins.Sustain,
        {"comfort": 1, "energy": 1},
        'env = RewardDecomposition(env, {"comfort": "task", "energy": "regulariser"}, '
        'under="reward_breakdown", cumulative=True)  # levels are guesses',
    ),
]


@pytest.mark.parametrize(("make", "weights", "line"), FOUND)
def test_packages_of_others(make: Any, weights: dict[str, float], line: str) -> None:
    found = find_components(make())
    assert found.weights == pytest.approx(weights)
    assert found.line == line
    assert found.is_complete
    assert line in str(found)
    assert errors(found.wrap(make())) == []
    namespace = {"env": make(), "RewardDecomposition": RewardDecomposition}
    exec(line, namespace)
    assert errors(namespace["env"]) == []  # type: ignore[arg-type]


def test_what_never_paid_is_said() -> None:
    found = find_components(stand_ins.Myo())
    assert found.unseen == ["penalty"]
    assert "Not seen, because always 0: penalty." in found.sentence


def test_what_is_always_paid_cannot_be_told_apart() -> None:
    found = find_components(stand_ins.Merge())
    assert (
        "0.769231 is paid always; which term that is cannot be told apart, and 'offset' takes it."
        in found.sentence
    )


NOT_FOUND = [stand_ins.Intersection, stand_ins.BlueSky, stand_ins.Lift, stand_ins.Motor]


@pytest.mark.parametrize("make", [*NOT_FOUND, stand_ins.AntMaze])
def test_what_does_not_add_up_is_not_proposed(make: Any) -> None:
    found = find_components(make())
    assert not found.is_complete
    assert (found.line, found.arguments, found.weights) == ("", {}, {})
    assert found.sentence.startswith("No numbers in info add up to the reward in 200 random steps")
    message = f"Nothing was found to wrap '{make.__name__}' with.\n{found.sentence}"
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        found.wrap(make())


RECIPES: list[tuple[Any, dict[str, Any]]] = [
    (
        stand_ins.Myo,
        {
            "components": {"pose": 0, "bonus": 0, "act_reg": 1, "penalty": 0},
            "under": "rwd_dict",
            "weights": lambda env: env.unwrapped.rwd_keys_wt,
        },
    ),
    (stand_ins.MetaWorld, {"components": {"grasp_reward": 0, "in_place_reward": 0}, "weights": 5}),
    (
        stand_ins.Intersection,
        {
            "components": {"collision_reward": 0, "high_speed_reward": 1},
            "terms": stand_ins.gated,
        },
    ),
    (
        stand_ins.Sustain,
        {
            "components": {"comfort": 0, "energy": 1},
            "under": "reward_breakdown",
            "cumulative": True,
        },
    ),
    (
        stand_ins.BlueSky,
        {
            "components": {"_check_drift": 1, "_check_waypoint": 0},
            "calls": ["_check_drift", "_check_waypoint"],
        },
    ),
    (
        stand_ins.BlueSky,
        {
            "components": {"drift": 1, "waypoint": 0},
            "calls": {"drift": "_check_drift", "waypoint": "_check_waypoint"},
        },
    ),
    (
        stand_ins.Lift,
        {"components": {"reaching": 0, "grasping": 0}, "terms": stand_ins.lift_terms},
    ),
    (
        stand_ins.Motor,
        {
            "components": {"speed": 0, "current": 1},
            "terms": lambda env, info: env.unwrapped.reward_function.terms,
        },
    ),
]


@pytest.mark.parametrize(("make", "arguments"), RECIPES)
def test_recipes(make: Any, arguments: dict[str, Any]) -> None:
    assert errors(RewardDecomposition(make(), **arguments)) == []
    env = RewardDecomposition(make(), **arguments)
    model = GCRPPO("MlpPolicy", env, n_steps=64, n_epochs=1, device="cpu").learn(64)
    assert model.n_components == len(arguments["components"])


# ------------------------------------------------------------ decoys


class Decoys(stand_ins.StandIn):
    """Two terms among everything that can be taken for one."""

    def __init__(self, weights: tuple[float, float] = (1.0, 1.0), more: Any = None):
        self.weights, self.more = weights, more or {}

    def pay(self, action: Any) -> Any:
        near, effort = float(np.exp(-abs(self.x))), -float(np.square(action).sum())
        reward = self.weights[0] * near + self.weights[1] * effort
        info = {
            "reward_near_again": near,
            "reward_near": near,
            "reward_effort": effort,
            "reward_effort_scaled": 0.1 * effort,
            "reward_total": reward,
            "reward_other_policy": float(np.sin(self.t)),
            "reward_scale": 1.0,
            "reward_sum": near + effort,
            "x": self.x,
            "observation": np.arange(5) + self.x,
            "image": np.zeros((4, 4)),
            "text": "reward",
        }
        return reward, info


@pytest.mark.parametrize("weights", [(1.0, 1.0), (2.0, 2.0), (4.0, 0.5), (1.0, 12.345678)])
def test_decoys_are_not_proposed(weights: tuple[float, float]) -> None:
    """A copy, a total, the reward, a constant, a term of another reward; of copies one is taken."""
    found = find_components(Decoys(weights))
    assert len(found.weights) == 2
    near, effort = found.weights
    assert near in ("reward_near", "reward_near_again")
    assert effort in ("reward_effort", "reward_effort_scaled")
    factor = 1 if effort == "reward_effort" else 10
    assert found.weights == pytest.approx({near: weights[0], effort: factor * weights[1]})
    assert errors(found.wrap(Decoys(weights))) == []


def test_a_column_of_which_no_weight_is_needed_is_preferred() -> None:
    found = find_components(Decoys((1.0, 0.1)))
    assert found.weights == {"reward_near_again": 1.0, "reward_effort_scaled": 1.0}


def test_names_that_sound_like_terms_come_first() -> None:
    class Velocity(stand_ins.StandIn):
        def pay(self, action: Any) -> Any:
            effort = -float(np.square(action).sum())
            info = {"velocity": self.v, "reward_forward": self.v, "b": effort}
            return 2 * self.v + effort, info

    assert find_components(Velocity()).weights == {"reward_forward": 2.0, "b": 1.0}


def test_a_constant_that_is_a_term() -> None:
    class Alive(stand_ins.StandIn):
        def pay(self, action: Any) -> Any:
            info = {"reward_alive": 5.0, "reward_limit": 7.0, "reward_forward": self.v}
            return 5 + 2 * self.v, info

    found = find_components(Alive())
    assert found.weights == {"reward_alive": 1.0, "reward_forward": 2.0}
    assert "Constants cannot be told apart: reward_alive, reward_limit." in found.sentence


def test_a_term_that_is_there_in_some_steps_only() -> None:
    class Sometimes(stand_ins.StandIn):
        def pay(self, action: Any) -> Any:
            near, effort = float(np.exp(-abs(self.x))), -float(np.square(action).sum())
            info = {"reward_near": near, "effort": effort, "cost": 0.0}
            bonus = 1.0 if self.t == 50 else 0.0
            return near + effort, {**info, **({"bonus": bonus} if bonus else {})}

    found = find_components(Sometimes())
    assert found.weights == {"reward_near": 1.0, "effort": 1.0, "cost": 1.0}
    assert found.unseen == ["cost"]
    assert found.sentence.endswith("Not there in every step: bonus.")


def test_terms_in_single_precision() -> None:
    class Single(stand_ins.StandIn):
        def pay(self, action: Any) -> Any:
            a, b = np.float32(np.exp(-abs(self.x))), np.float32(-np.square(action).sum())
            return float(np.float32(0.3) * a + np.float32(0.7) * b), {"reward_a": a, "reward_b": b}

    found = find_components(Single())
    assert found.weights == pytest.approx({"reward_a": 0.3, "reward_b": 0.7}, rel=1e-4)
    assert errors(found.wrap(Single())) == []


def test_a_vector_with_weights_beside_it() -> None:
    class Linear(stand_ins.StandIn):
        def pay(self, action: Any) -> Any:
            vector = np.array([self.v, -(self.force**2)])
            weights = np.array([1.0, 0.1])
            info = {
                "vector_reward": vector,
                "reward_weights": weights,
                "position": [self.x, self.v],
            }
            return float(vector @ weights), info

    found = find_components(Linear())
    assert found.arguments == {
        "components": {
            "vector_reward": {"vector_reward_0": "task", "vector_reward_1": "regulariser"}
        }
    }
    assert errors(found.wrap(Linear())) == []


def test_terms_that_the_env_keeps() -> None:
    class Keeps(stand_ins.StandIn):
        def pay(self, action: Any) -> Any:
            self.reward_terms = {"near": float(np.exp(-abs(self.x))), "effort": -(self.force**2)}
            return sum(self.reward_terms.values()), {}

    found = find_components(Keeps())
    assert found.weights == {"near": 1.0, "effort": 1.0}
    assert "terms=lambda env, info: env.unwrapped.reward_terms" in found.line
    assert errors(found.wrap(Keeps())) == []


# ------------------------------------------------------------ what it does not look into


def test_an_env_that_reports_its_components() -> None:
    found = find_components(Env())
    assert found.is_complete
    assert found.line == ""
    assert found.sentence == (
        f"The env reports its components itself: {SPEC}. Nothing needs to be wrapped."
    )


def test_a_vector_reward_and_a_vec_env_and_too_few_steps() -> None:
    found = find_components(Terms([{}], [np.array([3.0, -0.5])]))  # type: ignore[list-item]
    assert found.sentence == (
        'The reward is a vector of 2 entries: `RewardDecomposition(env, {"first": "task", ...})` '
        "names them in order."
    )
    with pytest.raises(TypeError, match=r"must be an env of Gymnasium, found a DummyVecEnv"):
        find_components(DummyVecEnv([Env]))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="Parameter `n_steps` must be an integer ≥ 10, found 3"):
        find_components(Env(), n_steps=3)


def test_two_looks_are_the_same_and_it_is_public() -> None:
    assert str(find_components(Decoys())) == str(find_components(Decoys()))
    assert sb3_gcr.find_components is find_components


def test_the_table() -> None:
    table = str(find_components(stand_ins.MetaWorld(), 50)).splitlines()
    assert table[0] == "MetaWorld"
    assert table[2].split() == ["number", "smallest", "mean", "largest", "not", "0", "weight"]
    rows = {row.split()[0]: row.split()[1:] for row in table[3:10]}
    assert rows["success"] == ["0", "0", "0", "0%"]
    assert rows["grasp_reward"][-2:] == ["100%", "5"]
    assert len(rows["obj_to_target"]) == 4


@pytest.mark.parametrize(
    ("package", "make"),
    [
        ("highway_env", lambda: gym.make("merge-v1" if "merge-v1" in gym.registry else "merge-v0")),
        ("mo_gymnasium", lambda: linear_hopper()),
    ],
)
def test_the_packages_themselves(package: str, make: Callable[[], Any]) -> None:
    pytest.importorskip(package)
    found = find_components(make(), 60)
    assert found.is_complete
    assert errors(found.wrap(make()), 60) == []


def linear_hopper() -> gym.Env[Any, Any]:
    import mo_gymnasium
    from mo_gymnasium.wrappers import LinearReward

    env: gym.Env[Any, Any] = mo_gymnasium.make("mo-hopper-v5")
    return LinearReward(env, weight=np.array([1.0, 0.5, 0.1]))

"""Simulators with a reward manager as a VecEnv, on a stub with the attributes of mjlab's and
IsaacLab's envs.
"""

from __future__ import annotations

import re
import warnings
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gcr import GCRPPO, RewardSpec, simulators
from sb3_gcr.simulators import ManagerVecEnv
from sb3_gcr.simulators.manager_terms import guess_levels
from sb3_gcr.simulators.managers import ManagerVecEnv as SameVecEnv

DT = 0.5
LEVELS = {"near": "task", "effort": "regulariser", "spare": 1}
#: Where the terminal observation comes from, by the dialect of the stub.
SOURCES = {"mjlab": "step", "isaac3": "final_obs", "isaac2": "previous"}


class Manager:
    """Values × weights in a buffer that the next step overwrites, summed into another."""

    def __init__(self, n_envs: int, weights: dict[str, float], dialect: str):
        self.active_terms = list(weights)
        self.weights = {name: SimpleNamespace(weight=weight) for name, weight in weights.items()}
        self._step_reward = th.zeros(n_envs, len(weights))
        self.reward = th.zeros(n_envs)
        self.zeroes_nan = dialect == "mjlab"
        self.leaves_stale = dialect == "isaac2"
        if dialect == "mjlab":
            self._scale_by_dt = True

    def get_term_cfg(self, name: str) -> Any:
        return self.weights[name]

    def compute(self, values: list[th.Tensor]) -> th.Tensor:
        total = th.zeros_like(self.reward)
        for column, name in enumerate(self.active_terms):
            weight = self.weights[name].weight
            if weight == 0 and self.leaves_stale:
                continue
            paid = weight * values[column] if weight else th.zeros_like(total)
            paid = th.nan_to_num(paid, nan=0.0) if self.zeroes_nan else paid
            self._step_reward[:, column] = paid
            total += paid
        self.reward[:] = total * (DT if getattr(self, "_scale_by_dt", True) else 1.0)
        return self.reward


class Simulator:
    """The position of each env is what its actions add up to, from a start in [0, `start`).

    An env terminates beyond 3 and times out after `limit` steps.
    """

    device, step_dt, render_mode = "cpu", DT, "rgb_array"

    def __init__(
        self,
        n_envs: int = 2,
        dialect: str = "mjlab",
        groups: tuple[str, ...] = ("actor",),
        limit: int = 4,
        start: float = 0.0,
        weights: dict[str, float] | None = None,
    ):
        self.num_envs, self.groups, self.limit, self.start = n_envs, groups, limit, start
        self.cfg = SimpleNamespace(is_finite_horizon=False)
        if dialect == "mjlab":
            self.cfg.auto_reset = True
        if dialect == "isaac3":
            self.cfg.compute_final_obs = False
        chosen = {"near": 2.0, "effort": -0.5, "spare": 0.0} if weights is None else weights
        self.reward_manager = Manager(n_envs, chosen, dialect)
        endless = SimpleNamespace(shape=(2,), dtype="float32", low=-np.inf, high=np.inf)
        if dialect != "mjlab":  # Gymnasium's spaces
            endless = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        by_group = dict.fromkeys(groups, endless)
        self.single_observation_space = SimpleNamespace(spaces=by_group)
        self.single_action_space = endless
        self.state = th.zeros(n_envs, 2)  # position, steps
        self.extras: dict[str, Any] = {}
        self.seeds: list[int | None] = []
        self.curriculum: dict[str, float] = {}  # weights from the next end of an episode on
        self.poison = float("nan"), []
        self.closed = 0

    @property
    def unwrapped(self) -> Simulator:
        return self

    def observe(self, copy: bool = False) -> dict[str, Any]:
        return {name: self.state.clone() if copy else self.state for name in self.groups}

    def reset_rows(self, rows: Any) -> None:
        self.state[rows] = 0.0
        self.state[rows, 0] = self.start * th.rand(len(self.state[rows]))
        for name, weight in self.curriculum.items():
            self.reward_manager.get_term_cfg(name).weight = weight

    def reset(self, *, seed: int | None = None, env_ids: Any = None) -> Any:
        if seed is not None:
            th.manual_seed(seed)
        self.seeds.append(seed)
        self.reset_rows(slice(None) if env_ids is None else env_ids)
        return self.observe(), self.extras

    def step(self, action: th.Tensor) -> Any:
        self.state += th.stack([action[:, 0], th.ones(self.num_envs)], dim=1)
        bad, rows = self.poison
        effort = (action**2).sum(1)
        effort[rows] = bad
        values = [self.state[:, 0], effort, th.ones(self.num_envs)]
        reward = self.reward_manager.compute(values)
        terminated, time_outs = self.state[:, 0] > 3, self.state[:, 1] >= self.limit
        rows = (terminated | time_outs).nonzero().squeeze(-1)
        if getattr(self.cfg, "auto_reset", True) and len(rows):
            if getattr(self.cfg, "compute_final_obs", False):
                self.extras["final_obs"] = self.observe(copy=True)
            self.reset_rows(rows)
        return self.observe(), reward, terminated, time_outs, self.extras

    def render(self) -> Any:
        return np.full((2, 2, 3), 7, np.uint8)

    def close(self) -> None:
        self.closed += 1


def make(simulator: Any, **kwargs: Any) -> ManagerVecEnv:
    """The adapter with levels for all terms that the simulator has."""
    levels = {name: LEVELS[name] for name in simulator.reward_manager.active_terms}
    return ManagerVecEnv(simulator, components=levels, **kwargs)


def push(env: ManagerVecEnv, *forces: float) -> Any:
    """A step in which env i moves by its force."""
    return env.step(np.array([[force, 0.0] for force in forces], np.float32))


def exactly(message: str) -> str:
    return f"^{re.escape(message)}$"


def test_the_package_offers_it() -> None:
    assert ManagerVecEnv is SameVecEnv
    with pytest.raises(
        AttributeError, match=exactly(f"module '{simulators.__name__}' has no attribute 'Other'")
    ):
        _ = simulators.Other


@pytest.mark.parametrize("dialect", SOURCES)
def test_components_are_what_is_paid(dialect: str) -> None:
    """By hand: position 1 at weight 2 for half a second, force² at -0.5 for as long."""
    env = make(Simulator(dialect=dialect))
    env.reset()
    _, rewards, _, _ = push(env, 1.0, -2.0)
    np.testing.assert_array_equal(env.reward_components, [[1.0, -0.25, 0.0], [-2.0, -1.0, 0.0]])
    np.testing.assert_array_equal(rewards, [0.75, -3.0])
    assert rewards.dtype == np.float32
    assert env.reward_spec == RewardSpec(("near", "effort", "spare"), (0, 1, 1))
    env.reset()
    assert not env.reward_components.any()


def test_a_manager_may_leave_the_time_step_out() -> None:
    simulator = Simulator()
    simulator.reward_manager._scale_by_dt = False
    env = make(simulator)
    env.reset()
    _, rewards, _, _ = push(env, 1.0, -2.0)
    np.testing.assert_array_equal(env.reward_components, [[2.0, -0.5, 0.0], [-4.0, -2.0, 0.0]])
    np.testing.assert_array_equal(rewards, [1.5, -6.0])


@pytest.mark.parametrize("dialect", SOURCES)
def test_components_sum_to_the_reward_in_any_state(dialect: str) -> None:
    env = make(Simulator(16, dialect, start=2.0))
    env.reset()
    for actions in np.random.default_rng(0).normal(size=(40, 16, 2)).astype(np.float32):
        _, rewards, _, _ = env.step(actions)
        np.testing.assert_allclose(env.reward_components.sum(1), rewards, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "weight", "level"),
    [
        ("track_lin_vel_xy_exp", 1.0, "task"),
        ("ee_position_tracking", -0.2, "task"),
        ("terminating", -2.0, "task"),
        ("Success_bonus", 0.0, "task"),
        ("goal_distance", -1.0, "task"),
        ("feet_air_time", 0.125, "regulariser"),
        ("alive", 1.0, "task"),
        ("action_rate_l2", -0.01, "regulariser"),
        ("later", 0.0, "regulariser"),
    ],
)
def test_levels_are_guessed_by_words_then_by_signs(name: str, weight: float, level: str) -> None:
    assert guess_levels({name: weight}) == {name: level}


def test_the_guess_is_told_and_can_be_overridden() -> None:
    message = (
        "The levels of these reward terms are a guess from their names and the signs of their "
        "weights: components={'near': 'task', 'effort': 'regulariser', 'spare': 'regulariser'}. "
        "Give `components`, all of them or some, to say which are tasks."
    )
    with pytest.warns(UserWarning, match=exactly(message)) as caught:
        env = ManagerVecEnv(Simulator())
    assert len(caught) == 1
    assert caught[0].filename == __file__
    assert env.reward_spec.to_dict() == {"near": 0, "effort": 1, "spare": 1}
    with pytest.warns(UserWarning, match=re.escape("components={'effort': 'regulariser'}. ")):
        env = ManagerVecEnv(Simulator(), components={"spare": 2, "near": 1})
    assert env.reward_spec.to_dict() == {"near": 1, "effort": 1, "spare": 2}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make(Simulator())


def test_unknown_components_are_refused() -> None:
    message = (
        "Parameter `components` must name terms of the reward, found 'nera': valid choices are "
        "['near', 'effort', 'spare']."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        ManagerVecEnv(Simulator(), components={"nera": "task"})
    message = "Parameter `components` must map names to levels, found ['near']."
    with pytest.raises(TypeError, match=exactly(message)):
        ManagerVecEnv(Simulator(), components=["near"])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="Unknown level 'main' of reward component 'near'"):
        ManagerVecEnv(Simulator(), components={"near": "main"})


@pytest.mark.parametrize("dialect", SOURCES)
def test_terminal_observations(dialect: str) -> None:
    """Env 0 terminates at 4 from 2, env 1 times out at 0 after four steps."""
    simulator = Simulator(dialect=dialect)
    env = make(simulator)
    assert env.terminal_source == SOURCES[dialect]
    env.reset()
    push(env, 2.0, 0.5)
    observations, _, dones, infos = push(env, 2.0, 0.5)
    np.testing.assert_array_equal(dones, [True, False])
    last = [2.0, 1.0] if dialect == "isaac2" else [4.0, 2.0]
    np.testing.assert_array_equal(infos[0]["terminal_observation"], last)
    np.testing.assert_array_equal(observations, [[0.0, 0.0], [1.0, 2.0]])
    assert infos[0]["TimeLimit.truncated"] is False
    assert infos[1] == {}
    push(env, 1.0, -0.5)
    observations, _, dones, infos = push(env, 1.0, 0.5)
    np.testing.assert_array_equal(dones, [False, True])
    last = [0.5, 3.0] if dialect == "isaac2" else [1.0, 4.0]
    np.testing.assert_array_equal(infos[1]["terminal_observation"], last)
    np.testing.assert_array_equal(observations, [[2.0, 2.0], [0.0, 0.0]])
    assert infos[1]["TimeLimit.truncated"] is True


@pytest.mark.parametrize("dialect", ["mjlab", "isaac3"])
def test_the_observation_before_the_last_step_will_do(dialect: str) -> None:
    simulator = Simulator(dialect=dialect, limit=2)
    env = make(simulator, exact_terminal_observation=False)
    assert env.terminal_source == "previous"
    assert simulator.cfg == Simulator(dialect=dialect).cfg  # as its owner made it
    env.reset()
    push(env, 1.0, -1.0)
    infos = push(env, 1.0, -1.0)[3]
    assert [info["terminal_observation"].tolist() for info in infos] == [[1.0, 1.0], [-1.0, 1.0]]


def test_an_env_that_leaves_resets_to_its_caller_gets_them() -> None:
    simulator = Simulator(limit=1)
    simulator.cfg.auto_reset = False
    env = make(simulator, exact_terminal_observation=False)
    env.reset()
    observations, _, _, infos = push(env, 1.0, 2.0)
    assert not observations.any()
    assert infos[1]["terminal_observation"].tolist() == [2.0, 1.0]


def test_an_old_final_observation_is_not_taken_again() -> None:
    """A simulator that stops giving them, in a later step with an end."""
    simulator = Simulator(dialect="isaac3", limit=2)
    env = make(simulator)
    env.reset()
    push(env, 1.0, 1.0)
    assert push(env, 1.0, 1.0)[3][0]["terminal_observation"].tolist() == [2.0, 2.0]
    simulator.cfg.compute_final_obs = False
    push(env, 0.5, 0.5)
    assert push(env, 0.5, 0.5)[3][0]["terminal_observation"].tolist() == [0.5, 1.0]


@pytest.mark.parametrize("dialect", SOURCES)
def test_both_ends_at_once_are_a_termination(dialect: str) -> None:
    env = make(Simulator(dialect=dialect, limit=1))
    env.reset()
    _, _, dones, infos = push(env, 4.0, 0.0)
    assert dones.all()
    assert [info["TimeLimit.truncated"] for info in infos] == [False, True]


def test_a_time_out_ends_a_finite_horizon() -> None:
    simulator = Simulator(limit=1)
    simulator.cfg.is_finite_horizon = True
    env = make(simulator)
    env.reset()
    _, _, dones, infos = push(env, 0.0, 0.0)
    assert dones.all()
    assert [info["TimeLimit.truncated"] for info in infos] == [False, False]


def test_episodes_are_counted() -> None:
    """By hand: positions 1, 2 at 2 · 0.5, forces 1, 1 at -0.5 · 0.5."""
    env = make(Simulator(limit=2))
    for _ in range(2):  # a reset forgets the half of an episode
        env.reset()
        push(env, 1.0, 0.0)
    info = push(env, 1.0, 0.0)[3][0]
    assert {key: info["episode"][key] for key in ("r", "l")} == {"r": 2.5, "l": 2}
    returns = {"r_near": 3.0, "r_effort": -0.5, "r_spare": 0.0}
    assert {key: info[key] for key in returns} == returns
    assert {key: info["episode"][key] for key in returns} == returns
    push(env, 0.0, 0.0)
    info = push(env, 0.0, 0.0)[3][0]
    assert {key: info["episode"][key] for key in ("r", "l")} == {"r": 0.0, "l": 2}


@pytest.mark.parametrize("dialect", SOURCES)
def test_what_is_returned_stays_as_it_was(dialect: str) -> None:
    """The stub, as the simulators on the CPU, writes into what it has returned."""
    env = make(Simulator(dialect=dialect, limit=2))
    start = env.reset()
    push(env, 1.0, 2.0)
    first = env.reward_components
    observations, rewards, dones, infos = push(env, 1.0, 1.5)
    kept = [observations, rewards, dones, env.reward_components, infos[0]["terminal_observation"]]
    copies = [array.copy() for array in kept]
    push(env, -1.0, -1.0)
    push(env, -1.0, -1.0)
    for array, copy in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(array, copy)
    assert not np.asarray(start).any()
    np.testing.assert_array_equal(first, [[1.0, -0.25, 0.0], [2.0, -1.0, 0.0]])


def test_what_was_returned_may_be_written_into() -> None:
    """The observation that stands for a lost one is the simulator's, not the learner's."""
    env = make(Simulator(dialect="isaac2", limit=2))
    env.reset()
    push(env, 1.0, 1.0)[0][:] = 99.0
    assert push(env, 1.0, 1.0)[3][0]["terminal_observation"].tolist() == [1.0, 1.0]


@pytest.mark.parametrize("dialect", SOURCES)
def test_weights_of_a_curriculum_are_followed(dialect: str) -> None:
    """They change when an episode ends: the reward of that step is still the old one."""
    simulator = Simulator(dialect=dialect, limit=2)
    env = make(simulator)
    env.reset()
    simulator.curriculum = {"near": 4.0, "effort": 0.0, "spare": 3.0}
    push(env, 1.0, 1.0)
    _, rewards, dones, _ = push(env, 1.0, 1.0)
    assert dones.all()
    np.testing.assert_array_equal(env.reward_components, [[2.0, -0.25, 0.0]] * 2)
    np.testing.assert_array_equal(rewards, [1.75] * 2)
    _, rewards, _, _ = push(env, 1.0, 1.0)
    np.testing.assert_array_equal(env.reward_components, [[2.0, 0.0, 1.5]] * 2)
    np.testing.assert_array_equal(rewards, [3.5] * 2)
    assert env.reward_spec.to_dict() == {"near": 0, "effort": 1, "spare": 1}


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_term_that_is_not_finite_counts_nothing(value: float) -> None:
    simulator = Simulator(dialect="isaac2")
    env = make(simulator)
    env.reset()
    simulator.poison = value, [1]
    message = (
        f"Reward component 'effort' of env 1 is {-value}: it counts 0, in the reward too. "
        "`n_nonfinite` counts the further ones in silence."
    )
    with pytest.warns(UserWarning, match=exactly(message)) as caught:
        _, rewards, _, _ = push(env, 1.0, 2.0)
    assert len(caught) == 1
    assert caught[0].filename == __file__
    np.testing.assert_array_equal(env.reward_components, [[1.0, -0.25, 0.0], [2.0, 0.0, 0.0]])
    np.testing.assert_array_equal(rewards, [0.75, 2.0])
    push(env, 0.0, 0.0)  # no second warning
    assert env.n_nonfinite == 2


def test_a_manager_may_count_it_nothing_itself() -> None:
    simulator = Simulator(dialect="mjlab")
    env = make(simulator)
    env.reset()
    simulator.poison = float("nan"), [1]
    _, rewards, _, _ = push(env, 1.0, 2.0)
    np.testing.assert_array_equal(rewards, [0.75, 2.0])
    assert env.n_nonfinite == 0


def test_a_reward_that_is_not_the_sum_stops_the_training() -> None:
    simulator = Simulator()
    compute = simulator.reward_manager.compute
    simulator.reward_manager.compute = lambda values: compute(values) + 1.0  # type: ignore[method-assign]
    model = GCRPPO("MlpPolicy", make(simulator), n_steps=8, batch_size=16, device="cpu")
    with pytest.raises(ValueError, match="The reward components must sum to the reward"):
        model.learn(16)


def test_seeds() -> None:
    simulator = Simulator(3, start=1.0)
    env = make(simulator)
    assert env.seed(5) == [5, 5, 5]
    first = env.reset()
    second = env.reset()
    assert simulator.seeds == [5, None]
    assert (first != second).any()
    env.seed(5)
    np.testing.assert_array_equal(env.reset(), first)
    assert env.seed(2**31 + 7) == [7, 7, 7]
    np.random.seed(0)
    drawn = env.seed()[0]
    assert drawn != env.seed()[0]
    assert all(0 <= seed < 2**31 for seed in env.seed())


def test_actions_have_bounds() -> None:
    simulator = Simulator()
    env = make(simulator)
    assert env.action_space == spaces.Box(-100.0, 100.0, (2,), np.float32)
    assert make(simulator, action_limit=3.0).action_space == spaces.Box(-3, 3, (2,), np.float32)
    simulator.single_action_space = spaces.Box(
        np.array([-1.0, -np.inf], np.float32), np.array([np.inf, 500.0], np.float32)
    )
    space = make(simulator).action_space
    np.testing.assert_array_equal(space.low, [-1.0, -100.0])  # type: ignore[attr-defined]
    np.testing.assert_array_equal(space.high, [100.0, 500.0])  # type: ignore[attr-defined]
    for limit in (0.0, -1.0, np.inf, np.nan):
        message = f"Parameter `action_limit` must be a finite number > 0, found {limit!r}."
        with pytest.raises(ValueError, match=exactly(message)):
            make(simulator, action_limit=limit)
    simulator.single_action_space = spaces.Discrete(3)
    message = "ManagerVecEnv needs a Box of actions, found Discrete(3)."
    with pytest.raises(TypeError, match=exactly(message)):
        make(simulator)


def test_actions_arrive_as_float32_copies_on_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    simulator = Simulator()
    env = make(simulator)
    env.reset()
    seen: list[th.Tensor] = []
    step = simulator.step
    monkeypatch.setattr(simulator, "step", lambda action: seen.append(action) or step(action))
    given = np.array([[1.0, 0.0], [2.0, 0.0]], np.float32)
    env.step_async(given)
    given[:] = 0.0
    env.step_wait()
    env.step(given.astype(float))
    assert [actions.dtype for actions in seen] == [th.float32] * 2
    assert str(seen[0].device) == "cpu"
    assert seen[0].tolist() == [[1.0, 0.0], [2.0, 0.0]]


def test_steps_out_of_turn_are_refused() -> None:
    env = make(Simulator())
    message = "ManagerVecEnv must be reset before a step, and cannot step after `close`."
    with pytest.raises(RuntimeError, match=exactly(message)):
        push(env, 0.0, 0.0)
    env.reset()
    with pytest.raises(RuntimeError, match=exactly("`step_wait` must follow `step_async`.")):
        env.step_wait()
    message_of_shape = "Parameter `actions` must have shape (2, 2), found (1, 2)."
    with pytest.raises(ValueError, match=exactly(message_of_shape)):
        push(env, 0.0)
    env.close()
    with pytest.raises(RuntimeError, match=exactly(message)):
        push(env, 0.0, 0.0)


def test_close_render_attributes_and_methods() -> None:
    simulator = Simulator()
    env = make(simulator)
    picture = env.render()
    assert picture is not None
    assert picture.shape == (2, 2, 3)
    assert (picture == 7).all()
    assert env.render_mode == "rgb_array"
    assert env.get_attr("step_dt") == [DT, DT]
    assert env.get_attr("n_nonfinite", indices=[0]) == [0]
    assert not env.has_attr("nothing")
    env.set_attr("limit", 9)
    assert simulator.limit == 9
    message = "The envs of a simulator share `limit`: leave out `indices`, found [0]."
    with pytest.raises(NotImplementedError, match=exactly(message)):
        env.set_attr("limit", 3, indices=[0])
    assert len(env.env_method("observe", copy=True)) == 2
    assert env.env_is_wrapped(Monitor) == [True, True]
    assert env.env_is_wrapped(VecNormalize, indices=[1]) == [False]
    env.close()
    env.close()
    assert simulator.closed == 1


def test_one_group_is_an_array_and_several_are_a_dict() -> None:
    env = make(Simulator(groups=("policy",)))
    assert env.observation_space == spaces.Box(-np.inf, np.inf, (2,), np.float32)
    env = make(Simulator(groups=("actor", "critic"), limit=2))
    assert isinstance(env.observation_space, spaces.Dict)
    assert set(env.observation_space.spaces) == {"actor", "critic"}
    start = env.reset()
    assert isinstance(start, dict)
    push(env, 1.0, 2.0)
    observations, _, _, infos = push(env, 1.0, 0.5)
    assert not any(rows.any() for rows in observations.values())
    terminal = infos[1]["terminal_observation"]
    assert {key: row.tolist() for key, row in terminal.items()} == {
        "actor": [2.5, 2.0],
        "critic": [2.5, 2.0],
    }


def test_a_group_that_is_not_concatenated_is_flattened() -> None:
    simulator = Simulator()
    box = simulator.single_action_space
    inner = SimpleNamespace(spaces={"joints": box, "base": box})
    simulator.single_observation_space = SimpleNamespace(spaces={"policy": inner, "critic": box})
    parts = {"joints": simulator.state, "base": -simulator.state}
    simulator.observe = lambda copy=False: {"policy": parts, "critic": parts["joints"], "x": None}  # type: ignore[method-assign]
    env = make(simulator)
    observations = env.reset()
    assert set(observations) == {"policy/joints", "policy/base", "critic"}
    assert set(env.observation_space.spaces) == set(observations)  # type: ignore[attr-defined]


def test_an_env_may_report_its_terms_itself() -> None:
    simulator = Simulator()
    simulator.reward_spec = {"near": "task", "rest": "regulariser"}  # type: ignore[attr-defined]
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # nothing is guessed
        env = ManagerVecEnv(simulator)
    assert env.reward_spec == RewardSpec(("near", "rest"), (0, 1))
    env.reset()
    message = (
        "An env with `reward_spec` must have `reward_components` after a step, a tensor of shape "
        "(N, K), found none in Simulator."
    )
    with pytest.raises(TypeError, match=exactly(message)):
        push(env, 0.0, 0.0)
    simulator.reward_components = th.tensor([[1.0, -0.25], [2.0, -1.0]])  # type: ignore[attr-defined]
    push(env, 1.0, 2.0)
    np.testing.assert_array_equal(env.reward_components, [[1.0, -0.25], [2.0, -1.0]])
    other = ManagerVecEnv(simulator, components={"rest": 3})
    assert other.reward_spec.to_dict() == {"near": 0, "rest": 3}
    simulator.reward_spec = RewardSpec(("a",), (0,))  # type: ignore[attr-defined]
    assert ManagerVecEnv(simulator).reward_spec.names == ("a",)


def test_an_env_that_does_not_say_is_told_what_to_add() -> None:
    simulator = Simulator()
    del simulator.reward_manager._step_reward
    message = (
        "ManagerVecEnv reads the terms of a step from `reward_manager._step_reward`, a tensor of "
        "shape (N, K), which Manager does not have. Give the env `reward_spec` and "
        "`reward_components` of its own."
    )
    with pytest.raises(TypeError, match=exactly(message)):
        ManagerVecEnv(simulator)
    del simulator.reward_manager
    message = (
        "Simulator does not say what its reward is made of: ManagerVecEnv found no "
        '`reward_manager`. Add `reward_spec = {"name": "task", ...}` to the env, and set '
        "`self.reward_components` in each step, a tensor of shape (N, K) whose columns are the "
        "terms as they are paid."
    )
    with pytest.raises(TypeError, match=exactly(message)):
        ManagerVecEnv(simulator)


class Wrapper:
    """As Gymnasium's: its step is called, attributes are those of the env below, and its reset
    takes no ``env_ids``.
    """

    def __init__(self, simulator: Simulator, n_values: int = 5):
        self.unwrapped, self.n_values, self.n_steps = simulator, n_values, 0

    def reset(self, *, seed: int | None = None) -> Any:
        return self.unwrapped.reset(seed=seed)

    def step(self, action: th.Tensor) -> Any:
        self.n_steps += 1
        return self.unwrapped.step(action)[: self.n_values]


def test_wrappers_are_stepped_and_passed_by_for_the_rest() -> None:
    wrapper = Wrapper(Simulator(limit=1))
    env = ManagerVecEnv(wrapper, components=LEVELS)
    env.reset()
    assert push(env, 0.5, 0.5)[2].all()
    assert wrapper.n_steps == 1
    env = ManagerVecEnv(Wrapper(Simulator(), n_values=4), components=LEVELS)
    env.reset()
    message = (
        "`step` must return observations, rewards, terminated, time-outs and extras, found 4 "
        "values from Wrapper: give ManagerVecEnv the env below that wrapper."
    )
    with pytest.raises(TypeError, match=exactly(message)):
        push(env, 0.0, 0.0)


@pytest.mark.parametrize("dialect", SOURCES)
@pytest.mark.parametrize("groups", [("policy",), ("policy", "critic")])
def test_gcrppo_trains_on_it(dialect: str, groups: tuple[str, ...]) -> None:
    env = VecNormalize(make(Simulator(8, dialect, groups, start=1.0)))
    policy = "MlpPolicy" if len(groups) == 1 else "MultiInputPolicy"
    model = GCRPPO(policy, env, n_steps=16, batch_size=32, n_epochs=2, seed=0, device="cpu")
    before = model.policy.state_dict()["action_net.weight"].clone()
    model.learn(256)
    assert (model.policy.state_dict()["action_net.weight"] != before).any()
    assert len(model.ep_component_buffer) > 8
    for episode, components in zip(model.ep_info_buffer, model.ep_component_buffer, strict=True):
        np.testing.assert_allclose(components.sum(), episode["r"], atol=1e-5)
    mean, _ = evaluate_policy(model, model.get_env(), n_eval_episodes=8)
    assert np.isfinite(mean)


@pytest.mark.parametrize("dialect", SOURCES)
def test_with_one_term_it_is_ppo(dialect: str) -> None:
    weights: list[th.Tensor] = []
    for algorithm in (PPO, GCRPPO):
        env = make(Simulator(4, dialect, start=1.0, weights={"near": 2.0}))
        model = algorithm("MlpPolicy", env, n_steps=16, batch_size=32, seed=3, device="cpu")
        model.learn(256)
        weights.append(th.nn.utils.parameters_to_vector(model.policy.parameters()).detach())
    assert th.equal(*weights)

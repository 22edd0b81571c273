"""Simulators with a reward manager, such as mjlab and IsaacLab, as a VecEnv that reports its reward
components.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any, Literal, Protocol

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_gcr.rewards.spec import Level
from sb3_gcr.simulators.manager_spaces import (
    BoxLike,
    DictLike,
    GroupReader,
    Groups,
    HostObservations,
    bounded_actions,
    replace_rows,
    row_of,
    to_host,
)
from sb3_gcr.simulators.manager_terms import choose_spec, find_terms

#: Seeds end below it: simulators give them to generators of 32 bits.
_SEED_END = 2**31

StepReturn = tuple[Groups, th.Tensor, th.Tensor, th.Tensor, dict[str, Any]]


class Simulator(Protocol):
    """What is read of an env of mjlab or IsaacLab, below its wrappers."""

    num_envs: int
    device: th.device | str
    step_dt: float
    single_observation_space: BoxLike | DictLike
    single_action_space: BoxLike

    def reset(self, *, env_ids: th.Tensor) -> tuple[Groups, dict[str, Any]]:
        """Start some of the envs anew."""

    def step(self, action: th.Tensor, /) -> StepReturn:
        """Observations, rewards, terminated, time-outs, extras."""

    def close(self) -> None:
        """Free what it holds."""


class ManagerVecEnv(VecEnv):
    """The N envs of a simulator with a reward manager, with ``reward_components`` of shape (N, K)
    after each step.

    The components are the manager's terms as they are paid: value × weight, times ``step_dt``
    unless the manager leaves that out. Weights that a curriculum changes are those of the moment; a
    term of weight 0 is a column of zeros, because it may get a weight later. A component that is
    not finite counts 0, in the reward too, as in mjlab: ``n_nonfinite`` counts them, and the first
    is told in a warning. An env without a manager must have ``reward_spec``, and after each step
    ``reward_components``, of its own.

    Infos are filled for finished episodes only: ``terminal_observation``, ``TimeLimit.truncated``,
    and SB3's ``episode`` statistics with the return of each component as ``r_<name>``. A time-out
    is no truncation where the env says ``cfg.is_finite_horizon``. All envs share one seed, and draw
    from PyTorch's global generator: a second simulator in the process disturbs the first.

    :param env: an env of mjlab (1.6 or newer) or IsaacLab (2.3 or newer), or with the same
        attributes; wrappers that return five values from ``step`` may be around it
    :param components: levels by name, for all terms or some; the others are a guess from names and
        weights, told in a warning
    :param action_limit: bound of the actions where the simulator has none
    :param exact_terminal_observation: where the simulator can, take the terminal observation from
        it, by ``cfg.auto_reset = False`` (mjlab) or ``cfg.compute_final_obs = True`` (IsaacLab 3),
        which this class sets; it costs one more observation in steps that end an episode. Where it
        cannot, or with False, it is the observation before the last step
    :raises TypeError: for an env whose reward terms cannot be read
    :raises ValueError: if ``components`` names other terms
    """

    render_mode: str | None = None

    def __init__(
        self,
        env: Any,
        components: Mapping[str, Level] | None = None,
        action_limit: float = 100.0,
        exact_terminal_observation: bool = True,
    ):
        if not 0 < action_limit < np.inf:
            raise ValueError(
                f"Parameter `action_limit` must be a finite number > 0, found {action_limit!r}."
            )
        self.env = env
        self._simulator: Simulator = getattr(env, "unwrapped", env)
        self._terms = find_terms(self._simulator)
        self.reward_spec = choose_spec(self._terms, components)
        #: Where the terminal observation comes from: the step, the extras or the step before.
        self.terminal_source = _choose_source(self._simulator, exact_terminal_observation)
        self._reader = GroupReader(self._simulator.single_observation_space)
        action_space = bounded_actions(self._simulator.single_action_space, action_limit)
        n_envs = self._simulator.num_envs
        self.reward_components = np.zeros((n_envs, len(self.reward_spec)))
        #: Components so far that were not finite.
        self.n_nonfinite = 0
        self._episode_returns = np.zeros_like(self.reward_components)
        self._episode_lengths = np.zeros(n_envs, dtype=int)
        self._before: HostObservations | None = None  # the next step; None before a reset
        self._actions: th.Tensor | None = None
        self._is_closed = False
        self._start_time = time.time()
        super().__init__(n_envs, self._reader.space, action_space)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seed of the simulator at the next ``reset``; its envs share it.

        :param seed: taken modulo 2³¹; None draws one
        :return: N times the seed
        """
        if seed is None:
            seed = int(np.random.randint(_SEED_END))
        self._seeds = [int(seed) % _SEED_END] * self.num_envs
        return self._seeds

    def reset(self) -> HostObservations:  # type: ignore[override]
        """Start a new episode in each env.

        :return: observations, shape (N, ...)
        """
        groups, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        self._actions = None
        self.reward_components = np.zeros_like(self.reward_components)
        self._episode_returns[:] = 0.0
        self._episode_lengths[:] = 0
        return self._keep(self._reader.read(groups))

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions for the next step.

        :param actions: shape (N, A)
        :raises ValueError: for another shape
        :raises RuntimeError: before the first reset, and after the env was closed
        """
        if self._before is None or self._is_closed:
            raise RuntimeError(
                "ManagerVecEnv must be reset before a step, and cannot step after `close`."
            )
        expected = (self.num_envs, *(self.action_space.shape or ()))
        if np.shape(actions) != expected:
            raise ValueError(
                f"Parameter `actions` must have shape {expected}, found {np.shape(actions)}."
            )
        copied = th.from_numpy(np.array(actions, dtype=np.float32))
        self._actions = copied.to(self._simulator.device)

    def step_wait(self) -> VecEnvStepReturn:
        """Step the simulator; finished envs have started anew when it returns.

        :return: observations, rewards, dones, infos
        """
        if self._actions is None:
            raise RuntimeError("`step_wait` must follow `step_async`.")
        self._terms.start_step()
        result = self.env.step(self._actions)
        self._actions = None
        if len(result) != 5:
            raise TypeError(
                "`step` must return observations, rewards, terminated, time-outs and extras, found "
                f"{len(result)} values from {type(self.env).__name__}: give ManagerVecEnv the env "
                "below that wrapper."
            )
        groups, paid, ended, expired, extras = result
        observations = self._reader.read(groups)
        rewards = self._collect(to_host(paid).astype(np.float32))
        terminated = to_host(ended).astype(bool)
        timed_out = to_host(expired).astype(bool)
        dones = terminated | timed_out
        self._episode_returns += self.reward_components
        self._episode_lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if dones.any():
            truncated = timed_out & ~terminated & (not self._is_finite_horizon)
            terminal = self._terminal(observations, extras)
            for index in np.flatnonzero(dones).tolist():
                infos[index] = self._finish(index, terminal, bool(truncated[index]))
            self._episode_returns[dones] = 0.0
            self._episode_lengths[dones] = 0
            if self.terminal_source == "step":
                observations = replace_rows(observations, self._start_anew(dones), dones)
        return self._keep(observations), rewards, dones, infos  # type: ignore[return-value]

    @property
    def _is_finite_horizon(self) -> bool:
        """Whether a time-out is an end of the task."""
        return bool(getattr(_settings(self._simulator), "is_finite_horizon", False))

    def _keep(self, observations: HostObservations) -> HostObservations:
        """Note the observations that the next step starts from; others may write into them."""
        self._before = deepcopy(observations)
        return observations

    def _collect(self, rewards: NDArray[np.float32]) -> NDArray[np.float32]:
        """Set the components of the step, shape (N, K), and return the rewards, shape (N,)."""
        components = self._terms.read()
        lost = ~np.isfinite(components)
        if lost.any():
            row, column = np.argwhere(lost)[0]
            if self.n_nonfinite == 0:
                warnings.warn(
                    f"Reward component '{self.reward_spec.names[column]}' of env {row} is "
                    f"{components[row, column]}: it counts 0, in the reward too. `n_nonfinite` "
                    "counts the further ones in silence.",
                    stacklevel=4,
                )
            self.n_nonfinite += int(lost.sum())
            components[lost] = 0.0
            rewards = np.where(lost.any(1), components.sum(1), rewards).astype(np.float32)
        self.reward_components = components
        return rewards

    def _terminal(self, observations: HostObservations, extras: dict[str, Any]) -> HostObservations:
        """The observations of the episodes that have ended, shape (N, ...); other rows are
        anything.
        """
        if self.terminal_source == "step":
            return observations
        # What stays in the extras would be that of an earlier end in a later step.
        final = extras.pop("final_obs", None)
        if self.terminal_source == "final_obs" and final is not None:
            return self._reader.read(final)
        assert self._before is not None
        return self._before

    def _finish(self, index: int, terminal: HostObservations, truncated: bool) -> dict[str, Any]:
        """The info of an env that has finished its episode."""
        returns = self._episode_returns[index].round(6).tolist()
        by_key = dict(zip(self.reward_spec.return_keys, returns, strict=True))
        return {
            "terminal_observation": row_of(terminal, index),
            "TimeLimit.truncated": truncated,
            **by_key,
            "episode": {
                "r": round(sum(returns), 6),
                "l": int(self._episode_lengths[index]),
                "t": round(time.time() - self._start_time, 6),
                **by_key,
            },
        }

    def _start_anew(self, dones: NDArray[np.bool_]) -> HostObservations:
        """Reset the finished envs of a simulator that leaves it to us."""
        indices = th.from_numpy(np.flatnonzero(dones)).to(self._simulator.device)
        return self._reader.read(self._simulator.reset(env_ids=indices)[0])

    def close(self) -> None:
        """Close the simulator; a second time does nothing."""
        if not self._is_closed:
            self.env.close()
        self._is_closed = True

    def get_images(self) -> Sequence[NDArray[Any] | None]:
        """The simulator's picture, one for all envs."""
        return [self.env.render()]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """The simulator's attribute of that name, else the adapter's, once per env."""
        owners = [self.env, self._simulator, self]
        owner = next((owner for owner in owners if hasattr(owner, attr_name)), self)
        value = getattr(owner, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the simulator, which all envs share.

        :raises NotImplementedError: for some of the envs
        """
        if indices is not None:
            raise NotImplementedError(
                f"The envs of a simulator share `{attr_name}`: leave out `indices`, found "
                f"{indices!r}."
            )
        setattr(self._simulator, attr_name, value)

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method of the simulator, once for all envs; its result stands for each."""
        result = getattr(self.env, method_name)(*args, **kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """True for SB3's Monitor, whose statistics are in the infos."""
        return [wrapper_class is Monitor for _ in self._get_indices(indices)]


def _settings(simulator: Simulator) -> object:
    """The simulator's ``cfg``; None where it has none."""
    return getattr(simulator, "cfg", None)


def _choose_source(simulator: Simulator, exact: bool) -> Literal["step", "final_obs", "previous"]:
    """Switch the best source of terminal observations on."""
    settings: Any = _settings(simulator)
    if exact and hasattr(settings, "auto_reset"):
        settings.auto_reset = False
    elif exact and hasattr(settings, "compute_final_obs"):
        settings.compute_final_obs = True
    if not getattr(settings, "auto_reset", True):
        return "step"
    return "final_obs" if exact and hasattr(settings, "compute_final_obs") else "previous"

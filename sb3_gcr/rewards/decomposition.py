"""A wrapper that collects the terms of a reward from the info dict."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor

from sb3_gcr.checks import check_number
from sb3_gcr.rewards.gymnasium_envs import GYMNASIUM_ENVS as GYMNASIUM_ENVS
from sb3_gcr.rewards.sources import Calls, Terms, TermSource, Weights
from sb3_gcr.rewards.spec import COMPONENTS_KEY, ERROR_KEY, Level, RewardSpec
from sb3_gcr.rewards.sums import SUM_TOLERANCE, adds_up, find_fault
from sb3_gcr.rewards.values import Components, as_array, leaves


class RewardDecomposition(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Collects the terms of a reward from the info dict into ``info["reward_components"]``, a float
    array of shape (K,), and what each has paid since the reset into ``info["r_<name>"]``.

    The reward itself stays what it is; of a vector reward SB3 gets the sum. A term that is missing,
    not finite, or does not add up to the reward is reported in ``info["reward_components_error"]``,
    because a wrapper inside a ``SubprocVecEnv`` cannot raise where anyone would see it; ``GCRPPO``
    and ``evaluate_components`` raise it with the index of the env.

    :param env: the environment to wrap
    :param components: levels by info key, e.g. ``{"reward_forward": "task", "reward_ctrl":
        "regulariser"}``, or by path, ``"rewards/forward"``. A key that holds a dictionary maps to
        the levels of its entries, e.g. ``{"rewards": {"speed": "task", "energy": 1}}``; one that
        holds a vector to those of its entries in order. Where the reward itself is a vector, the
        names are those of its entries in order, by themselves or under any one key. None looks the
        env up in ``GYMNASIUM_ENVS``
    :param residual: name of a component for the rest of the reward, a task; ``{name: level}`` for
        another level
    :param tolerance: how far the sum may be from the reward beyond rounding, relative to the sum of
        the components' sizes: ``2e-3`` for rewards in float16. For rewards rounded to decimals half
        a unit of the last one, e.g. ``0.005`` for two decimals
    :param weights: what the terms are multiplied by before they are added up: a number, weights by
        name (1 where there is none), or a function of the env that returns either. None multiplies
        vectors by ``info["reward_weights"]``, where that is present; ``weights=1`` does not
    :param under: key or path of a dictionary in the info that has the terms
    :param cumulative: whether the terms are running totals of an episode, so that the reward is
        their increase
    :param terms: a function of the env and the info of a step that returns the terms by name
    :param calls: names of methods of the env that return terms while it steps, by name of the
        component or as a list, whose entries are the names of both; of several calls in a step the
        sum counts. ``"part.method"`` names one of a part of the env
    :raises ValueError: if ``components`` is None and the env is not in the table, or if a name
        appears twice
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        components: Components | None = None,
        residual: str | Mapping[str, Level] | None = None,
        tolerance: float = SUM_TOLERANCE,
        weights: Weights | None = None,
        *,
        under: str | None = None,
        cumulative: bool = False,
        terms: Terms | None = None,
        calls: Calls | None = None,
    ):
        options = {
            name: value
            for name, value in [
                ("weights", weights),
                ("under", under),
                ("cumulative", cumulative or None),
                ("terms", terms),
                ("calls", calls),
            ]
            if value is not None
        }
        gym.utils.RecordConstructorArgs.__init__(
            self,
            components=components,
            residual=residual,
            tolerance=tolerance,
            **options,  # type: ignore[arg-type]
        )
        gym.Wrapper.__init__(self, env)
        if components is None:
            components, known_residual = _known_components(env)
            residual = residual if residual is not None else known_residual
        if not isinstance(components, Mapping):
            raise TypeError(
                f"Parameter `components` must map info keys to levels, found {components!r}."
            )
        self.components = dict(components)
        self.residual = {residual: "task"} if isinstance(residual, str) else dict(residual or {})
        if len(self.residual) > 1:
            raise ValueError(
                f"Parameter `residual` must name one component, found {list(self.residual)}."
            )
        check_number("tolerance", tolerance, 0)
        #: How far the components may be from the reward, for those who read them.
        self.reward_tolerance = tolerance
        #: Name of the component that takes what the others leave, or None.
        self.reward_residual = next(iter(self.residual), None)
        pairs = [*leaves(self.components), *self.residual.items()]
        self.reward_spec = RewardSpec(
            tuple(name for name, _ in pairs),
            tuple(level for _, level in pairs),  # type: ignore[misc]
        )
        names = self.reward_spec.names[: len(pairs) - len(self.residual)]
        _refuse_monitored_vectors(env)
        self._source = TermSource(
            env, self.components, names, under, weights, cumulative, terms, calls
        )
        self._returns = np.zeros(len(self.reward_spec))
        self._raw = np.zeros(len(names))
        self._written: dict[str, Any] = {}

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Reset the env.

        :param kwargs: ``seed`` and ``options``
        """
        self._returns = np.zeros(len(self.reward_spec))
        observation, info = super().reset(**kwargs)
        self._source.begin(info)
        self._raw = np.zeros_like(self._raw)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the env and add the components, or the sentence that says what is wrong with them,
        to its info.

        :param action: an action of the env
        """
        self._source.forget_calls()
        observation, reward, terminated, truncated, info = self.env.step(action)
        if not isinstance(info, dict):
            info = {ERROR_KEY: f"`info` must be a dictionary, found {info!r}."}
            return observation, reward, terminated, truncated, info
        self._remove_own(info)
        row, sentence = None, ""
        try:
            row = self._read(reward, info)
        except ValueError as error:
            sentence = str(error)
        except Exception as error:  # of a function that the user gave; a worker could not raise it
            sentence = f"The reward components cannot be read: {type(error).__name__}: {error}."
        self._write(info, row, sentence)
        return observation, _scalar(reward), terminated, truncated, info

    def _read(self, reward: Any, info: dict[str, Any]) -> NDArray[np.float64]:
        """The components of a step, shape (K,).

        :raises ValueError: says what is wrong with them
        """
        total = reward
        if not isinstance(reward, float):
            rewards = as_array(reward, "The reward").ravel()
            if rewards.size != 1:
                return self._from_vector(rewards)
            total = float(rewards[0])
        before = self._raw
        terms, self._raw = self._source.read(info)
        row = self._complete(terms, total)
        miss = abs(float(row.sum()) - total)
        if math.isfinite(miss) and miss <= SUM_TOLERANCE * abs(total):  # nearly always
            return row
        fault = find_fault(row[None], np.array([total]), self.reward_spec, self.reward_tolerance)
        if fault is None:
            return row
        if fault.is_sum:
            raise ValueError(self._cause(self._raw, before, total) or fault.sentence)
        raise ValueError(fault.sentence)

    def _cause(
        self, raw: NDArray[np.float64], before: NDArray[np.float64], reward: float
    ) -> str | None:
        """What explains that terms do not add up which came as ``raw``, and in the step before as
        ``before``.
        """
        if self._source.weights is None and adds_up(raw, reward, self.reward_tolerance):
            return (
                'The terms add up to the reward without `info["reward_weights"]`, which they seem '
                "to contain already: give `RewardDecomposition(weights=1)`."
            )
        growth = (raw - before) * self._source.current_weights()
        if before.any() and adds_up(growth, reward, self.reward_tolerance):
            return (
                "The terms are running totals: the reward is by how much they have grown since "
                "the step before. Give `RewardDecomposition(cumulative=True)`."
            )
        return None

    def _from_vector(self, rewards: NDArray[np.float64]) -> NDArray[np.float64]:
        """The components of a vector reward, which are its entries in the order of the names."""
        if self.residual or len(self.reward_spec) != len(rewards):
            raise ValueError(
                f"The reward is a vector of {len(rewards)} entries: parameter `components` must "
                f"name each of them in order, without a residual, found "
                f"{list(self.reward_spec.names)}."
            )
        row = rewards * self._source.current_weights()
        fault = find_fault(row[None], row[None].sum(1), self.reward_spec, np.inf)
        if fault is not None:
            raise ValueError(fault.sentence)
        return row

    def _complete(self, terms: NDArray[np.float64], reward: float) -> NDArray[np.float64]:
        """The terms with the residual, if there is one."""
        if not self.residual:
            return terms
        return np.append(terms, reward - terms.sum())

    def _remove_own(self, info: dict[str, Any]) -> None:
        """Take out what we wrote into an info that the env uses again."""
        for key, value in self._written.items():
            if info.get(key) is value:
                del info[key]

    def _write(self, info: dict[str, Any], row: NDArray[np.float64] | None, sentence: str) -> None:
        """Put the components, or the sentence, and the returns so far into an info."""
        self._returns = self._returns + (np.nan if row is None else row)
        keys = self.reward_spec.return_keys
        # A key of that name that the env fills itself stays.
        self._written = {
            key: value
            for key, value in zip(keys, self._returns.tolist(), strict=True)
            if key not in info
        }
        self._written |= {ERROR_KEY: sentence} if row is None else {COMPONENTS_KEY: row}
        info.pop(COMPONENTS_KEY, None)
        info.pop(ERROR_KEY, None)
        info.update(self._written)


def _scalar(reward: Any) -> Any:
    """The reward for SB3: itself where it is a number, the sum of a vector."""
    if isinstance(reward, int | float | np.number):
        return reward
    try:
        return float(as_array(reward, "").sum())
    except ValueError:  # the info has the sentence
        return np.nan


def _refuse_monitored_vectors(env: gym.Env[Any, Any]) -> None:
    """Refuse a Monitor inside, which cannot add up the rewards of an env that declares vectors."""
    while isinstance(env, gym.Wrapper):
        length = vector_length(env)
        if isinstance(env, Monitor) and length is not None:
            raise ValueError(
                f"The env's reward is a vector of {length} entries, and Monitor, which is inside, "
                "needs numbers: put it outside, as in `Monitor(RewardDecomposition(env, ...))`."
            )
        env = env.env


def vector_length(env: gym.Env[Any, Any]) -> int | None:
    """How many entries the reward of an env has that declares a ``reward_space``, as MO-Gymnasium's
    do; None for a number, and where a wrapper of somebody else may have made one.

    :param env: an env, wrapped or not
    """
    while isinstance(env, gym.Wrapper):
        if not type(env).__module__.startswith(("gymnasium.", "stable_baselines3.")):
            return None
        env = env.env
    shape = getattr(getattr(env, "reward_space", None), "shape", None) or (1,)
    return int(shape[0]) if len(shape) == 1 and shape[0] > 1 else None


def _known_components(env: gym.Env[Any, Any]) -> tuple[Components, str | None]:
    """The table's arguments for an env.

    :raises ValueError: for an env that is not in the table; nothing is stepped to find out more
    """
    env_id = env.spec.id if env.spec is not None else ""
    if env_id in GYMNASIUM_ENVS:
        known = GYMNASIUM_ENVS[env_id]
        return known["components"], known.get("residual")
    name = env_id or type(env.unwrapped).__name__
    length = vector_length(env)
    if length is not None:
        raise ValueError(
            f"Parameter `components` must be given for '{name}': its reward is a vector of "
            f"{length} entries, and needs their names in order, with levels."
        )
    raise ValueError(
        f"Parameter `components` must be given for '{name}': its reward terms are known only for "
        f"{sorted(GYMNASIUM_ENVS)}. `sb3_gcr.find_components(env)` looks for them in random steps."
    )

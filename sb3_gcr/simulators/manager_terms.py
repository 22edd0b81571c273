"""The reward terms of a simulator with a reward manager: their names, levels and values."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_gcr.rewards.spec import Level, RewardSpec, level_label
from sb3_gcr.simulators.manager_spaces import to_host

#: Words in the name of a term that tell its level, whatever the sign of its weight.
LEVELS_BY_WORD: dict[str, Level] = {
    "track": "task",
    "terminat": "task",
    "success": "task",
    "goal": "task",
    "air_time": "regulariser",
}


class TermConfig(Protocol):
    """The settings of one term."""

    weight: float


class RewardManager(Protocol):
    """What is read of the reward managers of mjlab and IsaacLab."""

    #: Value × weight of each term in the last step, shape (N, K): a rate, not times the time step.
    _step_reward: th.Tensor

    @property
    def active_terms(self) -> Sequence[str]:
        """Names of the K terms."""

    def get_term_cfg(self, term_name: str, /) -> TermConfig:
        """The settings of a term, with the weight of this moment."""


class ManagedTerms:
    """Terms of a reward manager, in the units of the reward.

    :param manager: the env's ``reward_manager``
    :param step_dt: length of a step in seconds, which the manager multiplies by
    :raises TypeError: if the manager does not keep the terms of a step
    """

    def __init__(self, manager: RewardManager, step_dt: float):
        if not isinstance(getattr(manager, "_step_reward", None), th.Tensor):
            raise TypeError(
                "ManagerVecEnv reads the terms of a step from `reward_manager._step_reward`, a "
                f"tensor of shape (N, K), which {type(manager).__name__} does not have. Give the "
                "env `reward_spec` and `reward_components` of its own."
            )
        self._manager = manager
        self._scale = step_dt if getattr(manager, "_scale_by_dt", True) else 1.0
        self._is_off = self.weights == 0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the K terms, in the order of the columns."""
        return tuple(self._manager.active_terms)

    @property
    def weights(self) -> NDArray[np.float64]:
        """Weights of this moment, shape (K,); curricula change them."""
        return np.array([self._manager.get_term_cfg(name).weight for name in self.names])

    @property
    def default_levels(self) -> dict[str, Level]:
        """Levels by name; a guess."""
        return guess_levels(dict(zip(self.names, self.weights.tolist(), strict=True)))

    def start_step(self) -> None:
        """Note which terms the coming step leaves out.

        A curriculum changes weights at the end of a step, after its reward, so later is too late.
        """
        self._is_off = self.weights == 0

    def read(self) -> NDArray[np.float64]:
        """The terms of the step just made, shape (N, K), a copy."""
        components = to_host(self._manager._step_reward).astype(np.float64) * self._scale
        components[:, self._is_off] = 0.0  # an older manager leaves the last value there
        return components


class SelfReporting(Protocol):
    """An env that keeps the terms of its reward itself."""

    reward_spec: RewardSpec | Mapping[str, Level]
    #: Terms of the last step in the units of the reward, shape (N, K).
    reward_components: th.Tensor


class OwnTerms:
    """Terms that the env reports itself.

    :param env: an env with ``reward_spec`` and ``reward_components``
    """

    def __init__(self, env: SelfReporting):
        self._env = env
        spec = env.reward_spec
        self._spec = spec if isinstance(spec, RewardSpec) else RewardSpec.from_dict(spec)
        self.names = self._spec.names

    @property
    def default_levels(self) -> dict[str, Level]:
        """Levels by name; the env's word."""
        return dict(self._spec)

    def start_step(self) -> None:
        """Nothing to note."""

    def read(self) -> NDArray[np.float64]:
        """The terms of the step just made, shape (N, K), a copy.

        :raises TypeError: if there are none
        """
        components = getattr(self._env, "reward_components", None)
        if components is None:
            raise TypeError(
                "An env with `reward_spec` must have `reward_components` after a step, a tensor of "
                f"shape (N, K), found none in {type(self._env).__name__}."
            )
        return to_host(components).astype(np.float64)


def find_terms(simulator: Any) -> ManagedTerms | OwnTerms:
    """The terms of an env; what it says itself goes before what its manager says.

    :param simulator: an env without wrappers
    :raises TypeError: if it says nothing
    """
    if hasattr(simulator, "reward_spec"):
        return OwnTerms(simulator)
    if hasattr(simulator, "reward_manager"):
        return ManagedTerms(simulator.reward_manager, simulator.step_dt)
    raise TypeError(
        f"{type(simulator).__name__} does not say what its reward is made of: ManagerVecEnv found "
        'no `reward_manager`. Add `reward_spec = {"name": "task", ...}` to the env, and set '
        "`self.reward_components` in each step, a tensor of shape (N, K) whose columns are the "
        "terms as they are paid."
    )


def guess_levels(weights: Mapping[str, float]) -> dict[str, Level]:
    """Levels from the words in the names, else from the signs of the weights.

    A guess: a term that says to stand upright, with a weight above 0, becomes a task.

    :param weights: weights by name
    :return: "task" or "regulariser" by name
    """
    levels: dict[str, Level] = {}
    for name, weight in weights.items():
        by_sign = "task" if weight > 0 else "regulariser"
        told = [level for word, level in LEVELS_BY_WORD.items() if word in name.lower()]
        levels[name] = told[0] if told else by_sign
    return levels


def choose_spec(
    terms: ManagedTerms | OwnTerms, components: Mapping[str, Level] | None
) -> RewardSpec:
    """Names from the terms, levels from the user where given; warns of those that are a guess.

    :param terms: where the values come from
    :param components: levels by name, of all terms or some
    :raises TypeError: if ``components`` is no mapping
    :raises ValueError: if it names other terms
    """
    given = {} if components is None else components
    if not isinstance(given, Mapping):
        raise TypeError(f"Parameter `components` must map names to levels, found {components!r}.")
    for name in given:
        if name not in terms.names:
            raise ValueError(
                f"Parameter `components` must name terms of the reward, found {name!r}: valid "
                f"choices are {list(terms.names)}."
            )
    spec = RewardSpec.from_dict({**terms.default_levels, **given})
    guessed = {name: level_label(level) for name, level in spec if name not in given}
    if guessed and isinstance(terms, ManagedTerms):
        warnings.warn(
            "The levels of these reward terms are a guess from their names and the signs of their "
            f"weights: components={guessed}. Give `components`, all of them or some, to say which "
            "are tasks.",
            stacklevel=3,
        )
    return spec

"""Where the terms of a step are, and what they are multiplied by: the options of
:class:`~sb3_gcr.rewards.decomposition.RewardDecomposition`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from operator import attrgetter
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_gcr.checks import check_number
from sb3_gcr.rewards.values import Components, as_vector, collect, look_up

#: What the terms are multiplied by: all of them, each by name, or what a function of the env says.
Weights = float | Mapping[str, float] | Callable[[gym.Env[Any, Any]], "float | Mapping[str, float]"]
#: A function of the env and the info of a step that returns the terms by name.
Terms = Callable[[gym.Env[Any, Any], dict[str, Any]], Mapping[str, Any]]
#: Names of methods that return terms, or such methods by name of the component.
Calls = Sequence[str] | Mapping[str, str]


class TermSource:
    """Reads the terms of each step; they are in the info, or below one of its keys, or what a
    function or methods of the env return.

    :param env: the wrapped env
    :param components: levels by key
    :param names: of the components, in order
    :param under: as for ``RewardDecomposition``
    :param weights: as for ``RewardDecomposition``
    :param cumulative: as for ``RewardDecomposition``
    :param terms: as for ``RewardDecomposition``
    :param calls: as for ``RewardDecomposition``
    :raises ValueError: for weights with other names, for methods that the env lacks, and for more
        than one place
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        components: Components,
        names: tuple[str, ...],
        under: str | None = None,
        weights: Weights | None = None,
        cumulative: bool = False,
        terms: Terms | None = None,
        calls: Calls | None = None,
    ):
        places = {"under": under, "terms": terms, "calls": calls}
        given = [name for name, value in places.items() if value is not None]
        if len(given) > 1:
            raise ValueError(
                "Parameters `under`, `terms` and `calls` each say where the terms are: give one of "
                f"them, found {' and '.join(f'`{name}`' for name in given)}."
            )
        _check_weights(weights, names)
        self.env, self.components, self.names = env, components, names
        self.under, self.weights, self.cumulative, self.terms = under, weights, cumulative, terms
        self._recorded = {} if calls is None else _record_calls(env, calls)
        self._before = np.zeros(len(names))

    def begin(self, info: Any) -> None:
        """Start an episode.

        :param info: what the reset returned; running totals start with what is in it, or with 0
        """
        self._before = np.zeros(len(self.names))
        if not self.cumulative or not isinstance(info, dict):
            return
        try:
            self._before = self._collect(info, None)
        except Exception:  # the info of a reset need not have the terms
            return

    def forget_calls(self) -> None:
        """Forget what methods returned before this step."""
        for method in self._recorded.values():
            method.total = 0.0

    def read(self, info: dict[str, Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The terms of a step, shape (K,), as the reward has them and as they come.

        :param info: of the step
        :raises ValueError: for a term that is missing or is no number
        """
        before = self._before
        vector_weights = info.get("reward_weights") if self.weights is None else None
        raw = self._collect(info, None)
        weighted = raw if vector_weights is None else self._collect(info, vector_weights)
        if self.cumulative:
            self._before = raw
            weighted = weighted - before
        return weighted if self.weights is None else weighted * self.current_weights(), raw

    def current_weights(self) -> NDArray[np.float64]:
        """The weight of each component in this step, shape (K,)."""
        weights = self.weights(self.env) if callable(self.weights) else self.weights
        if weights is None:
            return np.ones(len(self.names))
        if not isinstance(weights, Mapping):
            return np.full(len(self.names), as_vector(weights, "Parameter `weights`", 1)[0])
        if callable(self.weights):
            return np.array(collect(dict.fromkeys(self.names, 0), weights, "weights(env)"))
        return np.array([float(weights.get(name, 1)) for name in self.names])

    def _collect(self, info: dict[str, Any], vector_weights: Any) -> NDArray[np.float64]:
        """Raw terms, shape (K,)."""
        source, where = self._place(info)
        return np.array(collect(self.components, source, where, vector_weights), dtype=float)

    def _place(self, info: dict[str, Any]) -> tuple[Mapping[str, Any], str]:
        """The dictionary with the terms, and how a sentence calls it."""
        if self._recorded:
            return {name: method.total for name, method in self._recorded.items()}, "calls"
        if self.terms is not None:
            found: Any = self.terms(self.env, info)
            where = "terms(env, info)"
        elif self.under is not None:
            found = self._under(info)
            where = f'info["{self.under}"]'
        else:
            return info, "info"
        if not isinstance(found, Mapping):
            raise ValueError(f"`{where}` must be a dictionary of terms by name, found {found!r}.")
        return found, where

    def _under(self, info: dict[str, Any]) -> Any:
        assert self.under is not None
        found = look_up(info, self.under)
        if not found:
            raise ValueError(
                "Parameter `under` must be a key of `info` with a dictionary of terms, found no "
                f'"{self.under}" among {sorted(map(str, info))}.'
            )
        return found[0]


class _Recorded:
    """A method that remembers the sum of what it has returned.

    :param method: the method
    """

    def __init__(self, method: Callable[..., Any]):
        self.method, self.total = method, 0.0

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        value = self.method(*args, **kwargs)
        self.total = self.total + value
        return value


def _record_calls(env: gym.Env[Any, Any], calls: Calls) -> dict[str, _Recorded]:
    """Put a recorder in the place of each method, by name of the component."""
    if isinstance(calls, str) or not isinstance(calls, Sequence | Mapping):
        raise TypeError(
            "Parameter `calls` must be a list of method names, or such names by component, found "
            f"{calls!r}."
        )
    by_name = calls if isinstance(calls, Mapping) else dict(zip(calls, calls, strict=True))
    recorded: dict[str, _Recorded] = {}
    for name, path in by_name.items():
        owner_path, _, method_name = path.rpartition(".")
        try:
            owner = attrgetter(owner_path)(env.unwrapped) if owner_path else env.unwrapped
            method = getattr(owner, method_name)
        except AttributeError:
            raise ValueError(_no_method(env, path)) from None
        recorded[name] = _Recorded(method)
        setattr(owner, method_name, recorded[name])
    return recorded


def _no_method(env: gym.Env[Any, Any], path: str) -> str:
    methods = [name for name in dir(env.unwrapped) if not name.startswith("__")]
    near = get_close_matches(path, methods, n=3, cutoff=0.5)
    hint = f" Did you mean one of {near}?" if near else ""
    return (
        f"Parameter `calls` must name methods of {type(env.unwrapped).__name__}, found {path!r}."
        f"{hint}"
    )


def _check_weights(weights: Any, names: tuple[str, ...]) -> None:
    """Refuse weights that are no numbers, or have other names than the components."""
    if weights is None or callable(weights):
        return
    if not isinstance(weights, Mapping):
        check_number("weights", weights)
        return
    for name, weight in weights.items():
        if name not in names:
            raise ValueError(
                f"Parameter `weights` must have the names of components, found {name!r}: valid "
                f"choices are {list(names)}."
            )
        check_number(f'weights["{name}"]', weight)

"""Whether a residual hides a mistake: a factor, a sign, running totals, terms that are not in the
reward.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sb3_gcr.rewards.fitting import fit_sum, independent_columns, round_weight
from sb3_gcr.rewards.spec import RewardSpec

#: Rows that are looked at, from no more than so many envs, and the fewest that tell anything.
N_ROWS, N_ENVS, FEWEST_ROWS = 320, 16, 32
#: The share of the residual's variation that other terms must explain, where it is not all.
FOLLOWS = 0.98
#: A reward smaller than this share of both its parts is what is left of two that cancel.
CANCELS = 0.1


class ResidualWatch:
    """Looks at the first few hundred steps, and then no more.

    :param spec: names the components
    :param residual: name of the one that takes what the others leave
    """

    def __init__(self, spec: RewardSpec, residual: str):
        self.spec, self.residual = spec, residual
        self._steps: list[NDArray[np.float64]] = []
        self._is_done = False

    def add(self, components: NDArray[np.float64], is_last: bool = False) -> str | None:
        """The components of a step; the sentence about the residual, once there is one.

        :param components: shape (N, K)
        :param is_last: whether no more steps follow
        """
        if self._is_done:
            return None
        if len(components):
            self._steps.append(components[:N_ENVS].copy())
        n_rows = sum(map(len, self._steps))
        if n_rows < max(FEWEST_ROWS if is_last else N_ROWS, 3 * len(self.spec)):
            return None
        steps = np.array(self._steps)
        self._is_done, self._steps = True, []
        return explain_residual(steps, self.spec, self.residual)


def explain_residual(steps: NDArray[np.float64], spec: RewardSpec, residual: str) -> str | None:
    """What a residual follows from, in a sentence with the way out; None where it is a term of its
    own.

    :param steps: components of successive steps, shape (T, N, K)
    :param spec: names the components
    :param residual: name of the one that takes what the others leave
    """
    index = spec.names.index(residual)
    names = [name for name in spec.names if name != residual]
    terms = np.delete(steps, index, axis=2)
    rest, reward = steps[..., index], steps.sum(2)
    if np.abs(rest).max() <= 1e-6 * np.abs(terms).sum(2).max(initial=0.0):
        return None  # it never pays
    start = f"The residual '{residual}' "
    if _are_totals(terms, reward):
        return (
            f"{start}takes back what the other terms have paid before: they are running totals, "
            "and the reward is their increase. Give `RewardDecomposition(cumulative=True)` and "
            "leave `residual` out."
        )
    flat = terms.reshape(-1, len(names))
    return _follows(flat, rest.ravel(), names, start) or _cancels(flat.sum(1), rest.ravel(), start)


def _are_totals(terms: NDArray[np.float64], reward: NDArray[np.float64]) -> bool:
    """Whether the reward is by how much the terms have grown, but for the starts of episodes."""
    growth = np.diff(terms, axis=0).sum(2)
    near = np.abs(growth - reward[1:]) <= 1e-5 * (np.abs(terms[1:]).sum(2) + np.abs(reward[1:]))
    moves = np.abs(reward[1:]).max(initial=0.0) > 0
    return bool(moves and near.size and near.mean() > 0.8 and np.ptp(growth) > 0)


def _follows(
    terms: NDArray[np.float64], rest: NDArray[np.float64], names: list[str], start: str
) -> str | None:
    """The sentence about a residual that is a weighted sum of other terms, all of it or nearly."""
    chosen = independent_columns(terms)
    if not chosen or np.ptp(rest) <= 1e-6 * np.abs(rest).max():
        return None
    fit = fit_sum(terms[:, chosen], rest)
    left = rest - terms[:, chosen] @ fit.weights
    explained = 1 - left.var() / rest.var()
    if not fit.is_exact and explained < FOLLOWS:
        return None
    factors: dict[str, float] = {}
    for column, weight in zip(chosen, fit.weights.tolist(), strict=True):
        factors[names[column]] = 0.0 if abs(1 + weight) < 1e-3 else round_weight(1 + weight)
    if all(abs(factor - 1) < 1e-3 for factor in factors.values()):
        return None
    how = "follows" if fit.is_exact else f"follows ({explained:.1%} of it)"
    sentence = _reward_sentence(factors, len(factors) == len(names))
    return f"{start}{how} from the other terms: {sentence}"


def _reward_sentence(factors: dict[str, float], are_all: bool) -> str:
    """What the reward is, with the factors of the terms, and what to do."""
    values = set(factors.values())
    foreign = [name for name, factor in factors.items() if factor == 0]
    if len(values) == 1 and are_all and not foreign:
        factor = values.pop()
        return (
            f"the reward is {factor:g} x their sum. Give `RewardDecomposition(weights={factor:g})`"
            " and leave `residual` out, if it has nothing else to take."
        )
    if len(foreign) == len(factors):
        return (
            f"it cancels them, and the reward does not contain {_quoted(foreign)}. Leave out what "
            "is not in the reward."
        )
    weights = {name: factor for name, factor in factors.items() if factor}
    listed = " + ".join(f"{factor:g} x {name}" for name, factor in weights.items())
    without = f" It does not contain {_quoted(foreign)}: leave that out." if foreign else ""
    return (
        f"the reward is {listed}, and the residual hides it.{without} Give "
        f"`RewardDecomposition(weights={weights})`."
    )


def _cancels(named: NDArray[np.float64], rest: NDArray[np.float64], start: str) -> str | None:
    """The sentence about a residual that takes back what the other terms pay."""
    paid, back, left = (float(np.abs(x).mean()) for x in (named, rest, named + rest))
    if left >= CANCELS * min(paid, back):
        return None
    return (
        f"{start}cancels the other terms: in a step they paid {named.mean():.3g}, it "
        f"{rest.mean():.3g}, and the reward is what is left, {(named + rest).mean():.3g}. They "
        "seem not to be in the reward, or not with this sign and factor."
    )


def _quoted(names: list[str]) -> str:
    return ", ".join(f"'{name}'" for name in names)

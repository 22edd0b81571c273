"""Sign permutation over configurations, at looks that were registered before the first run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from sb3_gcr.study.statistics.checks import Array, checked_sample

#: Rows of signs that are drawn at once, which bounds the memory.
BATCH = 10_000


class Permutation(NamedTuple):
    """The mean difference and its two-sided p; ``exact`` where all signs were tried."""

    mean: float
    p: float
    n: int
    exact: bool


class Look(NamedTuple):
    """One registered look: p of the first n configurations, and p corrected for all looks."""

    n: int
    mean: float
    p: float
    adjusted_p: float


def sign_permutation(differences: ArrayLike, resamples: int = 99_999, seed: int = 0) -> Permutation:
    r"""Two-sided test that the differences of configurations are symmetric around 0.

    .. math:: p = P_σ(|\textstyle\sum_i σ_i d_i| ≥ |\sum_i d_i|), \qquad σ_i = ±1

    All 2ⁿ signs are tried where they are at most ``resamples``; else so many are drawn, and the
    observed signs count as one of them, so that p is never 0.

    :param differences: b - a of each configuration, shape (n,)
    :param resamples: number of drawn signs
    :param seed: of the draws
    :raises ValueError: fewer than two configurations, or values that are not finite
    """
    d = checked_sample(differences, "differences", unit="configuration")
    result = stats.permutation_test(
        (d,),
        _mean,
        permutation_type="samples",
        vectorized=True,
        n_resamples=resamples,
        batch=BATCH,
        rng=np.random.default_rng(seed),
    )
    return Permutation(float(d.mean()), float(result.pvalue), len(d), 2 ** len(d) <= resamples)


def registered_looks(
    differences: ArrayLike, looks: Sequence[int], resamples: int = 99_999, seed: int = 0
) -> list[Look]:
    r"""The sign permutation at each look that has been reached, Bonferroni over all of them.

    .. math:: \tilde p_l = \min(1, L p_l)

    L counts the looks that were registered, whether they are reached or not. Between looks there
    is :func:`~sb3_gcr.study.statistics.e_value`.

    :param differences: b - a of each configuration in the registered order, shape (n,); those
        after the last look are not used
    :param looks: L numbers of configurations, growing, for example ``(12, 24, 36)``
    :param resamples: see :func:`sign_permutation`
    :param seed: see :func:`sign_permutation`
    :return: one result for each look that is reached, in their order; none before the first
    :raises ValueError: looks that do not grow from 2 on, or values that are not finite
    """
    if not looks or looks[0] < 2 or list(looks) != sorted(set(looks)):
        raise ValueError(
            f"Parameter `looks` must be growing numbers of configurations from 2 on, "
            f"found {list(looks)}."
        )
    d = checked_sample(differences, "differences", at_least=0, unit="configuration")
    reached = []
    for n in looks:
        if n > len(d):
            break
        test = sign_permutation(d[:n], resamples, seed)
        reached.append(Look(n, test.mean, test.p, min(1.0, len(looks) * test.p)))
    return reached


def _mean(differences: Array, axis: int) -> Array:
    """The statistic that the signs permute."""
    return differences.mean(axis)

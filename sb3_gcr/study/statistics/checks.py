"""What the statistics accept: finite numbers, enough of them, and as many here as there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def checked_sample(values: ArrayLike, name: str, at_least: int = 2, unit: str = "seed") -> Array:
    """The values as one row of finite numbers.

    :param values: one number a run, or one a configuration, shape (n,)
    :param name: the parameter, for the message
    :param at_least: smallest n
    :param unit: what one value belongs to, for the message
    :return: float64, shape (n,)
    :raises ValueError: another shape, fewer values, NaN or infinity
    """
    sample = np.asarray(values, dtype=np.float64)
    if sample.ndim != 1:
        raise ValueError(
            f"Parameter `{name}` must be one row of numbers, "
            f"found an array of shape {sample.shape}."
        )
    if len(sample) < at_least:
        raise ValueError(
            f"Parameter `{name}` must have at least {at_least} {unit}s, found {len(sample)}: "
            f"run more {unit}s."
        )
    wrong = np.flatnonzero(~np.isfinite(sample))
    if len(wrong):
        raise ValueError(
            f"Parameter `{name}` must have finite values, found {sample[wrong[0]]} at position "
            f"{wrong[0]}: leave failed runs out and report how many there were."
        )
    return sample


def checked_tasks(tasks: Sequence[ArrayLike], name: str, at_least: int = 2) -> list[Array]:
    """One checked sample a task.

    :param tasks: one row of numbers a task; tasks may have different numbers of seeds
    :param name: the parameter, for the message
    :param at_least: smallest number of seeds of each task
    :return: a list of arrays of shape (n_m,)
    :raises ValueError: no task, or a sample that :func:`checked_sample` refuses
    """
    if len(tasks) == 0:
        raise ValueError(f"Parameter `{name}` must have at least one task, found none.")
    return [checked_sample(task, f"{name}[{m}]", at_least) for m, task in enumerate(tasks)]


def check_equal_lengths(
    first: Sequence[object] | Array,
    second: Sequence[object] | Array,
    names: tuple[str, str],
    unit: str,
) -> None:
    """Refuse two lists of different lengths.

    :raises ValueError: with both lengths
    """
    if len(first) != len(second):
        raise ValueError(
            f"Parameters `{names[0]}` and `{names[1]}` must have one value for each {unit}, "
            f"found {len(first)} and {len(second)}."
        )


def check_share(value: float, name: str) -> None:
    """Refuse what is no share between 0 and 1, ends excluded.

    :raises ValueError: with the value
    """
    if not 0.0 < value < 1.0:
        raise ValueError(f"Parameter `{name}` must lie between 0 and 1, found {value}.")


def check_counts(wins: int, n: int) -> None:
    """Refuse counts that are no number of wins out of n.

    :raises ValueError: with both counts
    """
    if not 0 <= wins <= n:
        raise ValueError(f"Parameter `wins` must lie between 0 and n = {n}, found {wins}.")

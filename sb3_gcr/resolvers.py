"""Who yields to whom: from the Gramian of the component gradients to one weight per component.

Every resolver is ``(gramian, levels, rng) -> weights``. With J = [g^(1) ... g^(K)]ᵀ and G = J Jᵀ
the step is Jᵀ w, and everything a resolver needs is in G: a projected gradient is g_i' = W[i] J, so
⟨g_i', g_j⟩ = (W G)[i, j] and w = Σ_i W[i]. Level 0 has the highest priority. Nothing here has the
size of the network.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_gcr import fast_gcr
from sb3_gcr.angles import TOLERANCE, Gramian, Levels, visiting_order
from sb3_gcr.guaranteed import ZERO_ROW, guaranteed

Weights = NDArray[np.float64]
Resolver = Callable[[Gramian, Levels, np.random.Generator], Weights]


def gcr(gramian: Gramian, levels: Levels, rng: np.random.Generator) -> Weights:
    """The paper's rule: each g_i is projected off every conflicting g_j of its own or a higher
    level.

    g_i' ← g_i' - min(0, ⟨g_i', g_j⟩) / G_jj · g_j, with the original g_j as in PCGrad
    (arXiv:2001.06782, algorithm 1): first inside the own level, then the higher levels from the
    lowest up, so that level 0 has the last word. With one task, no other component weakens it:
    (G w)_task ≥ G_task,task. With more tasks that conflict nothing is guaranteed. This is the
    definition; ``GCRPPO`` calls its faster twin in :mod:`sb3_gcr.fast_gcr`.

    :param gramian: G, shape (K, K)
    :param levels: priority level of each component, 0 the highest, shape (K,)
    :param rng: draws the order inside a level
    :return: weights w ≥ 1, shape (K,)
    """
    norms = np.sqrt(gramian.diagonal())
    projected = np.eye(len(gramian))  # W
    for i, met in enumerate(visiting_order(levels, rng)):
        for j in met[(met != i) & (levels[met] <= levels[i])]:
            inner = projected[i] @ gramian[:, j]  # ⟨g_i', g_j⟩
            if inner < -TOLERANCE * norms[i] * norms[j]:
                projected[i, j] -= inner / gramian[j, j]
    return np.asarray(projected.sum(0))


def no_priority(gramian: Gramian, levels: Levels, rng: np.random.Generator) -> Weights:
    """PCGrad over all components, whatever their level (the paper's NoPriority).

    :param gramian: G, shape (K, K)
    :param levels: ignored
    :param rng: draws the order
    :return: weights w ≥ 1, shape (K,)
    """
    return gcr(gramian, np.zeros_like(levels), rng)


def by_levels(gramian: Gramian, levels: Levels, rng: np.random.Generator) -> Weights:
    """Priority between levels alone: each level is one sum T_l = Σ_{k in l} g^(k), projected off
    the sums of the higher levels where they conflict.

    T_l' ← T_l' - min(0, ⟨T_l', T_h⟩) / |T_h|² · T_h for h = l-1 … 0, with the original T_h. Weights
    are the same inside a level (1 for a component without gradient), so the reward's own weights
    decide there. With two levels no regulariser weakens the sum of the tasks, however many there
    are: Σ_tasks (G w) ≥ 1ᵀ G 1 over the tasks.

    :param gramian: G, shape (K, K)
    :param levels: priority level of each component, 0 the highest, shape (K,)
    :param rng: ignored, the result is deterministic
    :return: weights w ≥ 1, shape (K,)
    """
    ranks, level_of = np.unique(levels, return_inverse=True)
    members = np.eye(len(ranks))[:, level_of]  # (levels, K)
    weights = fast_gcr.gcr(members @ gramian @ members.T, ranks, rng)[level_of]
    squared_norms = gramian.diagonal()
    return np.where(squared_norms > ZERO_ROW * squared_norms.max(), weights, 1.0)


def gcr_authors(gramian: Gramian, levels: Levels, rng: np.random.Generator) -> Weights:
    """The authors' released rule: in place, tasks against tasks and every other component against
    tasks only.

    g_i' is projected off the g_j' that the pass has left so far, in one random order over i and one
    over j for each i. Components of level 1 and below are not projected off each other. Their
    absolute 1e-8 is left out.

    :param gramian: G, shape (K, K)
    :param levels: 0 is a task, everything else a regulariser, shape (K,)
    :param rng: draws the orders
    :return: weights, shape (K,)
    """
    n = len(gramian)
    projected = np.eye(n)  # W
    floor = ZERO_ROW * np.diag(gramian).max(initial=0.0)
    for i in rng.permutation(n):
        for j in rng.permutation(n):
            if i == j or levels[j] > 0:
                continue
            inner = projected[i] @ gramian @ projected[j]
            squared_norm = projected[j] @ gramian @ projected[j]
            if squared_norm > floor and inner < -TOLERANCE * np.sqrt(gramian[i, i] * squared_norm):
                projected[i] -= inner / squared_norm * projected[j]
    return np.asarray(projected.sum(0))


def plain_sum(gramian: Gramian, levels: Levels, rng: np.random.Generator) -> Weights:
    """No surgery: w = 1 (the paper's Multi-head PPO).

    :param gramian: G, shape (K, K); only its size is used
    :param levels: ignored
    :param rng: ignored
    :return: ones, shape (K,)
    """
    return np.ones(len(gramian))


#: Resolvers by the name that ``GCRPPO(resolver=...)`` takes.
RESOLVERS: dict[str, Resolver] = {
    "gcr": fast_gcr.gcr,
    "gcr_authors": gcr_authors,
    "no_priority": fast_gcr.no_priority,
    "sum": plain_sum,
    "levels": by_levels,
    "guaranteed": guaranteed,
}


def bind_resolver(resolver: str | Resolver, resolver_kwargs: dict[str, Any] | None) -> Resolver:
    """The callable behind a resolver's name, with its keyword arguments bound.

    :param resolver: a name in ``RESOLVERS``, or a callable
    :param resolver_kwargs: keyword arguments of the callable
    :raises ValueError: for an unknown name
    :raises TypeError: for what is not callable, and for keyword arguments that do not fit
    """
    if isinstance(resolver, str):
        if resolver not in RESOLVERS:
            raise ValueError(
                f"Parameter `resolver` must be one of {sorted(RESOLVERS)} or a callable "
                f"(gramian, levels, rng) -> weights, found {resolver!r}."
            )
        resolver = RESOLVERS[resolver]
    if not callable(resolver):
        raise TypeError(
            f"Parameter `resolver` must be one of {sorted(RESOLVERS)} or a callable "
            f"(gramian, levels, rng) -> weights, found {resolver!r}."
        )
    try:
        inspect.signature(resolver).bind(None, None, None, **(resolver_kwargs or {}))
    except TypeError as error:
        raise TypeError(
            "Parameter `resolver_kwargs` must fit the resolver's signature (gramian, levels, rng, "
            "...), "
            f"found {resolver_kwargs!r}: {error}."
        ) from None
    return partial(resolver, **(resolver_kwargs or {}))

"""Who yields to whom: from the Gramian of the component gradients to one weight per component.

Every resolver is ``(gramian, levels, rng) -> weights``. With J = [g^(1) ... g^(K)]ᵀ and G = J Jᵀ
the step is Jᵀ w, and everything a resolver needs is in G: a projected gradient is g_i' = W[i] J, so
⟨g_i', g_j⟩ = (W G)[i, j] and w = Σ_i W[i]. Level 0 has the highest priority. Nothing here has the
size of the network.
"""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Levels = NDArray[Any]  # of integers, of whatever size a resolver asks for
Resolver = Callable[[Array, Levels, np.random.Generator], Array]

#: Two gradients conflict when ⟨g_i, g_j⟩ is below minus this share of |g_i| |g_j|: rounding is no
#: conflict.
TOLERANCE = 1e-12
#: Up to so many components the projections run row by row.
FEW = 10
#: A component whose squared gradient norm is below this share of the largest one has no gradient.
ZERO_ROW = 1e-40
#: Eigenvalues of a Gramian of unit gradients below this share of the largest are rounding.
ROUNDING = 1e-13
#: Ridge of the non-negative least squares on unit gradients: picks the minimal-norm weights when G
#: is singular.
RIDGE = 1e-10


def conflicts(gramian: Array) -> NDArray[np.bool_]:
    """Which pairs conflict: G_ij < 0 beyond rounding.

    :param gramian: G, shape (..., K, K)
    :return: shape (..., K, K), symmetric, False on the diagonal
    """
    return np.asarray(gramian < -TOLERANCE * _products_of_norms(gramian))


def cosines(gramian: Array) -> Array:
    """Cosine between each two component gradients: G_ij / (|g_i| |g_j|), and 0 where one of them
    vanishes.

    :param gramian: G, shape (..., K, K)
    :return: shape (..., K, K)
    """
    return np.asarray(gramian / _products_of_norms(gramian))


def _products_of_norms(gramian: Array) -> Array:
    """|g_i| |g_j|, shape (..., K, K); infinite where one of them vanishes, so that it has no
    direction and no conflicts.
    """
    norms = np.sqrt(gramian.diagonal(0, -2, -1))
    norms = np.where(norms > 0, norms, np.inf)
    return np.asarray(norms[..., :, None] * norms[..., None, :])


def visiting_order(levels: Levels, rng: np.random.Generator) -> NDArray[np.intp]:
    """Order in which each component meets the others: from the lowest priority up, level 0 last,
    random inside a level.

    :param levels: shape (K,)
    :param rng: source of the order inside a level
    :return: row i lists whom component i meets, shape (K, K)
    """
    n = len(levels)
    return np.argsort(rng.random((n, n)) - levels, axis=1)


def gcr(gramian: Array, levels: Levels, rng: np.random.Generator) -> Array:
    """The paper's rule: each g_i is projected off every conflicting g_j of its own or a higher
    level.

    g_i' ← g_i' - min(0, ⟨g_i', g_j⟩) / G_jj · g_j, with the original g_j as in PCGrad
    (arXiv:2001.06782, algorithm 1): first inside the own level, then the higher levels from the
    lowest up, so that level 0 has the last word. With one task, no other component weakens it: (G
    w)_task ≥ G_task,task. With more tasks that conflict nothing is guaranteed.

    :param gramian: G, shape (K, K)
    :param levels: priority level of each component, 0 the highest, shape (K,)
    :param rng: draws the order inside a level
    :return: weights w ≥ 1, shape (K,)
    """
    directions = cosines(gramian)
    if not (directions < -TOLERANCE).any():
        return np.ones(len(gramian))
    norms = np.sqrt(gramian.diagonal())
    # For few components one array operation costs more than a loop over a row; the two take the
    # same steps.
    project = _project_row_by_row if len(gramian) <= FEW else _project_rows_together
    return project(directions, norms, levels, visiting_order(levels, rng))


def _project_row_by_row(
    directions: Array, norms: Array, levels: Levels, order: NDArray[np.intp]
) -> Array:
    """Weights of :func:`gcr` in plain numbers; ``directions`` are the cosines, ``order`` says whom
    each component meets.
    """
    rows, sizes, ranks = directions.tolist(), norms.tolist(), levels.tolist()
    weights = [1.0] * len(rows)
    for i, (inner, met) in enumerate(
        zip(rows, order.tolist(), strict=True)
    ):  # inner[j] = ⟨g_i', g_j⟩ / (|g_i| |g_j|)
        if min(inner) >= -TOLERANCE:
            continue
        for j in met:
            cosine = inner[j]
            if cosine < -TOLERANCE and ranks[j] <= ranks[i] and j != i:
                inner = [mine - cosine * its for mine, its in zip(inner, rows[j], strict=True)]
                weights[j] -= cosine * sizes[i] / sizes[j]
    return np.array(weights)


def _project_rows_together(
    directions: Array, norms: Array, levels: Levels, order: NDArray[np.intp]
) -> Array:
    """Weights of :func:`gcr`, all components meeting their next one at the same time."""
    n = len(norms)
    met = order.T.copy()  # row by row: whom each component meets in this step
    yields = (levels >= levels[met]) & (met != np.arange(n))
    steps = directions.take(met, 0)  # (steps, K, K)
    steps *= yields[:, :, None]
    inner, removed = (
        directions.copy(),
        np.empty((n, n)),
    )  # ⟨g_i', g_j⟩ / (|g_i| |g_j|), and its negative part at each step
    for step, places, cosine, column in zip(
        steps, met + n * np.arange(n), removed, removed[:, :, None], strict=True
    ):
        inner.take(places, out=cosine, mode="clip")  # in range; the mode saves a copy
        cosine *= cosine < -TOLERANCE
        step *= column
        inner -= step
    removed *= yields
    removed *= norms
    return 1 - np.divide(
        np.bincount(met.ravel(), removed.ravel(), n),
        norms,
        out=np.zeros_like(norms),
        where=norms > 0,
    )


def no_priority(gramian: Array, levels: Levels, rng: np.random.Generator) -> Array:
    """PCGrad over all components, whatever their level (the paper's NoPriority).

    :param gramian: G, shape (K, K)
    :param levels: ignored
    :param rng: draws the order
    :return: weights w ≥ 1, shape (K,)
    """
    return gcr(gramian, np.zeros_like(levels), rng)


def gcr_authors(gramian: Array, levels: Levels, rng: np.random.Generator) -> Array:
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


def plain_sum(gramian: Array, levels: Levels, rng: np.random.Generator) -> Array:
    """No surgery: w = 1 (the paper's Multi-head PPO).

    :param gramian: G, shape (K, K); only its size is used
    :param levels: ignored
    :param rng: ignored
    :return: ones, shape (K,)
    """
    return np.ones(len(gramian))


def guaranteed(gramian: Array, levels: Levels, rng: np.random.Generator) -> Array:
    """Level by level, so that no level ever harms a component of a higher one, for any number of
    tasks.

    Inside a level UPGrad (arXiv:2406.16232) with sum preference: each g_i is projected onto the
    level's dual cone {d : ⟨g_j, d⟩ ≥ 0 for all j of the level} and the projections are added. The
    level's sum is then projected onto the dual cone of all components of higher levels. Members of
    a lower level may end worse: that is what priority means.

    :param gramian: G, shape (K, K)
    :param levels: priority level of each component, 0 the highest, shape (K,)
    :param rng: ignored, the result is deterministic
    :return: weights, shape (K,)
    """
    weights = np.ones(len(gramian))
    squared_norms = np.diag(gramian)
    if not conflicts(gramian).any():
        return weights
    alive = np.flatnonzero(squared_norms > ZERO_ROW * squared_norms.max())
    norms = np.sqrt(squared_norms[alive])
    unit_gradients = _columns(gramian[np.ix_(alive, alive)] / np.outer(norms, norms))
    projected = np.diag(norms)  # W in units of unit gradients: row i is g_i' as it is built up
    for level in np.unique(levels[alive]):
        own, higher = levels[alive] == level, levels[alive] < level
        for i in np.flatnonzero(own):
            projected[i] += _dual_cone_step(unit_gradients, projected[i], own)
        first = np.flatnonzero(own)[0]
        projected[first] += _dual_cone_step(unit_gradients, projected[own].sum(0), higher)
    weights[alive] = projected.sum(0) / norms
    return weights


def _columns(gramian: Array) -> Array:
    """A matrix A with AᵀA = G: its columns are the gradients, written in K coordinates."""
    eigenvalues, eigenvectors = np.linalg.eigh(gramian)
    eigenvalues[eigenvalues < ROUNDING * eigenvalues.max()] = 0.0
    return np.asarray(np.sqrt(eigenvalues)[:, None] * eigenvectors.T)


def _dual_cone_step(columns: Array, coefficients: Array, members: NDArray[np.bool_]) -> Array:
    """What to add to ``coefficients`` so that d = columns @ coefficients lands on the nearest point
    of the members' dual cone.

    min_λ |d + A_members λ|² subject to λ ≥ 0; its optimality conditions are ⟨g_j, d + A λ⟩ ≥ 0 with
    equality where λ_j > 0.
    """
    from scipy.optimize import (
        nnls,  # here, because it would be a tenth of the time of `import sb3_gcr`
    )

    step = np.zeros_like(coefficients)
    size = np.linalg.norm(coefficients)
    if members.any() and size > 0:
        ridge = np.sqrt(RIDGE) * np.eye(int(members.sum()))
        target = -(columns @ coefficients) / size
        step[members] = (
            size
            * nnls(
                np.vstack([columns[:, members], ridge]), np.append(target, np.zeros(len(ridge)))
            )[0]
        )
    return step


def from_torchjd(weighting: Any) -> Resolver:
    """Use a TorchJD weighting of Gramians as a resolver; levels are ignored.

    TorchJD's absolute ``norm_eps`` and ``reg_eps`` would switch it off for small gradients, so G is
    divided by its largest diagonal entry. For UPGrad and DualProj it is preconditioned instead:
    D^(-1/2) G D^(-1/2) with the preference u_i √G_ii, and the weights scaled back. Components
    without gradient are left out and get weight 1. Weightings that draw random numbers draw them
    from torch's global generator.

    :param weighting: e.g. ``torchjd.aggregation.UPGradWeighting()``; must accept a (K, K) tensor
        and return (K,) weights
    :return: a resolver for ``GCRPPO(resolver=...)``
    :raises ImportError: if TorchJD is missing
    :raises TypeError: if ``weighting`` is no TorchJD weighting
    """
    try:
        import torch as th
        from torchjd.aggregation import DualProjWeighting, UPGradWeighting, Weighting
    except ImportError as error:
        raise ImportError("`from_torchjd` needs TorchJD: pip install 'sb3_gcr[torchjd]'") from error
    if not isinstance(weighting, Weighting):
        raise TypeError(
            "Parameter `weighting` must be a torchjd.aggregation.*Weighting, found "
            f"{type(weighting).__name__}. "
            "Aggregators such as UPGrad() carry theirs as `.gramian_weighting`."
        )
    preference = getattr(weighting, "pref_vector", None)
    preconditioned = (
        copy.deepcopy(weighting)
        if isinstance(weighting, UPGradWeighting | DualProjWeighting)
        else None
    )

    def resolve(gramian: Array, levels: Levels, rng: np.random.Generator) -> Array:
        weights = np.ones(len(gramian))
        squared_norms = np.diag(gramian)
        alive = np.flatnonzero(squared_norms > ZERO_ROW * squared_norms.max(initial=0.0))
        if alive.size == 0:
            return weights
        if preconditioned is None:
            scaled = gramian[np.ix_(alive, alive)] / squared_norms.max()
            weights[alive] = weighting(th.from_numpy(scaled)).numpy()
            return weights
        norms = np.sqrt(squared_norms[alive])
        wanted = (
            np.full(len(gramian), 1 / len(gramian))
            if preference is None
            else preference.double().numpy()
        )
        preconditioned.pref_vector = th.from_numpy(wanted[alive] * norms / norms.max())
        scaled = gramian[np.ix_(alive, alive)] / np.outer(norms, norms)
        weights[alive] = preconditioned(th.from_numpy(scaled)).numpy() / norms * norms.max()
        return weights

    return resolve


#: Resolvers by the name that ``GCRPPO(resolver=...)`` takes.
RESOLVERS: dict[str, Resolver] = {
    "gcr": gcr,
    "gcr_authors": gcr_authors,
    "no_priority": no_priority,
    "sum": plain_sum,
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

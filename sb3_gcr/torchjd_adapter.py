"""TorchJD's weightings of Gramians as resolvers."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_gcr.angles import Gramian, Levels
from sb3_gcr.guaranteed import ZERO_ROW
from sb3_gcr.resolvers import Resolver


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

    def resolve(gramian: Gramian, levels: Levels, rng: np.random.Generator) -> NDArray[np.float64]:
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

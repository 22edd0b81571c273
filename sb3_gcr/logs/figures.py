"""The figures of an update: from what its minibatches leave behind to logger keys."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_gcr.losses import kl_estimates, leaves_range, surrogate_losses, value_errors
from sb3_gcr.resolvers import conflicts, cosines
from sb3_gcr.rewards.spec import RewardSpec

if TYPE_CHECKING:
    pass


class Samples(NamedTuple):
    """The B samples of a minibatch, as the log needs them: NumPy arrays or tensors; K
    components.
    """

    log_prob: Any  # (B,)
    old_log_prob: Any  # (B,)
    advantages: Any  # (B, K)
    values: Any  # (B, K)
    old_values: Any  # (B, K)
    returns: Any  # (B, K)
    entropy_loss: Any  # ()
    kappa: th.Tensor  # ()


class Minibatch(NamedTuple):
    """A minibatch and how its gradients were resolved, on the host."""

    samples: Samples
    gramian: NDArray[np.float64]  # (K, K)
    weights: NDArray[np.float64]  # (K,)


class EpochStatistics(NamedTuple):
    """Figures of the M minibatches of an epoch, on the host; K components."""

    gramians: NDArray[np.float64]  # (M, K, K)
    weights: NDArray[np.float64]  # (M, K)
    policy_losses: NDArray[np.float64]  # (M, K)
    value_losses: NDArray[np.float64]  # (M, K)
    clip_fractions: NDArray[np.float64]  # (M,)
    kl: NDArray[np.float64]  # (M,)
    entropy_losses: NDArray[np.float64]  # (M,)
    kappas: NDArray[np.float64]  # (M,)


def measure_epoch(
    minibatches: Sequence[Minibatch], clip_range: float, clip_range_vf: float | None
) -> EpochStatistics:
    """The figures of all minibatches of an epoch at once, with one transfer from the device.

    :param minibatches: at least one
    :param clip_range: PPO's ε
    :param clip_range_vf: bound of a value head's change, or None
    """
    samples, gramians, weights = zip(*minibatches, strict=True)
    *columns, entropy_losses, kappas = zip(*samples, strict=True)
    log_prob, old_log_prob, advantages, values, old_values, returns = map(join, columns)
    figures = [
        surrogate_losses(log_prob, old_log_prob, advantages, clip_range),
        value_errors(values, old_values, returns, clip_range_vf).square(),
        leaves_range(log_prob, old_log_prob, clip_range).to(log_prob.dtype).unsqueeze(1),
        kl_estimates(log_prob, old_log_prob).unsqueeze(1),
    ]
    sizes = th.tensor([len(array) for array in columns[0]], device=log_prob.device)
    means = th.segment_reduce(th.cat(figures, 1), "mean", lengths=sizes)
    own = [join([scalar.reshape(1) for scalar in scalars]) for scalars in (entropy_losses, kappas)]
    host = th.column_stack([means, *own]).cpu().numpy().astype(float)
    n = advantages.shape[1]
    return EpochStatistics(
        np.array(gramians), np.array(weights), host[:, :n], host[:, n : 2 * n], *host[:, 2 * n :].T
    )


def join(arrays: Sequence[Any]) -> th.Tensor:
    """One tensor of several, or of several NumPy arrays, along the first axis."""
    return (
        th.cat(list(arrays))
        if isinstance(arrays[0], th.Tensor)
        else th.from_numpy(np.concatenate(arrays))
    )


def summarise(
    epochs: Sequence[EpochStatistics], spec: RewardSpec
) -> tuple[dict[str, float], dict[str, float]]:
    """Means over all minibatches of an update, by logger key.

    :param epochs: at least one
    :param spec: names the components
    :return: PPO's keys and ours without a component (``approx_kl`` over the last epoch, as in PPO),
        and those per component
    """
    update = EpochStatistics(*(np.concatenate(arrays) for arrays in zip(*epochs, strict=True)))
    clash = conflicts(update.gramians)
    value_losses = update.value_losses.mean(0)
    n_conflicts = clash.sum((1, 2)).mean() / 2
    n_pairs = max(1, len(spec) * (len(spec) - 1) // 2)
    scalars = {
        "train/entropy_loss": update.entropy_losses.mean(),
        "train/policy_gradient_loss": (update.weights * update.policy_losses).sum(1).mean(),
        "train/value_loss": value_losses.sum(),
        "train/approx_kl": epochs[-1].kl.mean(),
        "train/clip_fraction": update.clip_fractions.mean(),
        "gcr/conflicts": n_conflicts,
        "gcr/conflict_rate": n_conflicts / n_pairs,
        "gcr/kappa": update.kappas.mean(),
    }
    by_component = {
        "gcr/weight": update.weights.mean(0),
        "gcr/grad_norm": np.sqrt(np.diagonal(update.gramians, axis1=1, axis2=2)).mean(0),
        "gcr/in_conflict": clash.any(2).mean(0),
        "train/value_loss": value_losses,
    }
    components = {
        f"{key}/{name}": float(value)
        for key, values in by_component.items()
        for name, value in zip(spec.names, values, strict=True)
    }
    return {key: float(value) for key, value in scalars.items()}, components


def mean_cosines(epochs: Sequence[EpochStatistics]) -> NDArray[np.float64]:
    """Cosine matrix of the component gradients, mean over the minibatches of an update, shape (K,
    K).
    """
    return np.asarray(cosines(np.concatenate([epoch.gramians for epoch in epochs])).mean(0))

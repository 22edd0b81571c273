"""The figures of an update: what its minibatches leave behind, by logger key.

To log a figure of the samples, add it to ``SAMPLE_FIGURES``; to log a figure of the update, add a
key to ``UPDATE_FIGURES`` or ``COMPONENT_FIGURES``. Everything that has one number per component is
logged under ``gcr/<figure>/<name>``, so no key is another key's folder.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.utils import explained_variance

from sb3_gcr.angles import conflicts, cosines
from sb3_gcr.conflicts.estimators import Estimate, signal_shares
from sb3_gcr.gradients.memory import Array, Weights
from sb3_gcr.losses import Clip, brakes, kl_estimates, leaves_range, surrogate_losses, value_errors
from sb3_gcr.rewards.spec import RewardSpec

Numbers = NDArray[np.float64]


class Samples(NamedTuple):
    """B samples of a minibatch and what the policy says of them; K components."""

    log_prob: Array  # log π(a|s), (B,)
    old_log_prob: Array  # (B,)
    advantages: Array  # Â, (B, K)
    values: Array  # V, (B, K)
    old_values: Array  # (B, K)
    returns: Array  # Ĝ, (B, K)


#: Figures of each sample, of shape (B, K) or (B,); logged are their means over a minibatch.
SAMPLE_FIGURES: dict[str, Callable[[Samples, Clip], Array]] = {
    "policy_losses": lambda s, clip: surrogate_losses(
        s.log_prob, s.old_log_prob, s.advantages, clip
    ),
    "brakes": lambda s, clip: brakes(s.log_prob, s.old_log_prob, s.advantages, clip.policy),
    "value_losses": lambda s, clip: (
        value_errors(s.values, s.old_values, s.returns, clip.values) ** 2
    ),
    "clip_fractions": lambda s, clip: leaves_range(s.log_prob, s.old_log_prob, clip.policy),
    "kl": lambda s, clip: kl_estimates(s.log_prob, s.old_log_prob),
}


class Figures(NamedTuple):
    """Figures of M minibatches, on the host; K components."""

    gramians: Numbers  # G, (M, K, K)
    weights: Numbers  # w, (M, K)
    kappas: Numbers  # κ, (M,)
    entropy_losses: Numbers  # (M,)
    policy_losses: Numbers  # L^(k), (M, K)
    value_losses: Numbers  # (M, K)
    brakes: Numbers  # (M,)
    clip_fractions: Numbers  # (M,)
    kl: Numbers  # (M,)
    unbiased: Numbers  # Ĝ, (M, K, K), NaN where a minibatch has none


#: Figures of an update by logger key, one number each.
UPDATE_FIGURES: dict[str, Callable[[Figures], float]] = {
    "train/entropy_loss": lambda f: f.entropy_losses.mean(),
    "train/policy_gradient_loss": lambda f: (f.weights * f.policy_losses).sum(1).mean(),
    "train/value_loss": lambda f: f.value_losses.mean(0).sum(),
    "train/clip_fraction": lambda f: f.clip_fractions.mean(),
    "gcr/conflicts": lambda f: n_conflicts(f.gramians).mean(),
    "gcr/conflict_rate": lambda f: n_conflicts(f.gramians).mean() / n_pairs(f.gramians),
    "gcr/kappa": lambda f: f.kappas.mean(),
    "gcr/brake": lambda f: f.brakes.mean(),
}
#: Figures of an update by the beginning of their logger keys, one number for each component.
COMPONENT_FIGURES: dict[str, Callable[[Figures], Numbers]] = {
    "gcr/weight": lambda f: f.weights.mean(0),
    "gcr/grad_norm": lambda f: np.sqrt(f.gramians.diagonal(0, 1, 2)).mean(0),
    "gcr/in_conflict": lambda f: conflicts(f.gramians).any(2).mean(0),
    "gcr/value_loss": lambda f: f.value_losses.mean(0),
    "gcr/signal": lambda f: signals(f),
}


class Record:
    """What the minibatches of an update leave behind, measured once an epoch with one transfer from
    the device.

    :param clip: the clip ranges of the update
    """

    def __init__(self, clip: Clip):
        self.clip = clip
        self.epochs: list[Figures] = []
        self._forget()

    def _forget(self) -> None:
        self._samples: list[Samples] = []
        self._entropy_losses: list[Array] = []
        self._kappas: list[float] = []
        self._gramians: list[Numbers] = []
        self._weights: list[Weights] = []
        self._unbiased: list[Array | None] = []

    def __len__(self) -> int:
        """Number of minibatches so far."""
        return len(self._samples) + sum(len(epoch.kl) for epoch in self.epochs)

    def add(
        self,
        samples: Samples,
        entropy_loss: Array,
        kappa: float,
        gramian: Numbers,
        weights: Weights,
        unbiased_gramian: Array | None = None,
    ) -> None:
        """Take down a minibatch.

        :param samples: the minibatch
        :param entropy_loss: PPO's, one number
        :param kappa: κ, a number or an array of one
        :param gramian: G, shape (K, K)
        :param weights: w, shape (K,)
        :param unbiased_gramian: Ĝ, shape (K, K), where there is one
        """
        self._unbiased.append(unbiased_gramian)
        self._samples.append(samples)
        self._entropy_losses.append(entropy_loss)
        self._kappas.append(kappa)
        self._gramians.append(gramian)
        self._weights.append(weights)

    def end_epoch(self) -> None:
        """Measure the minibatches of the epoch and forget them."""
        columns = [join(arrays) for arrays in zip(*self._samples, strict=True)]
        samples = Samples(*columns)
        sizes = th.tensor([len(s.log_prob) for s in self._samples], device=samples.log_prob.device)
        measured = [_as_columns(figure(samples, self.clip)) for figure in SAMPLE_FIGURES.values()]
        means = th.segment_reduce(th.cat(measured, 1), "mean", lengths=sizes)
        entropy_losses = join([number.reshape(1) for number in self._entropy_losses])
        kappas = _as_vector(self._kappas).to(means)
        host = th.column_stack([means, entropy_losses, kappas]).cpu().numpy().astype(float)
        ends = np.cumsum([figure.shape[1] for figure in measured])
        *parts, own = np.split(host, ends, axis=1)
        by_name = dict(zip(SAMPLE_FIGURES, parts, strict=True))
        self.epochs.append(
            Figures(
                gramians=np.array(self._gramians),
                weights=np.array(self._weights),
                kappas=own[:, 1],
                entropy_losses=own[:, 0],
                policy_losses=by_name["policy_losses"],
                value_losses=by_name["value_losses"],
                brakes=by_name["brakes"][:, 0],
                clip_fractions=by_name["clip_fractions"][:, 0],
                kl=by_name["kl"][:, 0],
                unbiased=_on_host(self._unbiased, np.shape(self._gramians[0])),
            )
        )
        self._forget()

    def last_loss(self, ent_coef: float, vf_coef: float) -> float:
        """PPO's loss of the last minibatch: Σ w L + ent_coef · L_entropy + vf_coef · Σ L_V."""
        last = self.epochs[-1]
        policy_loss = last.weights[-1] @ last.policy_losses[-1]
        value_loss = last.value_losses[-1].sum()
        return float(policy_loss + ent_coef * last.entropy_losses[-1] + vf_coef * value_loss)

    def update(self) -> Figures:
        """The figures of all minibatches of the update."""
        return Figures(*(np.concatenate(arrays) for arrays in zip(*self.epochs, strict=True)))


def by_key(record: Record, spec: RewardSpec) -> tuple[dict[str, float], dict[str, float]]:
    """Means over all minibatches of an update, by logger key.

    :param record: of at least one epoch
    :param spec: names the components
    :return: PPO's keys and ours without a component (``approx_kl`` over the last epoch, as in PPO),
        and those of each component
    """
    figures = record.update()
    scalars = {key: float(figure(figures)) for key, figure in UPDATE_FIGURES.items()}
    scalars["train/approx_kl"] = float(record.epochs[-1].kl.mean())
    components = {
        f"{key}/{name}": float(number)
        for key, figure in COMPONENT_FIGURES.items()
        for name, number in zip(spec.names, figure(figures), strict=True)
        if not np.isnan(number)  # no minibatch has an unbiased Gramian
    }
    return scalars, components


def of_rollout(
    buffer: RolloutBuffer, spec: RewardSpec
) -> tuple[dict[str, float], dict[str, float]]:
    """How much of the returns the critic explained when the rollout was made, by logger key.

    :param buffer: values and returns of shape (T, N, K)
    :param spec: names the components
    :return: of the sum, under PPO's key, and of each component
    """
    values, returns = buffer.values, buffer.returns
    total = explained_variance(values.sum(-1).flatten(), returns.sum(-1).flatten())
    components = {
        f"gcr/explained_variance/{name}": float(
            explained_variance(values[..., k].flatten(), returns[..., k].flatten())
        )
        for k, name in enumerate(spec.names)
    }
    return {"train/explained_variance": float(total)}, components


def mean_cosines(record: Record) -> Numbers:
    """Cosines of the component gradients, mean over the minibatches of an update, shape (K, K)."""
    return np.asarray(cosines(record.update().gramians).mean(0))


def unbiased(record: Record) -> Estimate:
    """Ĝ, mean over the minibatches of the first epoch, and its standard errors from their scatter;
    NaN where there are none, and an error that is not known.
    """
    known = _with_unbiased(record.update())
    gramians = known.unbiased
    if len(gramians) == 0:
        none = np.full(gramians.shape[1:], np.nan)
        return Estimate(none, none, none.diagonal())
    errors = np.full(gramians.shape[1:], np.nan)
    if len(gramians) > 1:
        errors = gramians.std(0, ddof=1) / np.sqrt(len(gramians))
    return Estimate(gramians.mean(0), errors, known.gramians.mean(0).diagonal())


def signals(figures: Figures) -> Numbers:
    """Share of each component's squared gradient norm in a minibatch that is signal, shape (K,);
    NaN where no minibatch has an unbiased Gramian.
    """
    known = _with_unbiased(figures)
    if len(known.unbiased) == 0:
        return np.full(figures.gramians.shape[-1], np.nan)
    return signal_shares(known.unbiased.mean(0), known.gramians.mean(0).diagonal())


def _with_unbiased(figures: Figures) -> Figures:
    """Those of minibatches that have an unbiased Gramian."""
    known = ~np.isnan(figures.unbiased[:, 0, 0])
    return Figures(*(column[known] for column in figures))


def n_conflicts(gramians: Numbers) -> Numbers:
    """Number of conflicting pairs of each minibatch, shape (M,).

    :param gramians: G, shape (M, K, K)
    """
    return np.asarray(conflicts(gramians).sum((1, 2)) / 2)


def n_pairs(gramians: Numbers) -> int:
    """Number of pairs of components, at least 1.

    :param gramians: G, shape (M, K, K)
    """
    n_components = gramians.shape[-1]
    return max(1, n_components * (n_components - 1) // 2)


def join(arrays: Sequence[Array]) -> th.Tensor:
    """One tensor of several tensors, or of several NumPy arrays, along the first axis."""
    if isinstance(arrays[0], th.Tensor):
        return th.cat(list(arrays))
    return th.from_numpy(np.concatenate(arrays))


def _on_host(gramians: Sequence[Array | None], shape: tuple[int, ...]) -> Numbers:
    """Ĝ of each minibatch, NaN where there is none, with one transfer; shape (M, K, K)."""
    host = np.full((len(gramians), *shape), np.nan)
    known = {index: gramian for index, gramian in enumerate(gramians) if gramian is not None}
    if known:
        joined = join([gramian[None] for gramian in known.values()])
        host[list(known)] = joined.cpu().numpy()
    return host


def _as_vector(numbers: Sequence[Array]) -> th.Tensor:
    """Numbers, or arrays of one, as a tensor."""
    if isinstance(numbers[0], th.Tensor):
        return th.stack(list(numbers))
    return th.tensor(np.array(numbers))


def _as_columns(figure: th.Tensor) -> th.Tensor:
    """Figures of each sample as float columns, shape (B, 1) or (B, K)."""
    return figure.float() if figure.ndim == 2 else figure.float().unsqueeze(1)

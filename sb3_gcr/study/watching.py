"""Watching a training: the returns of episodes, the gradients of minibatches, and the clock."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback

from sb3_gcr.angles import conflicts, cosines
from sb3_gcr.resolvers import Resolver

#: Equal parts of a training, each with one number of everything.
WINDOWS = 50

Array = NDArray[np.float64]


class Episode(NamedTuple):
    """An episode that ended."""

    steps: int
    total: float
    terms: Sequence[float]
    was_terminated: bool


class Update(NamedTuple):
    """Means over the minibatches of an update of K > 1 components.

    :param steps: env steps before the update
    :param conflicts: number of conflicting pairs
    :param dominance: largest norm's share of the sum of the norms
    :param weights: shape (K,)
    :param cosines: shape (K, K)
    """

    steps: int
    conflicts: float
    dominance: float
    weights: Array
    cosines: Array


class WatchedResolver:
    """A resolver that remembers what it was asked and what it answered since it was last read.

    :param resolver: does the work
    """

    def __init__(self, resolver: Resolver):
        self.resolver = resolver
        self._gramians: list[Array] = []
        self._weights: list[Array] = []

    def __call__(self, gramian: Array, levels: NDArray[Any], rng: np.random.Generator) -> Array:
        """The resolver's weights, shape (K,)."""
        weights = self.resolver(gramian, levels, rng)
        self._gramians.append(gramian.copy())
        self._weights.append(np.array(weights, dtype=float))
        return weights

    def forget(self) -> None:
        """Begin anew."""
        self._gramians, self._weights = [], []

    def read(self, steps: int) -> Update | None:
        """The means since the last reading; None where there was no minibatch of K > 1.

        :param steps: env steps so far
        """
        if not self._gramians or len(self._gramians[0]) == 1:
            self.forget()
            return None
        gramians, weights = np.array(self._gramians), np.array(self._weights)
        self.forget()
        norms = np.sqrt(np.maximum(np.diagonal(gramians, axis1=1, axis2=2), 0.0))
        sums = norms.sum(1)
        shares = np.divide(norms.max(1), sums, out=np.zeros_like(sums), where=sums > 0)
        return Update(
            steps=steps,
            conflicts=float(conflicts(gramians).sum((1, 2)).mean() / 2),
            dominance=float(shares.mean()),
            weights=weights.mean(0),
            cosines=cosines(gramians).mean(0),
        )


class Recorder(BaseCallback):
    """Keeps all episodes and updates of a training, and where its time went.

    :param names: of the terms
    :param resolver: of the model
    :param total: env steps of the training
    """

    def __init__(self, names: Sequence[str], resolver: WatchedResolver, total: int):
        super().__init__()
        self.keys = [f"r_{name}" for name in names]
        self.resolver = resolver
        self.total = total
        self.episodes: list[Episode] = []
        self.updates: list[Update] = []
        self.collect_s = 0.0
        self.update_s = 0.0
        self._clock = 0.0
        self._is_updating = False

    def _on_training_start(self) -> None:
        self.resolver.forget()  # what GCRPPO asked to check the resolver

    def _on_rollout_start(self) -> None:
        self._end_update()
        self._clock = time.perf_counter()

    def _on_step(self) -> bool:
        dones = self.locals["dones"]
        if dones.any():
            infos = self.locals["infos"]
            ended = [finished(infos[i], self.keys, self.num_timesteps) for i in dones.nonzero()[0]]
            self.episodes.extend(ended)
        return True

    def _on_rollout_end(self) -> None:
        now = time.perf_counter()
        self.collect_s += now - self._clock
        self._clock = now
        self._is_updating = True

    def _on_training_end(self) -> None:
        self._end_update()

    def _end_update(self) -> None:
        """Read the update that follows a rollout; the first rollout follows none."""
        if not self._is_updating:
            return
        self._is_updating = False
        self.update_s += time.perf_counter() - self._clock
        update = self.resolver.read(self.num_timesteps)
        if update is not None:
            self.updates.append(update)
        self._say()

    def _say(self) -> None:
        """A line for the log of the cell."""
        returns = [episode.total for episode in self.episodes[-100:]]
        shown = f"{np.mean(returns):.4g}" if returns else "none yet"
        sys.stdout.write(f"{self.num_timesteps} of {self.total} steps, return {shown}\n")
        sys.stdout.flush()


def finished(info: dict[str, Any], keys: Sequence[str], steps: int) -> Episode:
    """What the info of an episode's last step says.

    :param info: with Monitor's ``episode`` and the returns of the terms
    :param keys: of these returns
    :param steps: env steps so far
    """
    episode = info["episode"]
    terms = [float(info[key] if key in info else episode[key]) for key in keys]
    return Episode(steps, float(episode["r"]), terms, not info["TimeLimit.truncated"])


def over_windows(steps: Sequence[int], values: Array, total: int) -> list[Any]:
    """The mean of each window; one without values repeats the one before it, the first ones are
    None.

    :param steps: when each value came, in (0, total], shape (n,)
    :param values: shape (n,) or (n, k)
    :param total: end of the last window
    """
    places = np.minimum((np.asarray(steps, dtype=int) - 1) * WINDOWS // total, WINDOWS - 1)
    means: list[Any] = []
    for window in range(WINDOWS):
        own = values[places == window] if len(values) else values
        before = means[-1] if means else None
        means.append(own.mean(0) if len(own) else before)
    return means

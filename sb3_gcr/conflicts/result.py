"""What a measurement of conflicts says: numbers, tables, sentences, a picture."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_gcr.conflicts.estimators import CERTAIN, Estimate
from sb3_gcr.logs.shown import cosine_figure, format_table
from sb3_gcr.rewards.spec import RewardSpec, level_label

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

#: Of many pairs some are beyond two standard errors by chance; beyond so many hardly any.
REALLY = 3.0
#: A pair with a cosine from here on may as well be one term.
ALIKE = 0.9


class Pair(NamedTuple):
    """Two terms of a reward."""

    first: str
    second: str
    cosine: float
    """Between their gradients; NaN where one has no signal."""
    z: float
    """Product of their gradients in standard errors."""


class Conflicts:
    """How the gradients of K reward terms really stand to each other.

    :param spec: names and levels of the terms
    :param estimate: unbiased products of their gradients
    :param naive: products within the blocks, noise included, shape (K, K)
    :param n_blocks: number of independent blocks
    """

    def __init__(
        self, spec: RewardSpec, estimate: Estimate, naive: NDArray[np.float64], n_blocks: int
    ):
        self.spec = spec
        self.estimate = estimate
        self.naive = naive
        self.n_blocks = n_blocks
        #: Names of the terms.
        self.names = spec.names
        #: Cosines between gradients, shape (K, K); NaN where one of the two has no signal.
        self.cosines = estimate.cosines
        #: Products of gradients in standard errors, shape (K, K).
        self.z = estimate.z
        #: Share of each term's squared gradient norm in a block that is signal, shape (K,).
        self.signal = estimate.signal

    def pairs(self) -> list[Pair]:
        """All pairs, the strongest conflict first, those without a signal last."""
        found = list(self._pairs())
        return sorted(found, key=lambda pair: (np.isnan(pair.cosine), pair.cosine))

    def _pairs(self) -> Iterator[Pair]:
        for i, first in enumerate(self.names):
            for j in range(i + 1, len(self.names)):
                cosine, z = float(self.cosines[i, j]), float(self.z[i, j])
                yield Pair(first, self.names[j], cosine, z)

    def sentences(self) -> list[str]:
        """One sentence for each pair that matters, and for each term without a signal."""
        lines = [sentence for pair in self.pairs() if (sentence := _sentence(pair))]
        silent = [
            name for name, has in zip(self.names, self.estimate.has_signal, strict=True) if not has
        ]
        return [*lines, *(f"{name} has no signal yet." for name in silent)]

    def table(self) -> str:
        """Signal of each term, cosine of each pair, and how certain they are, as text."""
        terms = [["component", "level", "signal", "z"]]
        for index, (name, level) in enumerate(self.spec):
            share, z = self.signal[index], self.z[index, index]
            terms.append([name, level_label(level), f"{share:.2f}", f"{z:.1f}"])
        pairs = [["component", "and", "cosine", "z"]]
        for pair in self.pairs():
            cosine = "no signal" if np.isnan(pair.cosine) else f"{pair.cosine:+.2f}"
            pairs.append([pair.first, pair.second, cosine, f"{pair.z:+.1f}"])
        return f"{format_table(terms)}\n{format_table(pairs)}"

    def figure(self) -> Figure:
        """The matrix of cosines, beside the one that the blocks' own noise is part of.

        :raises ImportError: if matplotlib is missing
        """
        lengths = np.sqrt(np.maximum(self.naive.diagonal(), np.finfo(float).tiny))
        within = self.naive / np.outer(lengths, lengths)
        matrices = {"without shared noise": self.cosines, "within a rollout": within}
        return cosine_figure(self.spec, matrices)

    def to_frame(self) -> pd.DataFrame:
        """One row a pair; a term with itself has its signal.

        :raises ImportError: if pandas is missing
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise ImportError("Frames need pandas: pip install 'sb3_gcr[plots]'") from error
        first, second = np.triu_indices(len(self.names))
        names = np.array(self.names)
        signal = np.where(first == second, self.signal[first], np.nan)
        return pd.DataFrame(
            {
                "first": names[first],
                "second": names[second],
                "cosine": self.cosines[first, second],
                "z": self.z[first, second],
                "product": self.estimate.gramian[first, second],
                "standard_error": self.estimate.errors[first, second],
                "signal": signal,
            }
        )

    def __repr__(self) -> str:
        return self.table()


def _sentence(pair: Pair) -> str | None:
    """What a pair has to say; None if nothing."""
    if np.isnan(pair.cosine):
        return None
    figures = f"{pair.cosine:.2f}, z = {pair.z:.1f}".replace("-", "\N{MINUS SIGN}")
    if -REALLY <= pair.z < -CERTAIN:
        return f"{pair.first} and {pair.second} may conflict: {figures}."
    if pair.z < -REALLY:
        return f"{pair.first} and {pair.second} really conflict: {figures}."
    if pair.z > CERTAIN and pair.cosine >= ALIKE:
        return f"{pair.first} and {pair.second} want the same: {figures}."
    return None

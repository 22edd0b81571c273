"""Returns of several configurations on one scale."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from sb3_gcr.study.statistics import normalised_score
from sb3_gcr.study.tables import FINAL, TRAINING, Roles, random_return, sample

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd


class Scores(NamedTuple):
    """Scaled returns of the configurations in which that is possible, by method and metric.

    :param samples: scores of the seeds, one array a configuration
    :param left_out: configurations in which the baseline does not beat random actions
    """

    samples: dict[tuple[str, str], dict[str, np.ndarray]]
    left_out: tuple[str, ...]


def scaled(cells: pd.DataFrame, who: Roles) -> Scores:
    """Returns from 0, random actions, to 1, the baseline's mean of the same metric."""
    samples: dict[tuple[str, str], dict[str, np.ndarray]] = {}
    left_out = []
    for name, group in cells.groupby("configuration", sort=False):
        random = random_return(group)
        for metric in (TRAINING, FINAL):
            reference = sample(group, who.baseline, metric)
            if not len(reference) or not reference.mean() > random:
                left_out.append(str(name))
                continue
            for method in dict.fromkeys(group["method"]):
                values = sample(group, method, metric)
                if len(values):
                    score = normalised_score(values, random, float(reference.mean()))
                    samples.setdefault((method, metric), {})[str(name)] = score
    return Scores(samples, tuple(dict.fromkeys(left_out)))

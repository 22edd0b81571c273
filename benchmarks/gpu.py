"""Rows of one policy update on a GPU, with the sizes of the paper: 4096 envs, 24 steps, 4
minibatches.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from benchmarks.measuring import Case
from benchmarks.rollouts import Setting
from benchmarks.updates import FLAT, gcrppo, ppo

BATCH = 24_576
GPU = Setting((400, 200, 100), BATCH, n_samples=4 * BATCH, n_epochs=5, device="cuda")


def cases(setting: Setting = GPU, gramian_samples: int = 2048) -> list[Case]:
    """All rows of this group.

    :param setting: what to update
    :param gramian_samples: size of the subset in the rows with one
    """
    subset: dict[str, Any] = {
        "note": f" gramian_samples={gramian_samples}",
        "gramian_samples": gramian_samples,
    }
    rows = []
    for k in (7, 20):
        exact, few = partial(gcrppo, setting, k), partial(gcrppo, setting, k, **subset)
        plain, flat = (
            partial(gcrppo, setting, k, note=" sum", resolver="sum"),
            partial(FLAT, setting, k),
        )
        for subject, baseline, bar in (
            (few, plain, 1.15 if k == 20 else None),
            (exact, plain, 2.5 if k == 20 else None),
            (few, flat, None),
            (exact, flat, None),
            (exact, partial(ppo, setting, k), None),
        ):
            rows.append(Case("gpu", str(setting), subject, baseline, bar, needs=("cuda",)))
    return rows

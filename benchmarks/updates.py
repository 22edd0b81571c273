"""Rows of one policy update: ``train()`` on the same synthetic rollout."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from stable_baselines3 import PPO

from benchmarks.jax_ppo import sbx_update
from benchmarks.measuring import Case, Contestant
from benchmarks.references import Autojac, FlatProjection
from benchmarks.rollouts import Setting, torch_update
from sb3_gcr import GCRPPO

Maker = Callable[[Setting, int], Contestant]

SMALL = Setting((64, 64), 64)
SMALL_OBS = Setting((64, 64), 64, obs_size=45)
SMALL_256 = Setting((64, 64), 256)
SMALL_2048 = Setting((64, 64), 2048, n_samples=8192)
MIDDLE = Setting((256, 256), 64)
MIDDLE_256 = Setting((256, 256), 256)
MIDDLE_2048 = Setting((256, 256), 2048, n_samples=4096)
LARGE_256 = Setting((400, 200, 100), 256)
LARGE_2048 = Setting((400, 200, 100), 2048, n_samples=4096)


def ppo(setting: Setting, n_components: int) -> Contestant:
    """SB3's PPO on the summed reward."""
    return torch_update("PPO", PPO, setting, n_components)


def gcrppo(setting: Setting, n_components: int, note: str = "", **kwargs: Any) -> Contestant:
    """GCRPPO, with what its defaults are not."""
    return torch_update(f"GCRPPO K={n_components}{note}", GCRPPO, setting, n_components, **kwargs)


def reference(
    algorithm: type[GCRPPO], label: str, setting: Setting, n_components: int
) -> Contestant:
    """One of the reference updates."""
    return torch_update(f"{label} K={n_components}", algorithm, setting, n_components)


PASSES = partial(gcrppo, note=" passes", gramian_method="passes")
SUBSET = partial(gcrppo, note=" gramian_samples=512", gramian_samples=512)
FLAT = partial(reference, FlatProjection, "flat projection")
AUTOJAC = partial(reference, Autojac, "TorchJD autojac")

#: Setting, K of the subjects, and the bar where there is one: GCRPPO as it comes against PPO.
DEFAULTS: list[tuple[Setting, int, float | None]] = [
    (SMALL, 1, None),
    (SMALL, 2, None),
    (SMALL, 4, 0.65),
    (SMALL, 10, 0.75),
    (SMALL, 20, 0.90),
    (SMALL, 50, None),
    (SMALL_OBS, 10, None),
    (SMALL_256, 4, None),
    (SMALL_256, 10, 1.00),
    (SMALL_256, 20, None),
    (SMALL_2048, 10, None),
    (MIDDLE, 10, None),
    (MIDDLE_256, 10, None),
    (MIDDLE_2048, 10, None),
    (LARGE_256, 10, None),
    (LARGE_2048, 10, 2.50),
]
#: The same against PPO for other ways to the update.
OTHERS: list[tuple[Setting, int, Maker, str | None, float | None]] = [
    (LARGE_2048, 10, SUBSET, None, 1.30),
    *((SMALL, k, PASSES, None, None) for k in (4, 10, 20)),
    (SMALL_256, 10, PASSES, None, None),
    (LARGE_2048, 10, PASSES, None, None),
    *((SMALL, k, FLAT, None, None) for k in (4, 10, 20)),
    (SMALL_256, 10, FLAT, None, None),
    (LARGE_2048, 10, FLAT, None, None),
    *((SMALL, k, AUTOJAC, "torchjd", None) for k in (4, 10, 20)),
    (SMALL_256, 10, AUTOJAC, "torchjd", None),
    *(
        (setting, 4, sbx_update, "sbx", None)
        for setting in (SMALL, SMALL_256, MIDDLE_256, LARGE_2048)
    ),
]


def cases() -> list[Case]:
    """All rows of this group."""

    def case(
        setting: Setting,
        subject: Callable[[], Contestant],
        baseline: Callable[[], Contestant],
        *needs: str,
        bar: float | None,
    ) -> Case:
        return Case("update", str(setting), subject, baseline, bar, needs=needs)

    return [
        *(case(s, partial(gcrppo, s, k), partial(ppo, s, k), bar=bar) for s, k, bar in DEFAULTS),
        case(SMALL, partial(gcrppo, SMALL, 20), partial(gcrppo, SMALL, 2), bar=1.30),
        case(SMALL, partial(gcrppo, SMALL, 4), partial(sbx_update, SMALL, 4), "sbx", bar=1.00),
        *(
            case(s, partial(make, s, k), partial(ppo, s, k), *([need] if need else []), bar=bar)
            for s, k, make, need, bar in OTHERS
        ),
    ]

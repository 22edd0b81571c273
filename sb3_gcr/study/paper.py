"""The paper's tables as data: arXiv:2509.14816, numbers as printed, and what they come to.

Ten seeds a method and task; returns of deterministic evaluation, in each task's own unit. The
paper's win rates by level, its scores of single families and its curves are not here.
"""

from __future__ import annotations

from typing import NamedTuple

from sb3_gcr.study.statistics import Summary

#: Seeds of each method on each of the thirteen tasks.
SEEDS = 10
#: Ranges of each objective in the two families of multi-objective tasks: L0 to L4.
LEVELS = 5


class TaskRow(NamedTuple):
    """One row of the paper's first table.

    ``components`` is the number K of reward terms and ``conflicts`` the mean number of pairs of
    terms whose gradients conflict. ``mask_aligned`` says whether the authors' released code
    protects the terms that it means to protect (False: other columns of the reward vector).
    """

    task: str
    components: int
    baseline_mean: float
    baseline_sd: float
    gcr_mean: float
    gcr_sd: float
    spc_percent: float
    conflicts: float
    mask_aligned: bool

    @property
    def baseline(self) -> Summary:
        """PPO's return."""
        return Summary(self.baseline_mean, self.baseline_sd, SEEDS)

    @property
    def gcr(self) -> Summary:
        """GCR-PPO's return."""
        return Summary(self.gcr_mean, self.gcr_sd, SEEDS)

    @property
    def pairs(self) -> int:
        """K (K - 1) / 2 pairs of terms."""
        return self.components * (self.components - 1) // 2

    @property
    def conflict_rate(self) -> float:
        """Share of the pairs that conflict."""
        return self.conflicts / self.pairs


#: Table 1, in the order of the conflicts.
TASKS = (
    TaskRow("Quadcopter", 3, 64.205, 1.61, 64.911, 1.583, 1.09, 0.15, True),
    TaskRow("Reach-UR10", 5, 0.74, 0.006, 0.741, 0.016, 0.13, 0.18, True),
    TaskRow("Reach-Franka", 5, 0.749, 0.011, 0.743, 0.013, -0.8, 0.2, True),
    TaskRow("Repose-Cube-Shadow", 5, 9452.69, 205.21, 9230.76, 410.37, -2.36, 0.39, True),
    TaskRow("Velocity-Rough-Unitree-Go2", 10, 36.84, 0.25, 36.34, 0.65, -1.37, 0.45, True),
    TaskRow("Lift-Cube-Franka", 6, 157.25, 4.54, 158.83, 0.63, 1.0, 0.91, True),
    TaskRow("Velocity-Rough-H1", 14, 35.54, 0.14, 35.56, 0.34, 0.06, 1.2, False),
    TaskRow("Open-Drawer-Franka", 9, 98.73, 1.03, 98.98, 0.63, 0.25, 2.32, True),
    TaskRow("Ant", 7, 195.12, 10.13, 197.48, 14.24, 1.2, 2.49, False),
    TaskRow("Humanoid", 7, 276.58, 27.25, 329.79, 24.79, 19.24, 3.13, False),
    TaskRow("Velocity-Rough-G1", 16, 46.47, 1.18, 48.1, 1.66, 3.47, 3.23, False),
    TaskRow("Repose-Cube-Allegro", 5, 167.7, 6.94, 174.81, 5.91, 4.12, 4.55, True),
    TaskRow("Tracking-LocoManip-Digit", 26, 23.45, 3.78, 33.06, 11.36, 34.2, 30.71, False),
)


class Family(NamedTuple):
    """A family of multi-objective tasks: its objectives, its draws, and its row of wins.

    Each cardinality (number of active objectives) was drawn ``draws`` times, each active objective
    with a level from 0 to 4; one seed a configuration. ``configurations`` is what the paper's win
    table counts, ``wins`` in how many of them GCR-PPO's return was higher.
    """

    name: str
    objectives: tuple[str, ...]
    cardinalities: tuple[int, ...]
    draws: int
    configurations: int
    wins: int


#: Tables 2 and 3, as far as their totals go.
THROWING = Family(
    "throwing",
    ("baseh", "energy", "ballrel", "bodymo", "lftarm", "rgtarm"),
    (1, 2, 3, 4, 5, 6),
    20,
    99,
    73,
)
HUMANOID = Family("humanoid", ("energy", "gait", "baseh", "armsp"), (1, 2, 3, 4), 20, 74, 74)
FAMILIES = (THROWING, HUMANOID)


class Claim(NamedTuple):
    """A number that the paper states, and what its own tables come to (None: they do not say)."""

    what: str
    printed: float
    recomputed: float | None


CLAIMS = (
    Claim("p of Humanoid, called a paired t-test; it is Welch's", 0.00024, 0.000244),
    Claim("p of Velocity-Rough-G1, called a paired t-test; it is Welch's", 0.022, 0.02206),
    Claim("p of Repose-Cube-Allegro, called a paired t-test; it is Welch's", 0.024, 0.02419),
    Claim("p of Tracking-LocoManip-Digit, called a paired t-test; it is Welch's", 0.028, 0.02762),
    Claim("p of Velocity-Rough-Unitree-Go2, called a paired t-test; it is Welch's", 0.043, 0.04311),
    Claim("Spearman's ρ of conflicts and SPC", 0.736, 0.7363),
    Claim("p of Spearman's ρ; a permutation gives .0053", 0.0041, 0.00411),
    Claim("tasks of 13 with a higher return", 10.0, 10.0),
    Claim("p of 10 in 13, one-sided; two-sided it is .092", 0.046, 0.0461),
    Claim("mean SPC in percent of the 13 tasks; its own column has 4.63", 4.55, 4.489),
    Claim("SPC in percent of Humanoid, which is the plain change", 19.24, 17.55),
    Claim("SPC in percent of Tracking-LocoManip-Digit", 34.2, 34.01),
    Claim("largest SPC in percent; two positive returns cannot give it", 542.0, None),
    Claim("unique tasks; its tables count 13 + 99 + 74", 213.0, 186.0),
    Claim("z beyond which a run is repeated; 10 runs reach 2.85", 3.0, 2.846),
)

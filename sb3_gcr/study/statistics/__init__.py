"""The statistics of a study: pure functions on arrays of results.

``a`` is always the baseline and ``b`` what is compared with it; a difference is b - a, so that a
positive one says that ``b`` is better. Failed runs are left out by the caller and counted apart.
"""

from sb3_gcr.study.statistics.bootstrap import (
    Estimate,
    Improvement,
    iqm,
    probability_of_improvement,
)
from sb3_gcr.study.statistics.counts import (
    Evidence,
    Proportion,
    e_value,
    fisher,
    holm,
    wilson,
)
from sb3_gcr.study.statistics.intervals import (
    Interval,
    Summary,
    is_decided,
    mean_interval,
    seeds_needed,
    summary,
    welch,
    welch_from_summaries,
    welch_over_tasks,
)
from sb3_gcr.study.statistics.permutation import (
    Look,
    Permutation,
    registered_looks,
    sign_permutation,
)
from sb3_gcr.study.statistics.relation import Correlation, Line, line, spearman
from sb3_gcr.study.statistics.scores import Change, normalised_score, spc

__all__ = [
    "Change",
    "Correlation",
    "Estimate",
    "Evidence",
    "Improvement",
    "Interval",
    "Line",
    "Look",
    "Permutation",
    "Proportion",
    "Summary",
    "e_value",
    "fisher",
    "holm",
    "is_decided",
    "iqm",
    "line",
    "mean_interval",
    "normalised_score",
    "probability_of_improvement",
    "registered_looks",
    "seeds_needed",
    "sign_permutation",
    "spc",
    "spearman",
    "summary",
    "welch",
    "welch_from_summaries",
    "welch_over_tasks",
    "wilson",
]

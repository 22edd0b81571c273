"""What the arguments of GCRPPO's constructor must be."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from sb3_gcr.checks import check_flag, check_number

#: Numbers and their ranges, see :func:`~sb3_gcr.checks.check_number`.
NUMBERS: dict[str, dict[str, Any]] = {
    "learning_rate": {"low": 0, "schedule": True},
    "n_steps": {"low": 1, "integer": True},
    "batch_size": {"low": 1, "integer": True},
    "n_epochs": {"low": 1, "integer": True},
    "gamma": {"low": 0, "high": 1},
    "gae_lambda": {"low": 0, "high": 1},
    "clip_range": {"low": 0, "above": True, "schedule": True},
    "clip_range_vf": {"low": 0, "above": True, "schedule": True, "optional": True},
    "ent_coef": {},
    "vf_coef": {"low": 0},
    "max_grad_norm": {"low": 0, "above": True},
    "sde_sample_freq": {"low": -1, "integer": True},
    "target_kl": {"low": 0, "above": True, "optional": True},
    "stats_window_size": {"low": 1, "integer": True},
    "seed": {"low": 0, "integer": True, "optional": True},
    "kappa_max": {"low": 0, "above": True},
    "desired_kl": {"low": 0, "above": True, "optional": True},
    "gramian_samples": {"low": 1, "integer": True, "optional": True},
    "gramian_average": {"low": 1, "integer": True, "optional": True},
}
FLAGS = ("normalize_advantage", "use_sde")


def check_arguments(given: Mapping[str, Any], optional: Collection[str] = ()) -> None:
    """Refuse numbers and switches that are none, or out of range.

    :param given: by name; what is missing is not checked, other names are ignored
    :param optional: names of which None is right, too
    :raises TypeError: for text and other things that are no number, or no switch
    :raises ValueError: for a number out of its range
    """
    given = {
        name: value for name, value in given.items() if value is not None or name not in optional
    }
    for name in NUMBERS.keys() & given.keys():
        check_number(name, given[name], **NUMBERS[name])
    for name in FLAGS:
        if name in given:
            check_flag(name, given[name])
    if given.get("normalize_advantage", False) and "batch_size" in given:
        # One sample has no standard deviation.
        check_number("batch_size", given["batch_size"], 2, integer=True)

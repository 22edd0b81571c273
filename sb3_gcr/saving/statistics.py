"""VecNormalize's running statistics as plain JSON, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

#: VecNormalize begins to count at less than this.
ONE_OBSERVATION = 1


def _of_observations(vec_normalize: VecNormalize) -> dict[str, RunningMeanStd]:
    """VecNormalize's statistics of observations by key, "" where they have none."""
    found = getattr(vec_normalize, "obs_rms", None) or {}
    return found if isinstance(found, dict) else {"": found}


def count_seen(vec_normalize: VecNormalize) -> float:
    """How many observations or returns VecNormalize has seen.

    :param vec_normalize: the wrapper of an env
    """
    moments = (*_of_observations(vec_normalize).values(), vec_normalize.ret_rms)
    return max(float(one.count) for one in moments)


def describe_statistics(vec_normalize: VecNormalize) -> dict[str, Any]:
    """VecNormalize's running means and variances as JSON.

    :param vec_normalize: the wrapper of a model's env
    """
    observations = {
        key: _describe_moments(moments) for key, moments in _of_observations(vec_normalize).items()
    }
    return {"observations": observations, "returns": _describe_moments(vec_normalize.ret_rms)}


def _describe_moments(moments: RunningMeanStd) -> dict[str, Any]:
    return {
        "mean": np.asarray(moments.mean).tolist(),
        "var": np.asarray(moments.var).tolist(),
        "count": float(moments.count),
    }


def find_mismatch(
    vec_normalize: VecNormalize | None, saved: Mapping[str, Any] | None
) -> str | None:
    """What a model would see otherwise than it has learned to, as a sentence; None if nothing.

    :param vec_normalize: the wrapper of a model's env, None where it has none
    :param saved: of ``describe_statistics``, None where the saved model's env had no VecNormalize
    """
    before = saved is not None and bool(saved["observations"])
    now = (
        vec_normalize is not None
        and vec_normalize.norm_obs
        and bool(_of_observations(vec_normalize))
    )
    if saved is not None and vec_normalize is None:
        what = "observations" if before else "rewards"
        return (
            "The model has learned under VecNormalize, whose statistics are in its file, and the "
            f"env has none: its {what} are in other units. Wrap it with `VecNormalize(env)`; to "
            "evaluate, with `VecNormalize(env, training=False, norm_reward=False)`."
        )
    if before and not now:
        return (
            "The model has learned from observations that VecNormalize has normalised, and that of "
            "the env leaves them as they are. Set its `norm_obs=True`."
        )
    if now and not before:
        return (
            "The model has learned from observations as they are, and the env's VecNormalize "
            "normalises them. Set its `norm_obs=False`."
        )
    return None


def restore_statistics(
    vec_normalize: VecNormalize | None, saved: Mapping[str, Any] | None, returns: bool = True
) -> str:
    """Give saved statistics to a VecNormalize that has not seen anything yet; one that has keeps
    its own.

    :param vec_normalize: the wrapper of a model's env, None where it has none
    :param saved: of ``describe_statistics``, None where there are none
    :param returns: whether to restore those of the returns, too
    :return: what was done, for the log
    :raises ValueError: if the saved statistics are of other observations
    """
    if saved is None:
        return "VecNormalize: no statistics in the file"
    if vec_normalize is None:
        return "VecNormalize: none, though the file has statistics"
    if count_seen(vec_normalize) >= ONE_OBSERVATION:
        return "VecNormalize keeps its own statistics"
    observations = _of_observations(vec_normalize)
    if observations and saved["observations"] and set(observations) != set(saved["observations"]):
        raise ValueError(
            "VecNormalize must normalise the observations that it did for the saved model, "
            f"{sorted(saved['observations'])}, "
            f"found {sorted(observations)}."
        )
    for key in set(observations) & set(saved["observations"]):
        _restore_moments(observations[key], saved["observations"][key])
    if returns:
        _restore_moments(vec_normalize.ret_rms, saved["returns"])
        return "VecNormalize's statistics of observations and returns kept"
    return "VecNormalize's statistics of observations kept"


def _restore_moments(moments: RunningMeanStd, saved: Mapping[str, Any]) -> None:
    mean, var = (np.array(saved[name], dtype=np.float64) for name in ("mean", "var"))
    if mean.shape != np.shape(moments.mean) or var.shape != mean.shape:
        raise ValueError(
            f"The saved statistics must have shape {np.shape(moments.mean)}, found {mean.shape} "
            f"and {var.shape}."
        )
    # 0-d arrays where VecNormalize has them, because SB3 pickles and compares them as they are.
    moments.mean, moments.var, moments.count = mean, var, float(saved["count"])

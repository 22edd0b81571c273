"""Why a policy could give no actions: in words of our own, naming the env or the parameter."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

Observations = NDArray[Any] | dict[str, NDArray[Any]]


@contextmanager
def in_plain_words(explain: Callable[[], str]) -> Iterator[None]:
    """Replace PyTorch's own words for a distribution that cannot be by an explanation.

    :param explain: says what is wrong
    :raises ValueError: with the explanation, from PyTorch's error
    """
    try:
        yield
    except (ValueError, RuntimeError) as error:
        if not _is_about_a_distribution(error):
            raise
        raise ValueError(explain()) from error


def _is_about_a_distribution(error: Exception) -> bool:
    """Whether an error was raised inside PyTorch's distributions."""
    trace = error.__traceback__
    name = ""
    while trace is not None:
        name = trace.tb_frame.f_globals.get("__name__", "")
        trace = trace.tb_next
    return name.startswith("torch.distributions")


def why_no_actions(policy: nn.Module, observations: Observations | None, timestep: int) -> str:
    """What makes the distribution of actions impossible.

    :param policy: SB3's
    :param observations: what it was shown, one row per env; None if that is known to be finite
    :param timestep: for the message
    """
    causes = (
        _find_parameter(policy, timestep),
        _find_observation(observations, timestep),
        _find_deviation(policy, timestep),
    )
    unknown = (
        f"The policy must give numbers that make a distribution of actions, found none at timestep "
        f"{timestep}: observations and weights are finite, but too large together. Scaled "
        "observations (VecNormalize), or a smaller `learning_rate`, may help."
    )
    return next((cause for cause in causes if cause is not None), unknown)


def _find_parameter(policy: nn.Module, timestep: int) -> str | None:
    for name, parameter in policy.named_parameters():
        bad = parameter[~th.isfinite(parameter)]
        if len(bad):
            return (
                f"The policy's parameter `{name}` must be finite, found {bad[0].item()} at "
                f"timestep {timestep}. A smaller `learning_rate`, or scaled returns "
                "(VecNormalize), may help; go on from an earlier checkpoint."
            )
    return None


def _find_observation(observations: Observations | None, timestep: int) -> str | None:
    if observations is None:
        return None
    parts = observations if isinstance(observations, dict) else {"": observations}
    for key, part in parts.items():
        bad = np.argwhere(~np.isfinite(part))
        if len(bad):
            index, *place = bad[0].tolist()
            entry = "".join([f"[{key!r}]" if key else "", str(place) if place else ""])
            return (
                f"Env index {index} at timestep {timestep}: the observation must be finite, found "
                f"{part[tuple(bad[0])]} in observation{entry}. The policy is as it was; "
                "VecCheckNan finds where it comes from."
            )
    return None


def _find_deviation(policy: nn.Module, timestep: int) -> str | None:
    log_std = getattr(policy, "log_std", None)
    if log_std is None or getattr(policy, "use_sde", False):
        return None
    deviations = log_std.detach().exp()
    bad = th.nonzero(~th.isfinite(deviations) | (deviations == 0))
    if not len(bad):
        return None
    place = tuple(bad[0].tolist())
    return (
        "The policy's standard deviation exp(log_std) must be finite and above 0, found "
        f"exp({log_std[place].item():g}) = {deviations[place].item():g} for action index "
        f"{place[-1] if place else 0} at timestep {timestep}. Set `log_std_init` in "
        "`policy_kwargs`; a larger `ent_coef` keeps it from shrinking in training."
    )

"""A look at a reward before anything is trained: 200 random steps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from sb3_gcr.logs.shown import format_table
from sb3_gcr.rewards.spec import COMPONENTS_KEY, ERROR_KEY, RewardSpec, level_label
from sb3_gcr.rewards.sums import SUM_TOLERANCE, find_fault
from sb3_gcr.study.environments import make_one, no_components_message

STEPS = 200


class Term(NamedTuple):
    """A term of the reward in random steps.

    :param mean: a step
    :param size: mean of its absolute value
    :param nonzero: share of steps in which it is not 0
    """

    name: str
    level: int
    mean: float
    size: float
    nonzero: float


def probe(cell: Mapping[str, Any]) -> list[Term]:
    """The terms of an env's reward.

    :param cell: canonical
    :raises ValueError: if there are none, one is missing or not finite, or they do not sum to the
        reward
    """
    try:
        return _probe(cell)
    except ValueError as error:
        help_here = " Here: `--residual rest`." if "residual=" in str(error) else ""
        raise ValueError(f"{error}{help_here}") from error


def _probe(cell: Mapping[str, Any]) -> list[Term]:
    env = make_one(cell)
    given = env.get_wrapper_attr("reward_spec")
    spec = given if isinstance(given, RewardSpec) else RewardSpec.from_dict(given)
    tolerance = SUM_TOLERANCE
    if env.has_wrapper_attr("reward_tolerance"):
        tolerance = max(tolerance, env.get_wrapper_attr("reward_tolerance"))
    env.action_space.seed(0)
    env.reset(seed=0)
    rows, rewards = [], []
    for _ in range(STEPS):
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        if COMPONENTS_KEY not in info:
            raise ValueError(info.get(ERROR_KEY) or no_components_message(info))
        rows.append(np.asarray(info[COMPONENTS_KEY], dtype=float))
        rewards.append(float(reward))
        if terminated or truncated:
            env.reset()
    env.close()
    components = np.array(rows)
    fault = find_fault(components, np.array(rewards), spec, tolerance)
    if fault is not None:
        raise ValueError(f"Step {fault[0] + 1}: {fault[1]}")
    columns = zip(spec, components.T, strict=True)
    return [_term(name, level, column) for (name, level), column in columns]


def _term(name: str, level: int, values: Any) -> Term:
    return Term(
        name,
        level,
        mean=float(values.mean()),
        size=float(np.abs(values).mean()),
        nonzero=float((values != 0).mean()),
    )


def shown(terms: list[Term]) -> str:
    """A table for the terminal.

    :param terms: of :func:`probe`
    """
    rows = [["term", "level", "mean", "mean size", "not 0"]]
    rows += [
        [
            term.name,
            level_label(term.level),
            f"{term.mean:.3g}",
            f"{term.size:.3g}",
            f"{term.nonzero:.0%}",
        ]
        for term in terms
    ]
    text = f"{STEPS} random steps; the terms sum to the reward:\n{format_table(rows)}"
    never = [term.name for term in terms if term.nonzero == 0]
    if never:
        text += f"\nNever paid by random actions: {', '.join(never)}."
    if len({term.level for term in terms}) == 1:
        text += "\nAll terms have one level, so that there is no priority between them."
    return text

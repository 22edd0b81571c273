"""Which numbers that an env reports are the terms of its reward, and with which weights."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from sb3_gcr.checks import check_number
from sb3_gcr.rewards.decomposition import GYMNASIUM_ENVS
from sb3_gcr.rewards.fitting import EXACT, Fit, fit_sum, independent_columns, round_weight
from sb3_gcr.rewards.found import Answer, FoundComponents, ToldWeights
from sb3_gcr.rewards.samples import Group, Samples, sample
from sb3_gcr.rewards.spec import RewardSpec
from sb3_gcr.rewards.sums import SUM_TOLERANCE, all_add_up
from sb3_gcr.rewards.values import leaves

Array = NDArray[np.float64]


def find_components(
    env: gym.Env[Any, Any] | str, n_steps: int = 200, seed: int | None = 0
) -> FoundComponents:
    """Act at random, and look for the terms of the reward in the infos and attributes of an env.

    Numbers are terms if they add up to the reward exactly, as they are, with weights that an
    attribute of the env tells, with fitted weights, or as increases of running totals. Names that
    sound like terms are tried first. What does not add up is not proposed.

    :param env: an env, or the id of one; it is reset and stepped, so not a robot that must not
        move at random
    :param n_steps: number of steps; more show terms that pay rarely
    :param seed: of the env and the actions
    :return: prints as a table and the line to write
    :raises TypeError: for a VecEnv
    """
    if isinstance(env, VecEnv):
        raise TypeError(
            f"Parameter `env` must be an env of Gymnasium, found a {type(env).__name__}: give one "
            "of those that it is made of."
        )
    check_number("n_steps", n_steps, 10, integer=True)
    env = gym.make(env) if isinstance(env, str) else env
    samples = sample(env, n_steps, seed)
    env_id = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
    answer = _answer(env, env_id, samples)
    return FoundComponents(env_id, samples, answer)


def _answer(env: gym.Env[Any, Any], env_id: str, samples: Samples) -> Answer:
    """The first explanation that adds up."""
    spec = _own_spec(env)
    if spec is not None:
        return Answer("reported", levels=spec.to_dict())
    if samples.rewards.ndim == 2:
        return Answer("vector")
    known = _known(env_id, samples)
    if known is not None:
        return known
    copies: list[str] = []
    for group, names in _candidates(samples):
        answer = _by_told_weights(group, samples) or _explain(group, names, samples)
        if answer is not None and not _is_copy(answer):
            return answer
        copies += answer.weights if answer is not None else []
    for group, names in _candidates(samples):
        grown = _increases(group, samples.starts)
        answer = _explain(grown, names, samples)
        if answer is not None and not _is_copy(answer):
            return answer._replace(group=group, cumulative=True)
    return Answer("nothing", explained=_best_share(samples), copies=tuple(dict.fromkeys(copies)))


def _is_copy(answer: Answer) -> bool:
    """Whether it is one number that is the reward, which takes nothing apart."""
    return len(answer.weights) == 1 and not answer.constant


def _own_spec(env: gym.Env[Any, Any]) -> RewardSpec | None:
    try:
        spec = env.get_wrapper_attr("reward_spec")
    except AttributeError:
        return None
    return spec if isinstance(spec, RewardSpec) else None


def _known(env_id: str, samples: Samples) -> Answer | None:
    """The table's terms, if they add up here."""
    entry = GYMNASIUM_ENVS.get(env_id)
    group = next((group for group in samples.groups if not group.path), None)
    if entry is None or group is None:
        return None
    levels = dict(leaves(entry["components"]))
    if not set(levels) <= set(group.names):
        return None
    terms = group.take(list(levels))
    residual = entry.get("residual")
    if residual is None and not all_add_up(terms, samples.rewards):
        return None
    weights = dict.fromkeys(levels, 1.0)
    return Answer("known", group, weights, levels=levels, residual=residual)


def _candidates(samples: Samples) -> Iterator[tuple[Group, list[str]]]:
    """Places and names to look at: first what sounds like terms, then everything in one place."""
    ordered = sorted(samples.groups, key=lambda group: not group.reward_like)
    for group in ordered:
        if group.reward_like:
            yield group, group.reward_like
    for group in ordered:
        yield group, list(group.names)


def _increases(group: Group, starts: NDArray[np.bool_]) -> Group:
    """By how much each number has grown since the step before, or since 0 in a first step."""
    before = np.vstack([np.zeros_like(group.values[:1]), group.values[:-1]])
    before[starts] = 0.0
    return Group(group.kind, group.path, group.names, group.values - before)


def _by_told_weights(group: Group, samples: Samples) -> Answer | None:
    """Weights that the env tells, up to one factor and a constant."""
    for attribute, told in samples.told.items():
        names = [name for name in group.names if name in told]
        if len(names) < 2 or attribute == group.path:
            continue
        weights = np.array([told[name] for name in names])
        parts = group.take(names) * weights
        if np.ptp(parts.sum(1)) == 0:
            continue
        fit = fit_sum(parts.sum(1, keepdims=True), samples.rewards)
        factor, constant = round_weight(float(fit.weights[0])), _constant(fit, samples)
        rows = np.column_stack([parts * factor, np.full(len(parts), constant)])
        if fit.is_exact and all_add_up(rows, samples.rewards, EXACT):
            return Answer(
                "told",
                group,
                dict(zip(names, (weights * factor).tolist(), strict=True)),
                constant=constant,
                told=ToldWeights(attribute, tuple(names), factor),
                tolerance=_tolerance(rows, samples.rewards),
            )
    return None


def _explain(group: Group, names: list[str], samples: Samples) -> Answer | None:
    """The weights with which some numbers of a place add up to the reward; None if they do not."""
    rewards = samples.rewards
    if not names or np.ptp(group.take(names), axis=0).max(initial=0.0) == 0:
        return None
    if group.kind == "vector":
        return _explain_vector(group, samples)
    kept = _without_sums(group, names, rewards)
    for chosen in (names, kept):
        adds_up = chosen and all_add_up(group.take(chosen), rewards)
        if adds_up and not _has_copies(group, chosen):
            return Answer("sum", group, dict.fromkeys(chosen, 1.0))
    if len(rewards) < 2 * len(kept) + 10:
        return None
    likely = sorted(kept, key=lambda name: name not in group.reward_like)
    varying = [likely[index] for index in independent_columns(group.take(likely))]
    if not varying:
        return None
    fit = fit_sum(group.take(varying), rewards)
    if not fit.is_exact:
        return None
    weights = _needed(group, varying, fit, rewards)
    if not weights:
        return None
    weights = _prefer(group, kept, weights)
    constant = _constant(fit, samples)
    constant_term = _constant_term(group, kept, constant)
    if constant_term is not None:
        weights[constant_term], constant = 1.0, 0.0
    unseen = [name for name in kept if not group.take([name]).any()]
    if len(set(weights.values())) == 1:  # then the weight of what never paid is likely the same
        weights |= dict.fromkeys(unseen, next(iter(weights.values())))
    weights = {name: weights[name] for name in names if name in weights}
    rows = group.take(list(weights)) * list(weights.values())
    rows = np.column_stack([rows, np.full(len(rows), constant)])
    tolerance = _tolerance(rows, rewards)
    return Answer("fitted", group, weights, constant=constant, tolerance=tolerance)


def _explain_vector(group: Group, samples: Samples) -> Answer | None:
    """A vector in the info, as it is, with the weights beside it, or with fitted ones."""
    beside = [other for other in samples.groups if other.path == "reward_weights"]
    if beside and beside[0].values.shape == group.values.shape:
        weighted = group.values * beside[0].values
        if all_add_up(weighted, samples.rewards):
            return Answer("sum", group, dict.fromkeys(group.names, 1.0))
    if all_add_up(group.values, samples.rewards):
        one = {"weights": 1.0} if beside else {}
        return Answer("sum", group, dict.fromkeys(group.names, 1.0), options=one)
    columns = independent_columns(group.values)
    if not columns or len(samples.rewards) < 2 * len(group.names) + 10:
        return None
    names = [group.names[index] for index in columns]
    fit = fit_sum(group.take(names), samples.rewards)
    needed = _needed(group, names, fit, samples.rewards)
    # Where entries are left over it is an observation that happens to hold the terms.
    if not fit.is_exact or fit.constant or len(needed) < len(group.names):
        return None
    rows = group.take(list(needed)) * list(needed.values())
    tolerance = _tolerance(rows, samples.rewards)
    return Answer("fitted", group, needed, tolerance=tolerance)


def _without_sums(group: Group, names: list[str], rewards: Array) -> list[str]:
    """The names without copies of the reward, copies of others, and sums of others."""
    kept = names if len(names) == 1 else _without_copies(group, names, rewards)
    columns = {name: group.take([name])[:, 0] for name in kept}
    totals = set()
    for name in kept:
        others = [other for other in kept if other != name and columns[other].any()]
        if len(others) >= 2 and columns[name].any() and _is_sum(group, name, others):
            totals.add(name)
    return [name for name in kept if name not in totals]


def _without_copies(group: Group, names: list[str], rewards: Array) -> list[str]:
    """The names without those of the reward itself, or of it times a factor."""
    return [name for name in names if not _is_proportional(group.take([name])[:, 0], rewards)]


def _has_copies(group: Group, names: list[str]) -> bool:
    """Whether two numbers differ by a factor only, so that one may be no term."""
    columns = [group.take([name])[:, 0] for name in names]
    return any(
        _is_proportional(column, other)
        for index, column in enumerate(columns)
        for other in columns[:index]
    )


def _is_sum(group: Group, name: str, others: list[str]) -> bool:
    """Whether a column is the plain sum of at least two others."""
    varying = [others[index] for index in independent_columns(group.take(others))]
    if len(group.values) < 2 * len(varying) + 10 or not varying:
        return False
    fit = fit_sum(group.take(varying), group.take([name])[:, 0])
    parts = [weight for weight in fit.weights.tolist() if abs(weight) > 1e-6]
    return fit.is_exact and len(parts) >= 2 and all(abs(part - 1) < 1e-6 for part in parts)


def _is_proportional(column: Array, other: Array) -> bool:
    """Whether two columns that vary differ by a factor only."""
    if not np.ptp(column) or not np.ptp(other):
        return False
    fit = fit_sum(column[:, None], other)
    return fit.is_exact and abs(fit.constant) <= EXACT * float(np.abs(other).max())


def _needed(group: Group, names: list[str], fit: Fit, rewards: Array) -> dict[str, float]:
    """The fitted weights of the columns that add something."""
    size = float(np.abs(rewards).max())
    weights = {}
    for name, weight in zip(names, fit.weights.tolist(), strict=True):
        part = float(np.abs(group.take([name])).max()) * abs(weight)
        if part > EXACT * size:
            weights[name] = round_weight(weight)
    return weights


def _prefer(group: Group, names: list[str], weights: dict[str, float]) -> dict[str, float]:
    """Of columns that differ by a factor, the one that needs no weight, or else the first."""
    preferred = {}
    for name, weight in weights.items():
        column = group.take([name])[:, 0]
        best, best_weight = name, weight
        for other in names:
            other_column = group.take([other])[:, 0]
            if other in weights or not _is_proportional(column, other_column):
                continue
            peak = int(np.abs(column).argmax())
            other_weight = round_weight(weight * float(column[peak] / other_column[peak]))
            if other_weight == 1 and best_weight != 1:
                best, best_weight = other, other_weight
        preferred[best] = best_weight
    return preferred


def _constant(fit: Fit, samples: Samples) -> float:
    """The fitted constant, 0 where it is rounding."""
    small = EXACT * float(np.abs(samples.rewards).max())
    return 0.0 if abs(fit.constant) <= small else round_weight(fit.constant)


def _constant_term(group: Group, names: list[str], constant: float) -> str | None:
    """The first column that always pays the constant."""
    if not constant:
        return None
    for name in names:
        column = group.take([name])[:, 0]
        if not np.ptp(column) and abs(column[0] - constant) <= EXACT * abs(constant):
            return name
    return None


def _tolerance(rows: Array, rewards: Array) -> float | None:
    """What the sum check must be told, None where rounding is enough."""
    if all_add_up(rows, rewards, SUM_TOLERANCE):
        return None
    return next((x for x in (1e-7, 1e-6) if all_add_up(rows, rewards, x)), 2 * EXACT)


def _best_share(samples: Samples) -> float:
    """The largest share of the reward's variation that the numbers of one place explain."""
    best = 0.0
    total = float(samples.rewards.var())
    for group, candidates in _candidates(samples):
        names = _without_copies(group, candidates, samples.rewards)
        varying = [names[index] for index in independent_columns(group.take(names))]
        if not total or not varying or len(samples.rewards) < 2 * len(varying) + 10:
            continue
        fit = fit_sum(group.take(varying), samples.rewards)
        left = samples.rewards - group.take(varying) @ fit.weights
        best = max(best, 1 - float(left.var()) / total)
    return best

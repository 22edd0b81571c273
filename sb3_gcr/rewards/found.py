"""What was found about the terms of a reward, as a table and as the line to write."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from sb3_gcr.rewards.decomposition import RewardDecomposition
from sb3_gcr.rewards.samples import Group, Samples
from sb3_gcr.rewards.spec import Level, level_label

#: What names of costs contain, names of what costs if it is never positive, and names of tasks,
#: which may be negative: a distance.
_COSTS = re.compile(r"cost|penal|_reg$", re.IGNORECASE)
_REGULARISERS = re.compile(
    r"ctrl|control|effort|energy|torque|power|smooth|action|jerk|acc|contact|impact|collision|limit",
    re.IGNORECASE,
)
_TASKS = re.compile(r"dist|near|track|reach|goal|target|pose|alive|surviv|success", re.IGNORECASE)
#: Name of the component for what is always paid.
CONSTANT = "offset"


class ToldWeights:
    """Weights that the env tells in an attribute, for ``RewardDecomposition(weights=...)``.

    :param attribute: of the unwrapped env, a dictionary of numbers by name
    :param names: the names that count
    :param factor: what all of them are multiplied by
    """

    def __init__(self, attribute: str, names: tuple[str, ...], factor: float):
        self.attribute, self.names, self.factor = attribute, names, factor

    def __call__(self, env: gym.Env[Any, Any]) -> dict[str, float]:
        """The weights now, by name.

        :param env: the env
        """
        told = getattr(env.unwrapped, self.attribute)
        return {name: self.factor * told[name] for name in self.names}

    def __repr__(self) -> str:
        told = f"env.unwrapped.{self.attribute}"
        if self.factor == 1:
            return f"lambda env: {told}"
        return (
            f"lambda env: {{name: {self.factor:.12g} * {told}[name] for name in "
            f"{list(self.names)}}}"
        )


class KeptTerms:
    """Terms that the env keeps in an attribute, for ``RewardDecomposition(terms=...)``.

    :param attribute: of the unwrapped env, a dictionary of numbers by name
    """

    def __init__(self, attribute: str):
        self.attribute = attribute

    def __call__(self, env: gym.Env[Any, Any], info: dict[str, Any]) -> Any:
        """The terms of the last step, by name.

        :param env: the env
        :param info: not used
        """
        return getattr(env.unwrapped, self.attribute)

    def __repr__(self) -> str:
        return f"lambda env, info: env.unwrapped.{self.attribute}"


class Answer(NamedTuple):
    """How the reward is made of the numbers of a place.

    :param kind: "known", "told", "sum", "fitted", "reported", "vector" or "nothing"
    :param group: where the terms are
    :param weights: by name
    :param constant: what is always paid beside them
    :param levels: by name, where they are known
    :param residual: name of the component for the rest, where it is known
    :param told: weights that the env tells
    :param cumulative: whether the terms are running totals
    :param tolerance: what the sum check must be told
    :param options: more of ``RewardDecomposition``'s
    :param copies: names of numbers that are the reward itself
    :param explained: the best share of the reward's variation, where nothing adds up
    """

    kind: str
    group: Group | None = None
    weights: dict[str, float] = {}  # noqa: RUF012 never changed
    constant: float = 0.0
    levels: dict[str, Any] = {}  # noqa: RUF012 never changed
    residual: str | None = None
    told: ToldWeights | None = None
    cumulative: bool = False
    tolerance: float | None = None
    options: dict[str, Any] = {}  # noqa: RUF012 never changed
    copies: tuple[str, ...] = ()
    explained: float = 0.0


class FoundComponents:
    """The terms of an env's reward; prints as a table and the line to write.

    :param env_id: id or class of the env
    :param samples: what was seen
    :param answer: what adds up to the reward
    """

    def __init__(self, env_id: str, samples: Samples, answer: Answer):
        self.env_id, self.samples, self.answer = env_id, samples, answer

    @property
    def is_complete(self) -> bool:
        """Whether the terms add up to the reward."""
        return self.answer.group is not None or self.answer.kind == "reported"

    @property
    def levels(self) -> dict[str, Level]:
        """Levels by name, known or guessed from name and sign; without the residual."""
        if self.answer.levels:
            return dict(self.answer.levels)
        group = self.answer.group
        if group is None:
            return {}
        return {
            name: _guess(name, weight * group.take([name]).max(), weight * group.take([name]).min())
            for name, weight in self.answer.weights.items()
        }

    @property
    def weights(self) -> dict[str, float]:
        """What each term is multiplied by in the reward, by name."""
        return dict(self.answer.weights)

    @property
    def unseen(self) -> list[str]:
        """Terms that never paid."""
        group = self.answer.group
        return [] if group is None else [n for n in self.weights if not group.take([n]).any()]

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments of :class:`RewardDecomposition`; empty where nothing adds up, and where
        nothing needs to be wrapped.
        """
        answer, group = self.answer, self.answer.group
        if group is None or answer.kind == "known":
            return {}
        found: dict[str, Any] = {"components": self.levels}
        if group.kind == "vector":
            found["components"] = {group.path: self.levels}
        elif group.kind == "attribute":
            found["terms"] = KeptTerms(group.path)
        elif group.path:
            found["under"] = group.path
        if answer.told is not None:
            found["weights"] = answer.told
        elif set(answer.weights.values()) != {1.0}:
            values = set(answer.weights.values())
            by_name = {name: _short(weight) for name, weight in answer.weights.items()}
            found["weights"] = _short(values.pop()) if len(values) == 1 else by_name
        if answer.constant:
            found["residual"] = {CONSTANT: "regulariser"}
        if answer.cumulative:
            found["cumulative"] = True
        if answer.tolerance is not None:
            found["tolerance"] = answer.tolerance
        return {**found, **answer.options}

    def wrap(self, env: gym.Env[Any, Any]) -> RewardDecomposition:
        """The env with its components.

        :param env: such an env
        :raises ValueError: where nothing adds up
        """
        if self.answer.group is None:
            raise ValueError(f"Nothing was found to wrap '{self.env_id}' with.\n{self.sentence}")
        return RewardDecomposition(env, **self.arguments)

    @property
    def line(self) -> str:
        """The line to write; "" where there is none."""
        if self.answer.kind == "known":
            return "env = RewardDecomposition(env)"
        if not self.arguments:
            return ""
        arguments = dict(self.arguments)
        parts = [repr(arguments.pop("components"))]
        parts += [f"{name}={value!r}" for name, value in arguments.items()]
        inside = ", ".join(parts).replace("'", '"')
        return f"env = RewardDecomposition(env, {inside})  # levels are guesses"

    @property
    def sentence(self) -> str:
        """What was found, in words."""
        answer = self.answer
        n_steps = len(self.samples.rewards)
        if answer.kind == "reported":
            return (
                "The env reports its components itself: "
                f"{', '.join(f'{n} ({level_label(k)})' for n, k in answer.levels.items())}. "
                "Nothing needs to be wrapped."
            )
        if answer.kind == "vector":
            length = self.samples.rewards.shape[1]
            return (
                f"The reward is a vector of {length} entries: `RewardDecomposition(env, "
                '{"first": "task", ...})` names them in order.'
            )
        if answer.kind == "nothing":
            copies = ", ".join(answer.copies)
            but = f", but for copies of it: {copies}" if copies else ""
            share = min(answer.explained, 0.999)
            return (
                f"No numbers in info add up to the reward in {n_steps} random steps{but}; the best "
                f"explain {share:.1%} of its variation. The terms may be missing, "
                "changed by a condition, a product or a clip, or be local variables: return them "
                "with `terms=`, or record the methods that compute them with `calls=`."
            )
        how = {
            "known": "They are Gymnasium's, and add up to the reward",
            "sum": "They add up to the reward",
            "told": f"With the weights of `env.unwrapped.{_attribute(answer)}` they add up to it",
            "fitted": "With these weights they add up to the reward",
        }[answer.kind]
        notes = [f"{how} in {n_steps} random steps{' as increases' if answer.cumulative else ''}."]
        if answer.constant:
            notes.append(
                f"{answer.constant:g} is paid always; which term that is cannot be told apart, and "
                f"'{CONSTANT}' takes it."
            )
        if self.unseen:
            notes.append(f"Not seen, because always 0: {', '.join(self.unseen)}.")
        notes += self._constants()
        if self.samples.absent:
            notes.append(f"Not there in every step: {', '.join(self.samples.absent)}.")
        return " ".join(notes)

    def _constants(self) -> list[str]:
        group = self.answer.group
        assert group is not None
        constants = [
            name
            for name in group.reward_like
            if not np.ptp(group.take([name])) and group.take([name]).any()
        ]
        others = [name for name in constants if name not in self.weights]
        unseen = [
            n for n in group.reward_like if not group.take([n]).any() and n not in self.weights
        ]
        notes = []
        if constants and (others or self.answer.constant):
            notes.append(f"Constants cannot be told apart: {', '.join(constants)}.")
        if unseen:
            notes.append(f"Always 0, so that their weights cannot be told: {', '.join(unseen)}.")
        return notes

    @property
    def table(self) -> str:
        """Each number of the place, what it paid, and its weight in the reward."""
        groups = [self.answer.group] if self.answer.group is not None else self.samples.groups
        heads = ("smallest", "mean", "largest")
        lines = [f"{'number':<32}{''.join(f'{head:>11}' for head in heads)}  not 0  weight"]
        for group in groups:
            for name in group.names:
                if group.kind == "vector" or self.answer.group is None:
                    shown = "/".join(part for part in (group.path, name) if part)
                else:
                    shown = name
                column = group.take([name])
                weight = self.weights.get(name)
                lines.append(
                    f"{shown[:32]:<32} {column.min():>10.4g} {column.mean():>10.4g} "
                    f"{column.max():>10.4g} {np.mean(column != 0):>6.0%}  "
                    f"{'' if weight is None else f'{weight:.6g}':<8}".rstrip()
                )
        return "\n".join(lines)

    def __str__(self) -> str:
        table = "" if self.answer.kind == "reported" else self.table
        parts = [self.env_id, table, self.sentence, self.line]
        return "\n\n".join(part for part in parts if part)

    __repr__ = __str__


def _short(weight: float) -> float:
    """An integer where it is one, to be written so."""
    return int(weight) if weight == int(weight) else weight


def _attribute(answer: Answer) -> str:
    return "" if answer.told is None else answer.told.attribute


def _guess(name: str, largest: float, smallest: float) -> Level:
    """The level that a term of that name and sign often has."""
    pays_never = largest <= 0 and smallest < 0
    if _COSTS.search(name) or (_REGULARISERS.search(name) and largest <= 0):
        return "regulariser"
    return "task" if _TASKS.search(name) or not pays_never else "regulariser"

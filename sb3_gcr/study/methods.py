"""The methods that a study compares; between two of them nothing differs but what is said here."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sb3_gcr.rewards.spec import SCALAR_REWARD, RewardSpec

#: Where the levels of the components come from.
LEVELS = ("env", "sorted_names", "inverted")


@dataclass(frozen=True)
class Method:
    """What distinguishes a method from the others of a study.

    :param resolver: name in ``RESOLVERS``
    :param summed: train on the summed reward, K = 1; the terms are recorded all the same
    :param levels: "env": as the env says. "sorted_names": component i gets the level of the i-th
        name in alphabetical order, as the authors' released code does. "inverted": the highest
        priority becomes the lowest
    :param overrides: settings that differ from those of the study
    """

    resolver: str
    summed: bool = False
    levels: str = "env"
    overrides: Mapping[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """All fields by name, for a cell."""
        return {**dataclasses.asdict(self), "resolver_kwargs": {}}


_COMPONENT = {"surrogate_clipping": "component"}
#: Methods by name. `ppo` is GCRPPO with K = 1: without `desired_kl` and with advantages normalised
#: over the minibatch it is SB3's PPO bit for bit.
METHODS: dict[str, Method] = {
    "ppo": Method("sum", summed=True),
    "multi_head": Method("sum"),
    "levels": Method("levels"),
    "no_priority": Method("no_priority"),
    "gcr": Method("gcr"),
    "guaranteed": Method("guaranteed"),
    "gcr_authors": Method("gcr_authors"),
    "gcr_authors_mask": Method("gcr", levels="sorted_names"),
    "gcr_inverted": Method("gcr", levels="inverted"),
    "multi_head_component": Method("sum", overrides=_COMPONENT),
    "gcr_component": Method("gcr", overrides=_COMPONENT),
}
#: Other names that people use.
ALIASES = {"gcrppo": "gcr"}
#: What needs the heads alone beside it, so that heads and surgery can be told apart.
WITHOUT_SURGERY = ("ppo", "multi_head", "multi_head_component")


def named(names: Sequence[str]) -> list[str]:
    """The methods behind names, without repetitions.

    :param names: of methods
    :raises ValueError: for an unknown name
    """
    found = list(dict.fromkeys(ALIASES.get(name, name) for name in names))
    unknown = [name for name in found if name not in METHODS]
    if unknown:
        raise ValueError(f"Unknown methods {unknown}; valid choices are {[*METHODS, *ALIASES]}.")
    return found


def with_heads(names: Sequence[str]) -> list[str]:
    """The same methods, and the heads alone where surgery is compared with PPO.

    :param names: of methods
    """
    has_surgery = any(name not in WITHOUT_SURGERY for name in names)
    if "ppo" not in names or not has_surgery or "multi_head" in names:
        return list(names)
    place = names.index("ppo") + 1
    return [*names[:place], "multi_head", *names[place:]]


def trained_spec(method: Mapping[str, Any], spec: RewardSpec) -> RewardSpec:
    """The components that the update works with.

    :param method: fields of a Method
    :param spec: what the env says
    """
    if method["summed"]:
        return SCALAR_REWARD
    if method["levels"] == "sorted_names":
        by_name = spec.to_dict()
        return RewardSpec(spec.names, tuple(by_name[name] for name in sorted(spec.names)))
    if method["levels"] == "inverted":
        lowest = max(spec.levels)
        return RewardSpec(spec.names, tuple(lowest - level for level in spec.levels))
    return spec

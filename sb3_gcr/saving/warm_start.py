"""What a new model keeps of an old one: the actor, the critic's hidden layers, and the value heads
of the same name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch as th

Parameters = Mapping[str, th.Tensor]

#: The critic's heads, and its layers below, an LSTM among them; its features extractor too where it
#: has one of its own.
HEADS = ("value_net.weight", "value_net.bias")
HIDDEN = ("mlp_extractor.value_net.", "value_net.", "lstm_critic.", "critic.")


@dataclass(frozen=True)
class WarmStart:
    """What was kept.

    :param kept: components whose value heads were kept
    :param fresh: components whose value heads are new
    :param left: components of the old model that the new one does not have
    :param critic: whether the critic's hidden layers were kept
    """

    kept: tuple[str, ...]
    fresh: tuple[str, ...]
    left: tuple[str, ...]
    critic: bool

    def report(self, path: object, statistics: str) -> str:
        """One line for the log.

        :param path: the old model's file
        :param statistics: what became of VecNormalize's
        """
        layers = (
            "actor and critic kept" if self.critic else "actor kept, critic new (its layers differ)"
        )
        heads = {"value heads kept": self.kept, "new": self.fresh, "left behind": self.left}
        listed = "; ".join(f"{what}: {', '.join(names) or 'none'}" for what, names in heads.items())
        return f"Warm start from {path}: {layers}; {listed}; {statistics}."


def merge_parameters(
    new: Parameters,
    old: Parameters,
    names: Sequence[str],
    old_names: Sequence[str],
    shares_extractor: bool,
) -> tuple[dict[str, th.Tensor], WarmStart]:
    """The parameters of a warm start.

    :param new: the new policy's, freshly initialised
    :param old: the old policy's
    :param names: reward components of the new value heads
    :param old_names: of the old ones
    :param shares_extractor: whether actor and critic of the new policy share their features
        extractor
    :return: parameters for the new policy, and what was kept
    :raises ValueError: if the actors differ
    """
    if (
        shares_extractor
    ):  # the entries of the critic are the actor's then; the old critic may have had its own
        old = {
            key: old.get(key.replace("vf_features_extractor.", "pi_features_extractor."), value)
            for key, value in old.items()
        }
    critic = HIDDEN if shares_extractor else (*HIDDEN, "vf_features_extractor.")
    is_actor = {key: not key.startswith(critic) for key in {**new, **old}}
    differing = [
        key for key, actor in is_actor.items() if actor and _shape(new, key) != _shape(old, key)
    ]
    if differing:
        listed = "; ".join(
            f"{key} is {_shape(old, key)} in the file and {_shape(new, key)} in the new model"
            for key in differing
        )
        raise ValueError(
            "Parameter `policy_kwargs` must leave the actor as it was, found other layers: "
            f"{listed}."
        )
    merged = {key: old[key] if is_actor[key] else value.clone() for key, value in new.items()}
    hidden = [key for key, actor in is_actor.items() if not actor and key not in HEADS]
    keeps_critic = all(_shape(new, key) == _shape(old, key) for key in hidden) and all(
        key in new and key in old and new[key].shape[1:] == old[key].shape[1:] for key in HEADS
    )
    kept = [name for name in names if keeps_critic and name in old_names]
    if keeps_critic:
        merged.update({key: old[key] for key in hidden})
        for key in HEADS:
            for name in kept:
                merged[key][names.index(name)] = old[key][old_names.index(name)]
    fresh = tuple(name for name in names if name not in kept)
    return merged, WarmStart(
        tuple(kept), fresh, tuple(name for name in old_names if name not in kept), keeps_critic
    )


def _shape(parameters: Parameters, key: str) -> str:
    return str(tuple(parameters[key].shape)) if key in parameters else "missing"

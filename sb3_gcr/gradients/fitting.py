"""Which policies can be computed by hand: those in which SB3's own code runs, through linear layers
and common activations alone.

A policy is asked for the very objects that run, not for its type alone: a user may tie, freeze,
replace or hook any of them at any time.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch as th
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    DiagGaussianDistribution,
    MultiCategoricalDistribution,
)
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, MlpExtractor
from torch import nn

from sb3_gcr.gradients.hooks import is_hooked
from sb3_gcr.gradients.layers import ACTIVATIONS

#: Distributions with a head in :mod:`sb3_gcr.gradients.heads`.
DISTRIBUTIONS = (
    DiagGaussianDistribution,
    CategoricalDistribution,
    MultiCategoricalDistribution,
    BernoulliDistribution,
)
#: SB3's methods that the hand-written pass replaces.
REPLACED = (
    "evaluate_actions",
    "extract_features",
    "_get_action_dist_from_latent",
    "_build_mlp_extractor",
)


def fits(policy: ActorCriticPolicy) -> bool:
    """Whether the hand-written pass computes what this policy computes.

    :param policy: as it is now
    """
    return (
        _runs_sb3s_code(policy)
        and fits_mlp(actor_modules(policy))
        and fits_mlp(critic_modules(policy))
        and not is_hooked(policy)
        and _trains_each_parameter_once(policy)
    )


def actor_modules(policy: ActorCriticPolicy) -> list[nn.Module]:
    """Layers and activations from the features to the distribution's parameters."""
    return [*policy.mlp_extractor.policy_net, policy.action_net]


def critic_modules(policy: ActorCriticPolicy) -> list[nn.Module]:
    """Layers and activations from the features to the values."""
    return [*policy.mlp_extractor.value_net, policy.value_net]


def fits_mlp(modules: list[nn.Module]) -> bool:
    """Whether modules are linear layers and known activations in turn."""
    layers, activations = modules[::2], modules[1::2]
    if len(layers) != len(activations) + 1:
        return False
    if any(getattr(activation, "inplace", False) for activation in activations):
        return False
    linear = all(type(layer) is nn.Linear and layer.bias is not None for layer in layers)
    return linear and all(type(activation) in ACTIVATIONS for activation in activations)


def _runs_sb3s_code(policy: ActorCriticPolicy) -> bool:
    """Whether neither a class nor an instance has replaced a method on the way."""
    if any(
        getattr(type(policy), name) is not getattr(ActorCriticPolicy, name) for name in REPLACED
    ):
        return False
    if not all(_only_flattens(extractor) for extractor in _extractors(policy)):
        return False
    if type(policy.action_dist) not in DISTRIBUTIONS:
        return False
    hidden = policy.mlp_extractor
    if type(hidden) is not MlpExtractor:
        return False
    if not all(type(net) is nn.Sequential for net in (hidden.policy_net, hidden.value_net)):
        return False
    parts: Iterable[object] = (*policy.modules(), policy.action_dist)
    return not any(_hides_a_method(part) for part in parts)


def _extractors(policy: ActorCriticPolicy) -> list[nn.Module]:
    """The features extractors that run, of the actor and of the critic."""
    if policy.share_features_extractor:
        return [policy.features_extractor]
    return [policy.pi_features_extractor, policy.vf_features_extractor]


def _only_flattens(extractor: nn.Module) -> bool:
    """Whether a features extractor is one of SB3's that only flatten and concatenate."""
    if type(extractor) is CombinedExtractor:
        return all(type(part) is nn.Flatten for part in extractor.extractors.values())
    return type(extractor) is FlattenExtractor


def _hides_a_method(part: object) -> bool:
    """Whether an attribute of the object itself hides a method of its class."""
    return any(
        callable(value) and callable(getattr(type(part), name, None))
        for name, value in vars(part).items()
    )


def _trains_each_parameter_once(policy: ActorCriticPolicy) -> bool:
    """Whether each parameter belongs to one layer and is trained, and the optimiser steps all of
    them and no others.
    """
    expected: list[object] = []
    for layer in (*actor_modules(policy)[::2], *critic_modules(policy)[::2]):
        expected += [layer.weight, layer.bias]
    if isinstance(policy.action_dist, DiagGaussianDistribution):
        if tuple(policy.log_std.shape) != policy.action_space.shape:
            return False
        expected.append(policy.log_std)
    found = list(policy.parameters())
    known = {id(parameter) for parameter in expected}
    if len(found) != len(expected) or {id(parameter) for parameter in found} != known:
        return False
    if len({parameter.device for parameter in found}) > 1:
        return False
    groups = policy.optimizer.param_groups
    stepped = {id(parameter) for group in groups for parameter in group["params"]}
    return stepped == known and all(_is_common(parameter) for parameter in found)


def _is_common(parameter: nn.Parameter) -> bool:
    """Whether a parameter is a trained one of PyTorch's own kind."""
    is_float = parameter.dtype == th.float32 and parameter.is_contiguous()
    return type(parameter) is nn.Parameter and parameter.requires_grad and is_float

"""A model's settings and spaces as plain JSON: what can be read back without unpickling
anything.
"""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.policies import (
    ActorCriticCnnPolicy,
    ActorCriticPolicy,
    MultiInputActorCriticPolicy,
)
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule
from torch import nn

from sb3_gcr.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

#: The arguments of ``GCRPPO`` that are settings.
SETTINGS = (
    *(
        "learning_rate",
        "n_steps",
        "batch_size",
        "n_epochs",
        "gamma",
        "gae_lambda",
        "clip_range",
        "clip_range_vf",
    ),
    *(
        "normalize_advantage",
        "ent_coef",
        "vf_coef",
        "max_grad_norm",
        "use_sde",
        "sde_sample_freq",
        "rollout_buffer_class",
    ),
    *(
        "rollout_buffer_kwargs",
        "target_kl",
        "stats_window_size",
        "tensorboard_log",
        "policy_kwargs",
        "verbose",
        "seed",
    ),
    *(
        "resolver",
        "resolver_kwargs",
        "advantage_scope",
        "kappa_max",
        "desired_kl",
        "gramian_method",
        "gramian_samples",
    ),
)
#: Those that a file of somebody else has no say in: where to write, and a class.
PRIVATE = ("tensorboard_log", "rollout_buffer_class")
#: SB3's policies and ours, by the name that ``GCRPPO(policy)`` takes.
POLICIES: dict[type[Any], str] = {
    **{MlpPolicy: "MlpPolicy", CnnPolicy: "CnnPolicy", MultiInputPolicy: "MultiInputPolicy"},
    **{
        ActorCriticPolicy: "MlpPolicy",
        ActorCriticCnnPolicy: "CnnPolicy",
        MultiInputActorCriticPolicy: "MultiInputPolicy",
    },
}
#: The classes that ``policy_kwargs`` may name.
_ACTIVATIONS = (
    nn.Tanh,
    nn.ReLU,
    nn.ELU,
    nn.SELU,
    nn.CELU,
    nn.GELU,
    nn.SiLU,
    nn.Mish,
    nn.LeakyReLU,
    nn.Sigmoid,
    nn.Softplus,
)
_OPTIMISERS = (th.optim.Adam, th.optim.AdamW, th.optim.SGD, th.optim.RMSprop, RMSpropTFLike)
CLASSES: dict[str, dict[str, type[Any]]] = {
    name: {cls.__name__: cls for cls in classes}
    for name, classes in {
        "activation_fn": _ACTIVATIONS,
        "optimizer_class": _OPTIMISERS,
        "features_extractor_class": (FlattenExtractor, NatureCNN, CombinedExtractor),
    }.items()
}


def collect_settings(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """The settings among the attributes of a PPO or GCRPPO, as its constructor takes them.

    :param attributes: of a model, or of the file of one
    """
    found = {name: attributes[key] for name in SETTINGS if (key := _attribute(name)) in attributes}
    if found.get("rollout_buffer_class") in (
        RolloutBuffer,
        DictRolloutBuffer,
    ):  # SB3's choice for one objective
        found["rollout_buffer_class"] = None
    for name in ("learning_rate", "clip_range", "clip_range_vf"):
        if isinstance(found.get(name), FloatSchedule):
            found[name] = found[name].value_schedule
        if isinstance(found.get(name), ConstantSchedule):
            found[name] = found[name].val
    return found


def _attribute(name: str) -> str:
    return "_stats_window_size" if name == "stats_window_size" else name


def describe_settings(settings: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Settings as JSON, and what is none of it by name.

    :param settings: of ``collect_settings``
    :return: the plain ones; and what the others are, e.g. ``{"learning_rate": "function warm_up"}``
    """
    plain: dict[str, Any] = {}
    rest: dict[str, str] = {}
    for name, value in settings.items():
        if name in PRIVATE:
            if name == "rollout_buffer_class" and value is not None:
                rest[name] = describe_object(value)
        elif name == "policy_kwargs" and isinstance(value, Mapping):
            plain[name] = {}
            for key, item in value.items():
                if item in CLASSES.get(key, {}).values():
                    plain[name][key] = item.__name__
                else:
                    _describe(item, key, plain[name], rest, f"policy_kwargs[{key!r}]")
        else:
            _describe(value, name, plain, rest, name)
    return plain, rest


def _describe(value: Any, key: str, plain: dict[str, Any], rest: dict[str, str], name: str) -> None:
    try:
        plain[key] = to_plain(value)
    except TypeError:
        rest[name] = describe_object(value)


def describe_object(value: Any) -> str:
    """What an object is, for people: "class Policy", "function warm_up", "Schedule object"."""
    if isinstance(value, type):
        return f"class {value.__qualname__}"
    return (
        f"function {value.__qualname__}"
        if hasattr(value, "__qualname__")
        else f"{type(value).__name__} object"
    )


def to_plain(value: Any) -> Any:
    """Numbers, strings, booleans, None, and lists and dicts of them.

    :param value: a setting
    :raises TypeError: for anything else
    """
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, str | int | float):
        return value
    if isinstance(value, list | tuple):
        return [to_plain(item) for item in value]
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {key: to_plain(item) for key, item in value.items()}
    raise TypeError


def parse_settings(plain: Mapping[str, Any]) -> dict[str, Any]:
    """The inverse of ``describe_settings``.

    :param plain: settings as JSON
    :raises ValueError: for names that are no settings, and classes that are not in ``CLASSES``
    """
    unknown = sorted(set(plain) - set(SETTINGS).difference(PRIVATE))
    if unknown:
        raise ValueError(f"The settings in a file must be arguments of GCRPPO, found {unknown}.")
    settings = dict(plain)
    if isinstance(settings.get("policy_kwargs"), Mapping):
        settings["policy_kwargs"] = dict(settings["policy_kwargs"])
        for key in set(settings["policy_kwargs"]) & set(CLASSES):
            name = settings["policy_kwargs"][key]
            if not isinstance(name, str) or name not in CLASSES[key]:
                raise ValueError(
                    f"`policy_kwargs[{key!r}]` in a file must be one of {sorted(CLASSES[key])}, "
                    f"found {name!r}."
                )
            settings["policy_kwargs"][key] = CLASSES[key][name]
    return settings


def describe_space(space: spaces.Space[Any]) -> dict[str, Any]:
    """An observation or action space as JSON.

    :param space: one that SB3 knows; of others only what they print
    """
    kind = type(space).__name__
    if isinstance(space, spaces.Dict):
        return {"type": kind, "spaces": {key: describe_space(item) for key, item in space.items()}}
    if isinstance(space, spaces.Box):
        bounds = {"low": _shorten(space.low), "high": _shorten(space.high)}
        return {
            "type": kind,
            "shape": list(space.shape),
            "dtype": np.dtype(space.dtype).name,
            **bounds,
        }
    if isinstance(space, spaces.Discrete):
        return {"type": kind, "n": int(space.n), "start": int(space.start)}
    if isinstance(space, spaces.MultiDiscrete):
        return {"type": kind, "nvec": space.nvec.tolist()}
    if isinstance(space, spaces.MultiBinary):
        return {
            "type": kind,
            "n": list(space.n) if isinstance(space.n, tuple | list) else int(space.n),
        }
    return {"type": kind, "text": repr(space)}


def _shorten(bound: Any) -> Any:
    """A bound that is the same everywhere as one number."""
    values = np.unique(bound)
    return float(values[0]) if values.size == 1 else bound.tolist()


def find_differences(saved: Any, found: Any, name: str) -> list[str]:
    """What differs between two descriptions, a line for each entry.

    :param saved: from the file
    :param found: of the env
    :param name: what is described
    """
    if (
        isinstance(saved, dict)
        and isinstance(found, dict)
        and saved.get("type") == found.get("type")
    ):
        keys = {**saved, **found}
        pairs = [
            (saved.get(key, "missing"), found.get(key, "missing"), f"{name}.{key}") for key in keys
        ]
        return [line for pair in pairs for line in find_differences(*pair)]
    if isinstance(saved, dict) and isinstance(found, dict):
        return find_differences(saved["type"], found["type"], f"{name}.type")
    return (
        []
        if saved == found
        else [f"{name} is {reprlib.repr(saved)} in the file and {reprlib.repr(found)} in the env"]
    )

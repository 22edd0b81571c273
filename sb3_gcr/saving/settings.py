"""A model's settings: which there are, and as plain JSON that can be read without unpickling
anything.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Container, Iterable, Mapping
from types import UnionType
from typing import Any, Union, get_args, get_origin

import numpy as np
import torch as th
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule
from torch import nn

from sb3_gcr.checks import text_hint

#: Arguments of a model's constructor that are no settings.
NOT_SETTINGS = ("self", "policy", "env", "device", "_init_setup_model")
#: Those that a file of somebody else has no say in: where to write, and a class.
PRIVATE = ("tensorboard_log", "rollout_buffer_class")
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


def find_settings(model_class: type[Any]) -> dict[str, Any]:
    """The arguments of a class's constructor that are settings, with their types.

    A constructor that passes ``**kwargs`` on takes those of the class that it inherits from, too.

    :param model_class: GCRPPO or a subclass
    """
    found: dict[str, Any] = {}
    for base in model_class.__mro__:
        constructor = vars(base).get("__init__")
        if constructor is None:
            continue
        parameters = _find_parameters(constructor)
        for parameter in parameters:
            is_named = parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
            if is_named and parameter.name not in NOT_SETTINGS:
                found.setdefault(parameter.name, parameter.annotation)
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            break
    return found


def declared(model_class: type[Any], name: str) -> list[Any]:
    """What a class and its bases list in a class attribute, the bases first.

    :param model_class: of a model
    :param name: of the attribute
    """
    bases = reversed(model_class.__mro__)
    return [item for base in bases for item in vars(base).get(name, ())]


def find_policy_name(model_class: type[Any], policy_class: type[Any]) -> str | None:
    """The name by which a model takes a policy, ours or that of the PPO below; None if it has none.

    :param model_class: GCRPPO or a subclass
    :param policy_class: of the policy
    """
    for base in model_class.__mro__:
        for name, named_class in vars(base).get("policy_aliases", {}).items():
            if named_class is policy_class:
                return str(name)
    return None


def _find_parameters(constructor: Callable[..., Any]) -> list[inspect.Parameter]:
    """A constructor's parameters, with types as objects where their names exist at run time."""
    try:
        signature = inspect.signature(constructor, eval_str=True)
    except (NameError, AttributeError, TypeError):
        signature = inspect.signature(constructor)
    return list(signature.parameters.values())


def attribute_of(setting: str, attributes: Container[str]) -> str:
    """Where a model keeps a setting: SB3's ``stats_window_size`` is ``_stats_window_size``.

    :param setting: name of the argument
    :param attributes: names of the model's attributes
    """
    private = f"_{setting}"
    return private if setting not in attributes and private in attributes else setting


def collect_settings(attributes: Mapping[str, Any], settings: Iterable[str]) -> dict[str, Any]:
    """The settings among the attributes of a PPO or GCRPPO, as its constructor takes them.

    :param attributes: of a model, or of the file of one
    :param settings: names of ``find_settings``; those that the model does not keep are left out
    """
    kept = {name: attribute_of(name, attributes) for name in settings}
    found = {name: attributes[key] for name, key in kept.items() if key in attributes}
    # SB3's choice for one objective
    if found.get("rollout_buffer_class") in (RolloutBuffer, DictRolloutBuffer):
        found["rollout_buffer_class"] = None
    for name in ("learning_rate", "clip_range", "clip_range_vf"):
        if isinstance(found.get(name), FloatSchedule):
            found[name] = found[name].value_schedule
        if isinstance(found.get(name), ConstantSchedule):
            found[name] = found[name].val
    return found


def refuse_text(given: Mapping[str, Any], settings: Mapping[str, Any], where: str = "") -> None:
    """Refuse text and lists where a setting is a number or a switch.

    :param given: values by name
    :param settings: types of ``find_settings``
    :param where: where the values come from, for the error
    :raises TypeError: names the setting, what it must be and what was found
    """
    for name, value in given.items():
        wanted = _number_or_switch(settings.get(name, Any))
        if wanted and isinstance(value, str | list | tuple | Mapping):
            hint = text_hint(value) if not where else ""
            raise TypeError(f"Parameter `{name}` must be {wanted}, found {value!r}{where}.{hint}")


def _number_or_switch(kind: Any) -> str | None:
    """What an argument of a type must be, None where it is neither number nor switch."""
    is_union = get_origin(kind) in (Union, UnionType)
    kinds = get_args(kind) if is_union else (kind,)
    if str in kinds:
        return None
    if bool in kinds:
        return "True or False"
    return "a number" if int in kinds or float in kinds else None


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


def parse_settings(plain: Mapping[str, Any], model_class: type[Any]) -> dict[str, Any]:
    """The inverse of ``describe_settings``.

    :param plain: settings as JSON
    :param model_class: whose settings they are
    :raises ValueError: for names that are no settings, text for numbers, and classes that are not
        in ``CLASSES``
    """
    known = find_settings(model_class)
    unknown = sorted(set(plain) - set(known).difference(PRIVATE))
    if unknown:
        raise ValueError(
            f"The settings in a file must be arguments of {model_class.__name__}, found {unknown}."
        )
    refuse_text(plain, known, " in the file")
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

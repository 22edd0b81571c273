"""The layers of a VecEnv from outside to inside, and what each of them says itself.

SB3's ``VecEnvWrapper.__getattr__`` raises where two layers have an attribute of the same name,
which ``getattr(env, name, None)`` swallows; so the layers are asked one by one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from sb3_gcr.rewards.spec import RewardSpec


def layers_of(env: VecEnv) -> list[Any]:
    """A VecEnv and all that it wraps; the innermost may be no VecEnv of SB3.

    :param env: a VecEnv
    """
    layers: list[Any] = [env]
    while isinstance(layers[-1], VecEnvWrapper):
        layers.append(layers[-1].venv)
    return layers


def own_attribute(layer: Any, name: str) -> Any:
    """An attribute of one layer itself, None where it has none.

    :param layer: one of :func:`layers_of`
    :param name: of the attribute
    """
    is_own = name in vars(layer) or hasattr(type(layer), name)
    if isinstance(layer, VecEnvWrapper) and not is_own:
        return None
    return getattr(layer, name, None)


def outermost_attribute(env: VecEnv, name: str) -> Any:
    """An attribute of the outermost layer that has it, None where none has.

    :param env: a VecEnv
    :param name: of the attribute
    """
    found = (own_attribute(layer, name) for layer in layers_of(env))
    return next((value for value in found if value is not None), None)


def env_attributes(env: VecEnv, name: str) -> list[Any]:
    """An attribute of all envs inside, or nothing where there is none or the VecEnv cannot say.

    :param env: a VecEnv
    :param name: of the attribute
    """
    try:
        if not env.has_attr(name):
            return []
    except (AttributeError, NotImplementedError):
        pass  # somebody else's VecEnv may lack the question but know the answer
    except Exception:
        return []
    try:
        return list(env.get_attr(name))
    except Exception:
        return []


def find_reward_spec(env: VecEnv) -> RewardSpec | None:
    """The spec that the outermost layer of a VecEnv carries as ``reward_spec``, or each of its
    envs; None where there is none.

    :param env: a VecEnv
    :raises TypeError: if ``reward_spec`` is neither a RewardSpec nor a mapping of names to levels
    :raises ValueError: if the envs disagree
    """
    specs = placed_specs(env)
    return specs[0].spec if specs else None


class Placed(NamedTuple):
    """A spec, and the depth of the layer that carries it; the outermost has depth 0."""

    spec: RewardSpec
    depth: int


def placed_specs(env: VecEnv) -> list[Placed]:
    """All specs from outside to inside; that of the envs is as deep as the innermost layer.

    :param env: a VecEnv
    """
    layers = layers_of(env)
    found: list[Placed] = []
    for depth, layer in enumerate(layers):
        spec = own_attribute(layer, "reward_spec")
        if spec is not None and not callable(spec):  # a method of that name is somebody else's
            found.append(Placed(_as_spec(spec), depth))
    if not found or found[-1].depth < len(layers) - 1:
        inside = _spec_of_envs(env)
        found += [Placed(inside, len(layers) - 1)] if inside is not None else []
    return found


def _spec_of_envs(env: VecEnv) -> RewardSpec | None:
    found = env_attributes(env, "reward_spec")
    if all(spec is None or callable(spec) for spec in found):
        return None
    specs = [_as_spec(spec) for spec in found]
    for index, other in enumerate(specs):
        if other != specs[0]:
            raise ValueError(
                f"All envs must have the same `reward_spec`, found ({specs[0]}) in env 0 and "
                f"({other}) in env {index}."
            )
    return specs[0]


def _as_spec(spec: Any) -> RewardSpec:
    if isinstance(spec, RewardSpec):
        return spec
    if isinstance(spec, Mapping):
        return RewardSpec.from_dict(spec)
    raise TypeError(
        "An env's `reward_spec` must be a RewardSpec or a mapping of names to levels, found "
        f"{spec!r}."
    )

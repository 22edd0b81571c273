"""The layers of a VecEnv from outside to inside, and what each of them says itself.

SB3's ``VecEnvWrapper.__getattr__`` raises where two layers have an attribute of the same name,
which ``getattr(env, name, None)`` swallows; so the layers are asked one by one.
"""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper


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

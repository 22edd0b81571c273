"""``sb3-gcr-zoo components --env ...``: which numbers are the terms of an env's reward."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import gymnasium as gym

from sb3_gcr.rewards.finding import find_components


def show_components(program: str, options: Sequence[str]) -> None:
    """Print what :func:`~sb3_gcr.rewards.finding.find_components` finds.

    :param program: name for the help
    :param options: of the command line
    """
    parser = argparse.ArgumentParser(
        program,
        description=(
            "Act at random, and look for the terms of the reward in the infos and attributes of an "
            "env. It moves the env: not for a robot that must not move at random."
        ),
    )
    parser.add_argument("--env", required=True, help="id of Gymnasium, or module:Class")
    parser.add_argument("--n-steps", type=int, default=200, help="random steps (default: 200)")
    parser.add_argument("--seed", type=int, default=0, help="of env and actions (default: 0)")
    arguments = parser.parse_args(options)
    try:
        env = make_env(arguments.env)
        found = find_components(env, arguments.n_steps, arguments.seed)
    except (ValueError, TypeError, ImportError, gym.error.Error) as error:
        parser.error(str(error))
    env.close()
    sys.stdout.write(f"{found}\n")


def make_env(name: str) -> gym.Env[Any, Any]:
    """An env by id, by ``module:Class`` or by ``module:function``; modules in the current folder
    count.

    :param name: such as "Hopper-v5" or "my_robot:Robot"
    :raises ValueError: for a class that makes no env
    """
    module_name, _, attribute = name.partition(":")
    if not attribute.isidentifier():
        return gym.make(name)
    sys.path.insert(0, os.getcwd())
    try:
        module = import_module(module_name)
    finally:
        sys.path.remove(os.getcwd())
    if not hasattr(module, attribute):
        raise ValueError(f"Module '{module_name}' has no '{attribute}'.")
    make = getattr(module, attribute)
    if not callable(make):
        raise ValueError(
            f"'{name}' must be a class or function that makes an env, found a "
            f"{type(make).__name__}."
        )
    env = make()
    if not isinstance(env, gym.Env):
        raise ValueError(f"'{name}' must make an env of Gymnasium, found {type(env).__name__}.")
    return env

"""A measurement that leaves no trace: generators and VecNormalize as they were."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_gcr.rewards.layers import layers_of

#: What VecNormalize learns from the steps of its env.
LEARNED = ("training", "obs_rms", "ret_rms", "returns", "old_obs", "old_reward", "norm_reward")
#: And what makes of observations and rewards what actor and critic have learned from.
STATISTICS = ("obs_rms", "ret_rms", "norm_reward")


@contextmanager
def kept_generators() -> Iterator[None]:
    """Python's, NumPy's and PyTorch's generators are afterwards what they were before."""
    of_python = random.getstate()
    of_numpy = np.random.get_state()
    of_torch = th.get_rng_state()
    of_devices = th.cuda.get_rng_state_all() if th.cuda.is_available() else []
    try:
        yield
    finally:
        random.setstate(of_python)
        np.random.set_state(of_numpy)
        th.set_rng_state(of_torch)
        if of_devices:
            th.cuda.set_rng_state_all(of_devices)


def normalisers(env: VecEnv) -> list[VecNormalize]:
    """Each VecNormalize around an env, the outermost first."""
    return [layer for layer in layers_of(env) if isinstance(layer, VecNormalize)]


@contextmanager
def kept_statistics(wrappers: Sequence[VecNormalize]) -> Iterator[None]:
    """VecNormalize learns nothing meanwhile and is afterwards what it was before.

    :param wrappers: of the env to measure on
    """
    before = [
        {name: value for name, value in vars(wrapper).items() if name in LEARNED}
        for wrapper in wrappers
    ]
    for wrapper, values in zip(wrappers, before, strict=True):
        wrapper.__dict__.update(deepcopy(values), training=False)
    try:
        yield
    finally:
        for wrapper, values in zip(wrappers, before, strict=True):
            wrapper.__dict__.update(values)


def adopt_statistics(wrappers: Sequence[VecNormalize], others: Sequence[VecNormalize]) -> None:
    """Let an env be seen as the model's own env is.

    :param wrappers: of the env to measure on
    :param others: of the model's env
    """
    for wrapper, other in zip(wrappers, others, strict=False):
        for name in STATISTICS:
            if name in vars(other) and name in vars(wrapper):
                setattr(wrapper, name, deepcopy(getattr(other, name)))

"""Rows of single steps of an iteration, so that a regression shows where it is."""

from __future__ import annotations

from functools import partial

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer

from benchmarks.measuring import Case, Contestant, timed
from benchmarks.rollouts import SEED, mixed_signals
from sb3_gcr import RESOLVERS
from sb3_gcr.advantages import component_gae

STEPS, ENVS = 2048, 8
GAMMA, GAE_LAMBDA = 0.99, 0.95
EPISODE_END = 0.005
#: Different Gramians that a resolver is called with in turn, and samples behind each of them.
GRAMIANS, SAMPLES = 200, 64


def component_gae_alone(n_components: int) -> Contestant:
    """All components at once."""
    rng = np.random.default_rng(SEED)
    rewards, values = rng.standard_normal((2, STEPS, ENVS, n_components), np.float32)
    starts = (rng.random((STEPS, ENVS)) < EPISODE_END).astype(np.float32)
    last_values, dones = np.zeros((ENVS, n_components), np.float32), np.zeros(ENVS, bool)
    run = partial(component_gae, rewards, values, starts, last_values, dones, GAMMA, GAE_LAMBDA)
    return Contestant(f"component_gae K={n_components}", timed(run))


def buffer_by_buffer(n_components: int) -> Contestant:
    """SB3's rollout buffer, once for each component."""
    rng = np.random.default_rng(SEED)
    space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    buffers = []
    for _ in range(n_components):
        buffer = RolloutBuffer(STEPS, space, space, "cpu", GAE_LAMBDA, GAMMA, ENVS)
        buffer.rewards[:], buffer.values[:] = rng.standard_normal((2, STEPS, ENVS), np.float32)
        buffer.episode_starts[:] = rng.random((STEPS, ENVS)) < EPISODE_END
        buffers.append(buffer)

    def run() -> None:
        for buffer in buffers:
            buffer.compute_returns_and_advantage(th.zeros(ENVS), np.zeros(ENVS, bool))

    return Contestant(f"{n_components} RolloutBuffers", timed(run))


def resolver_alone(name: str, n_components: int) -> Contestant:
    """One resolver on Gramians with half of their pairs in conflict."""
    rng = np.random.default_rng(SEED)
    signals = (
        mixed_signals(GRAMIANS * SAMPLES, n_components, rng)
        .reshape(GRAMIANS, SAMPLES, n_components)
        .astype(float)
    )
    gramians = signals.mT @ signals
    levels = (2 * np.arange(n_components) >= n_components).astype(int)
    first, second = np.triu_indices(n_components, 1)
    share = float((gramians[:, first, second] < 0).mean())
    resolve = RESOLVERS[name]

    def run() -> None:
        for gramian in gramians:
            resolve(gramian, levels, rng)

    return Contestant(f"{name} K={n_components}", timed(run, calls=GRAMIANS), lambda: share)


def cases() -> list[Case]:
    """All rows of this group; a resolver is compared with ``gcr``, which is compared with itself at
    K = 4.
    """
    sizes = (4, 10, 20)
    return [
        *(
            Case(
                "parts",
                f"GAE {STEPS}×{ENVS}",
                partial(component_gae_alone, k),
                partial(buffer_by_buffer, k),
            )
            for k in (1, 10, 50)
        ),
        *(
            Case(
                "parts",
                "resolver",
                partial(resolver_alone, name, k),
                partial(resolver_alone, "gcr", 4 if name == "gcr" else k),
                unit="µs",
            )
            for name in RESOLVERS
            for k in sizes
        ),
    ]

"""Rows of the envs: what a step costs beside the physics, and whole ``learn()`` runs on many
robots.

Run as a module, with the name of a task, it prints the memory of one more simulation.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Iterator
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnv

from benchmarks.measuring import Case, Contestant, timed
from benchmarks.rollouts import SEED
from sb3_gcr import GCRPPO
from sb3_gcr.envs import BatchedVecEnv, EnvPoolVecEnv
from sb3_gcr.envs.task import Rows
from sb3_gcr.envs.tasks.catalogue import make_task

N_THREADS = 2
#: Steps of all robots in one measurement, and in between before the first.
N_STEPS, N_SETTLE = 100, 50


def batched(name: str, n_envs: int) -> VecEnv:
    """Our env on two threads."""
    kwargs = {"n_threads": N_THREADS}
    return make_vec_env(
        f"sb3_gcr/{name}-v0",
        n_envs,
        seed=SEED,
        vec_env_cls=BatchedVecEnv,  # type: ignore[arg-type]
        vec_env_kwargs=kwargs,
    )


def random_actions(n_envs: int, low: Any, high: Any) -> Iterator[NDArray[np.float32]]:
    """The same ones again and again."""
    rng = np.random.default_rng(SEED)
    return cycle([rng.uniform(low, high, (n_envs, len(low))).astype(np.float32) for _ in range(16)])


def stepping(label: str, step: Callable[[], object], n_envs: int) -> Contestant:
    """Seconds per step of one robot."""
    for _ in range(N_SETTLE):
        step()
    return Contestant(
        label, timed(lambda: [step() for _ in range(N_STEPS)], calls=N_STEPS * n_envs)
    )


def full_step(name: str, n_envs: int) -> Contestant:
    """Terms, observations, resets and infos included."""
    env = batched(name, n_envs)
    env.reset()
    actions = random_actions(n_envs, env.action_space.low, env.action_space.high)  # type: ignore[attr-defined]
    return stepping("BatchedVecEnv", lambda: env.step(next(actions)), n_envs)


def bare_step(name: str, n_envs: int) -> Contestant:
    """Nothing but controls, ``Batch.step``, and a fresh start for robots that have fallen."""
    batch_module = importlib.import_module("mujoco.batch")
    task = make_task(name)
    batch = batch_module.Batch(task.model, n_envs, N_THREADS)
    arrays = {field: batch.bind(field) for field in ("qpos", "qvel", "ctrl")}
    rows = Rows(arrays)
    low, high = task.model.actuator_ctrlrange.T
    actions = random_actions(n_envs, low, high)
    start = np.asarray(task.start(np.random.default_rng(SEED))["qpos"])

    def restart(ids: NDArray[Any]) -> None:
        batch.reset(ids)
        rows.qpos[ids] = start

    def step() -> None:
        rows.ctrl[:] = next(actions)
        batch.step(nstep=task.n_substeps)
        fallen = np.flatnonzero(task.terminated(rows))
        if len(fallen):
            restart(fallen)

    restart(np.arange(n_envs))
    return stepping("Batch.step", step, n_envs)


def envpool_step(env_id: str, n_envs: int) -> Contestant:
    """EnvPool's own loop."""
    pool: Any = importlib.import_module("envpool").make(
        env_id, "gymnasium", num_envs=n_envs, num_threads=N_THREADS, seed=SEED
    )
    pool.reset()
    actions = random_actions(n_envs, pool.action_space.low, pool.action_space.high)
    return stepping(
        f"EnvPool {env_id}",
        lambda: pool.step(next(actions).astype(pool.action_space.dtype)),
        n_envs,
    )


def learning(
    label: str, algorithm: Any, make_env: Callable[[], VecEnv], **arguments: Any
) -> Contestant:
    """One rollout and its update, seconds per env step."""
    env = make_env()
    model = algorithm("MlpPolicy", env, seed=SEED, device="cpu", **arguments)
    model.set_logger(configure(None, []))
    steps = env.num_envs * arguments["n_steps"]
    return Contestant(
        label, timed(partial(model.learn, steps, reset_num_timesteps=False), calls=steps)
    )


def envpool_learning(n_envs: int) -> Contestant:
    """GCRPPO on EnvPool's Humanoid, four terms; the rollout has 2048 steps, as that of PPO on 8
    envs.
    """
    make_env = partial(EnvPoolVecEnv, "Humanoid-v5", n_envs, N_THREADS)
    return learning(f"GCRPPO, {n_envs} in EnvPool", GCRPPO, make_env, n_steps=2048 // n_envs)


def humanoid_learning() -> Contestant:
    """GCRPPO on HumanoidRun, seven terms, 256 robots."""
    arguments = {"n_steps": 32, "batch_size": 2048, "n_epochs": 4}
    return learning("GCRPPO K=7", GCRPPO, partial(batched, "HumanoidRun", 256), **arguments)


def cases() -> list[Case]:
    """All rows of this group."""
    rows = [
        Case(
            "envs",
            f"{name}, {n} robots",
            partial(full_step, name, n),
            partial(bare_step, name, n),
            1 / 0.75,
            "steps/s",
        )
        for name, n in (("HalfCheetah", 64), ("Hopper", 64), ("Walker2d", 64), ("HumanoidRun", 256))
    ]
    humanoid, pool = (
        partial(full_step, "HumanoidRun", 256),
        partial(envpool_step, "Humanoid-v5", 256),
    )
    rows.append(Case("envs", "256 humanoids", humanoid, pool, 1 / 3, "steps/s", needs=("envpool",)))
    ppo = partial(
        learning,
        "PPO, 8 in DummyVecEnv",
        PPO,
        partial(make_vec_env, "Humanoid-v5", 8, SEED),
        n_steps=256,
    )
    for n, bar in ((256, 0.5), (64, None)):
        subject = partial(envpool_learning, n)
        rows.append(
            Case("envs", "learn() on Humanoid-v5", subject, ppo, bar, "steps/s", needs=("envpool",))
        )
    bare = partial(bare_step, "HumanoidRun", 256)
    rows.append(Case("envs", "learn(), 256 robots", humanoid_learning, bare, unit="steps/s"))
    return rows


def memory_of_a_simulation(name: str) -> float:
    """Growth of this process per simulation, in bytes, between 512 and 2560 of them."""
    statm = Path("/proc/self/statm")

    def resident() -> int:
        return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    few = batched(name, 512)
    few.reset()
    before = resident()
    many = batched(name, 2048)
    many.reset()
    return (resident() - before) / 2048


if __name__ == "__main__":
    print(
        f"{memory_of_a_simulation(sys.argv[1]) / 1e3:.1f} kB for each simulation of {sys.argv[1]}"
    )

"""Conflicts of HumanoidRun: between rollouts, and inside minibatches of several sizes.

``python -m benchmarks.conflicts train`` trains the agent; with ``measure`` in place of ``train``
it writes docs/data/conflicts.json, from which ``python docs/pictures.py noise`` draws.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch import nn

from sb3_gcr import GCRPPO, envs
from sb3_gcr.angles import cosines
from sb3_gcr.conflicts.blocks import Blocks
from sb3_gcr.conflicts.estimators import Estimate, estimate
from sb3_gcr.conflicts.measuring import rollout_gradients
from sb3_gcr.conflicts.result import Conflicts
from sb3_gcr.gradients.by_hand import ByHand
from sb3_gcr.minibatches import Normalisation, minibatches

ENV = "sb3_gcr/HumanoidRun-v0"
DATA = Path(__file__).parents[1] / "docs" / "data" / "conflicts.json"
BATCH_SIZES = (64, 256, 1024, 4096)
#: Settings of hyperparams/gcrppo.yml.
SETTINGS: dict[str, Any] = {
    "n_steps": 32,
    "batch_size": 2048,
    "n_epochs": 5,
    "learning_rate": 5e-4,
    "desired_kl": 0.01,
    "max_grad_norm": 1.0,
    "policy_kwargs": {"activation_fn": nn.ELU, "net_arch": [128, 128]},
}

Numbers = NDArray[np.float64]


def make_env(n_envs: int, seed: int) -> VecEnv:
    """HumanoidRun on one thread, normalised."""
    return VecNormalize(
        make_vec_env(
            ENV,
            n_envs,
            seed=seed,
            vec_env_cls=envs.BatchedVecEnv,  # type: ignore[arg-type]
            vec_env_kwargs={"n_threads": 1},
        )
    )


def train(arguments: argparse.Namespace) -> None:
    """Train and save."""
    model = GCRPPO("MlpPolicy", make_env(256, 0), seed=0, device="cpu", **SETTINGS)
    model.learn(arguments.timesteps)
    model.save(arguments.model)


def inside_minibatches(model: GCRPPO, batch_size: int) -> tuple[Numbers, Numbers]:
    """G and Ĝ of each minibatch of the rollout in a model's buffer, shapes (M, K, K)."""
    actor_critic = ByHand(model.policy, batch_size)
    rounds = minibatches(
        model.rollout_buffer, batch_size, Normalisation(None, np.inf), actor_critic, discrete=False
    )
    found = []
    with th.no_grad(), actor_critic.session():
        for batch in rounds:
            actor_critic.evaluate(batch.observations, batch.actions)
            gramian = actor_critic.gramian(batch.advantages / batch_size)
            found.append([np.asarray(gramian), np.asarray(actor_critic.unbiased_gramian())])
    gramians, unbiased = np.array(found, dtype=float).swapaxes(0, 1)
    return gramians, unbiased


def measure(arguments: argparse.Namespace) -> None:
    """Collect rollouts, and write what the blocks and the minibatches say."""
    env = make_env(256, 1000)
    model = GCRPPO.load(arguments.model, env, device="cpu", seed=1)
    steps = model.num_timesteps
    env.training = False  # type: ignore[attr-defined]
    model.set_logger(Logger(None, []))
    _, callback = model._setup_learn(1)
    blocks = Blocks(arguments.n_rollouts)
    by_size: dict[int, list[tuple[Numbers, Numbers]]] = {size: [] for size in BATCH_SIZES}
    seconds = {"collection": 0.0, "gradients": 0.0}
    for index in range(arguments.n_rollouts):
        start = time.process_time()
        model.collect_rollouts(env, callback, model.rollout_buffer, model.n_steps)
        middle = time.process_time()
        blocks.add(rollout_gradients(model))
        seconds["collection"] += middle - start
        seconds["gradients"] += time.process_time() - middle
        for size in BATCH_SIZES:
            by_size[size].append(inside_minibatches(model, size))
        sys.stderr.write(f"{index + 1}/{arguments.n_rollouts}\n")
    products = blocks.products()
    naive = np.einsum("aaij->ij", products) / len(products)
    found = Conflicts(model.reward_spec, estimate(products), naive, len(products))
    sys.stdout.write(f"{found.table()}\n" + "\n".join(found.sentences()) + f"\n{seconds}\n")
    data = {
        "env": ENV,
        "steps": steps,
        "n_rollouts": arguments.n_rollouts,
        "samples_per_rollout": model.n_steps * env.num_envs,
        "cpu_seconds": seconds,
        "names": list(found.names),
        "cosines": found.cosines.tolist(),
        "z": found.z.tolist(),
        "signal": found.signal.tolist(),
        "rollout_naive": cosines(naive).tolist(),
        "minibatches": {str(size): summary(pairs) for size, pairs in by_size.items()},
    }
    DATA.parent.mkdir(exist_ok=True)
    DATA.write_text(json.dumps(_rounded(data), indent=1).replace("NaN", "null") + "\n")


def summary(pairs: list[tuple[Numbers, Numbers]]) -> dict[str, Any]:
    """Cosines within minibatches of one size, and from their unbiased products together."""
    gramians = np.concatenate([gramian for gramian, _ in pairs])
    naive = cosines(gramians)
    low, high = np.quantile(naive, (0.1, 0.9), axis=0)
    by_rollout = np.array([unbiased.mean(0) for _, unbiased in pairs])
    together = by_rollout.mean(0)
    errors = by_rollout.std(0, ddof=1) / np.sqrt(len(by_rollout))
    squared_norms = gramians.mean(0).diagonal()
    found = Estimate(together, errors, squared_norms)
    return {
        "naive": naive.mean(0).tolist(),
        "low": low.tolist(),
        "high": high.tolist(),
        "unbiased": found.cosines.tolist(),
        "signal": found.signal.tolist(),
    }


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.4g}")
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    if isinstance(value, dict):
        return {key: _rounded(one) for key, one in value.items()}
    return value


def main() -> None:
    """Train or measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("command", choices=["train", "measure"])
    parser.add_argument("--model", default="logs/humanoid_400k")
    parser.add_argument("--timesteps", type=int, default=400_000)
    parser.add_argument("--n-rollouts", type=int, default=24)
    arguments = parser.parse_args()
    th.set_num_threads(1)
    {"train": train, "measure": measure}[arguments.command](arguments)


if __name__ == "__main__":
    main()

"""How well the weights from a subset of whole sequences agree with the exact ones, over a training
run of RecurrentGCRPPO: ``gramian_samples``.
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from benchmarks.agreement import agreement, table
from sb3_gcr import RewardDecomposition
from sb3_gcr.envs import HideObservations
from sb3_gcr.losses import Clip, surrogate_cotangents
from sb3_gcr.recurrent import RecurrentGCRPPO
from sb3_gcr.recurrent.by_autograd import RecurrentByAutograd

ENV = "Hopper-v5"
#: Its velocities.
HIDDEN = (5, 6, 7, 8, 9, 10)
SIZES = (64, 128, 256, 512)
BATCH = 1024


class Watched(RecurrentGCRPPO):
    """Compares every size on the first minibatch of each update, then trains exactly.

    :param args: as for ``RecurrentGCRPPO``
    :param kwargs: as for ``RecurrentGCRPPO``
    """

    def __init__(self, *args: Any, **kwargs: Any):
        self.figures: dict[int, list[tuple[float, float, float]]] = {size: [] for size in SIZES}
        super().__init__(*args, **kwargs)

    def _train_minibatch(self, update: Any, batch: Any) -> bool:
        if not len(update.record):
            self._compare(batch)
        return super()._train_minibatch(update, batch)

    def _compare(self, batch: Any) -> None:
        levels = np.array(self.reward_spec.levels)
        networks = RecurrentByAutograd(self.policy, np.random.default_rng(self.num_timesteps))
        _, log_prob = networks.evaluate(batch.observations, batch.actions)
        cotangents = surrogate_cotangents(
            log_prob, batch.old_log_prob, batch.advantages, Clip(0.2, None)
        )
        gramian = networks.gramian(cotangents).double().numpy()
        for size in SIZES:
            part = networks.gramian(cotangents, size).double().numpy()
            self.figures[size].append(agreement(part, gramian, levels))


def main() -> None:
    """Train with exact weights, and print one row per size of the subset."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.recurrent_agreement", description=__doc__
    )
    parser.add_argument("--timesteps", type=int, default=60_000)
    arguments = parser.parse_args()
    th.set_num_threads(1)

    def make_env() -> gym.Env[Any, Any]:
        return RewardDecomposition(HideObservations(gym.make(ENV), HIDDEN))

    env = VecNormalize(make_vec_env(make_env, n_envs=8, seed=0))
    model = Watched(
        "MlpLstmPolicy", env, n_steps=256, batch_size=BATCH, n_epochs=5, device="cpu", seed=0
    )
    model.learn(arguments.timesteps)
    n_updates = len(model.figures[SIZES[0]])
    print(f"{ENV} without velocities, {model.num_timesteps:,} steps, {n_updates} minibatches")
    print(table(model.figures, BATCH))


if __name__ == "__main__":
    main()

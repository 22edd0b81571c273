"""How well the weights from a part of the minibatch agree with the exact ones, over a training run:
``gramian_samples``.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gcr import GCRPPO, RESOLVERS, RewardDecomposition
from sb3_gcr.advantages import normalize_jointly
from sb3_gcr.angles import conflicts
from sb3_gcr.gradients.by_hand import ByHand
from sb3_gcr.logs.shown import format_table
from sb3_gcr.losses import Clip, surrogate_cotangents

SIZES = (64, 128, 256, 512, 1024)
BATCH = 2048


def agreement(
    part: NDArray[np.float64], gramian: NDArray[np.float64], levels: NDArray[np.int_]
) -> tuple[float, float, float]:
    """Cosine of the steps, mean error of the weights, and share of pairs that conflict in both or
    in neither.

    :param part: G from a part of the minibatch, shape (K, K)
    :param gramian: the exact one
    :param levels: shape (K,)
    """
    weights, exact = (
        RESOLVERS["gcr"](each, levels, np.random.default_rng(0)) for each in (part, gramian)
    )
    # Both steps with all samples, as GCRPPO takes them: ⟨Jᵀw, Jᵀv⟩ = wᵀ G v.
    norms = (weights @ gramian @ weights) * (exact @ gramian @ exact)
    cosine = weights @ gramian @ exact / np.sqrt(norms)
    error = np.abs(weights - exact).mean() / np.abs(exact).mean()
    pairs = np.triu_indices(len(levels), 1)
    agree = (conflicts(part)[pairs] == conflicts(gramian)[pairs]).mean()
    return float(cosine), float(error), float(agree)


def table(figures: dict[int, list[tuple[float, float, float]]], batch_size: int) -> str:
    """One row per size of the part.

    :param figures: of :func:`agreement` by size
    :param batch_size: of the minibatch
    """
    columns = ("cosine of the steps: median", "lowest", "mean weight error", "pairs agreed on")
    rows = [["samples", "of", *columns]]
    for size, found in figures.items():
        cosines, errors, agreed = np.array(found).T
        rows.append(
            [
                str(size),
                str(batch_size),
                f"{np.median(cosines):.4f}",
                f"{cosines.min():.4f}",
                f"{np.mean(errors):.1%}",
                f"{np.mean(agreed):.0%}",
            ]
        )
    return format_table(rows)


class Agreement(BaseCallback):
    """After each rollout: exact Gramian and weights of one minibatch, and those of its first n
    samples.
    """

    def _on_training_start(self) -> None:
        self.figures: dict[int, list[tuple[float, float, float]]] = {size: [] for size in SIZES}
        self.rng = np.random.default_rng(0)

    def _on_step(self) -> bool:
        return True

    @th.no_grad()
    def _on_rollout_end(self) -> None:
        model: Any = self.model
        buffer, levels = model.rollout_buffer, np.array(model.reward_spec.levels)
        rows = self.rng.permutation(buffer.buffer_size * buffer.n_envs)[:BATCH]
        advantages, observations, actions, log_probs = (
            th.as_tensor(buffer.swap_and_flatten(array)[rows])
            for array in (
                normalize_jointly(buffer.advantages).advantages,
                buffer.observations,
                buffer.actions,
                buffer.log_probs,
            )
        )
        networks = ByHand(model.policy)
        _, log_prob = networks.evaluate(observations, actions)
        cotangents = surrogate_cotangents(
            log_prob, log_probs.flatten(), advantages, Clip(0.2, None)
        )
        gramian = networks.gramian(cotangents).double().numpy()
        for size in SIZES:
            part = networks.gramian(cotangents, size).double().numpy()
            self.figures[size].append(agreement(part, gramian, levels))


def main() -> None:
    """Train with exact weights, and print one row per size of the subset."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.agreement", description=__doc__)
    parser.add_argument("--env", default="Humanoid-v5")
    parser.add_argument("--timesteps", type=int, default=100_000)
    arguments = parser.parse_args()
    th.set_num_threads(1)
    env = VecNormalize(
        make_vec_env(arguments.env, n_envs=8, seed=0, wrapper_class=RewardDecomposition)
    )
    kwargs: dict[str, Any] = {
        "policy_kwargs": {"net_arch": [400, 200, 100]},
        "device": "cpu",
        "seed": 0,
    }
    model = GCRPPO("MlpPolicy", env, n_steps=512, batch_size=BATCH, n_epochs=10, **kwargs)
    callback = Agreement()
    model.learn(arguments.timesteps, callback=callback, progress_bar=True)
    print(
        f"{arguments.env}, {model.num_timesteps:,} steps, net 400×200×100, "
        f"{len(model.reward_spec)} components"
    )
    print(table(callback.figures, BATCH))


if __name__ == "__main__":
    main()

"""GCRPPO against SB3's PPO at equal settings, several seeds, one table: ``make compare``."""

from __future__ import annotations

import argparse
import json
import multiprocessing
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from scipy.stats import t as student
from scipy.stats import ttest_ind
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from tqdm import tqdm

from sb3_gcr import GCRPPO, RewardDecomposition, evaluate_components
from sb3_gcr.logs.shown import format_table
from sb3_gcr.rewards.decomposition import GYMNASIUM_ENVS

#: Algorithms by the name in the table; all else is equal.
METHODS: dict[str, dict[str, Any]] = {
    "PPO": {},
    "GCRPPO sum": {"resolver": "sum"},
    "GCRPPO gcr": {"resolver": "gcr"},
    "GCRPPO guaranteed": {"resolver": "guaranteed"},
}
EVAL_EPISODES = 20


class Speed(BaseCallback):
    """Keeps the return of the last episodes after each rollout: its mean over training is the
    learning speed.
    """

    def _on_training_start(self) -> None:
        self.returns: list[float] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        buffer = self.model.ep_info_buffer
        if buffer:
            self.returns.append(float(np.mean([episode["r"] for episode in buffer])))


def run(job: tuple[str, str, int, int]) -> dict[str, Any]:
    """Train one method with one seed and evaluate the deterministic policy."""
    env_id, method, seed, timesteps = job
    th.set_num_threads(1)
    env = VecNormalize(make_vec_env(env_id, n_envs=8, seed=seed, wrapper_class=RewardDecomposition))
    algorithm = PPO if method == "PPO" else GCRPPO
    model = algorithm("MlpPolicy", env, n_steps=256, seed=seed, device="cpu", **METHODS[method])
    speed = Speed()
    model.learn(timesteps, callback=speed)
    evaluation_env = make_vec_env(
        env_id, n_envs=4, seed=1000 + seed, wrapper_class=RewardDecomposition
    )
    normalised = VecNormalize(evaluation_env, training=False, norm_reward=False)
    normalised.obs_rms = env.obs_rms
    result = evaluate_components(model, normalised, EVAL_EPISODES)
    final = {"return": result.mean_reward, **result.component_means}  # type: ignore[union-attr]
    return {
        "method": method,
        "seed": seed,
        "during training": float(np.mean(speed.returns)),
        "final": final,
    }


def interval(values: list[float]) -> str:
    """Mean and the half-width of its 95 % confidence interval over seeds."""
    half = (
        student.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values))
        if len(values) > 1
        else np.nan
    )
    return f"{np.mean(values):.0f} ± {half:.0f}"


def p_values(samples: dict[str, list[float]]) -> dict[str, str]:
    """Two-sided Welch tests of every method against PPO, Holm-corrected, as text by method."""
    raw = {
        name: float(ttest_ind(values, samples["PPO"], equal_var=False).pvalue)
        for name, values in samples.items()
        if name != "PPO" and "PPO" in samples and len(values) > 1
    }
    corrected: dict[str, float] = {}
    for rank, name in enumerate(sorted(raw, key=lambda key: raw[key])):
        corrected[name] = min(1.0, max([*corrected.values(), raw[name] * (len(raw) - rank)]))
    return {name: f"{p:.2f}" if p >= 0.01 else "< 0.01" for name, p in corrected.items()}


def table(results: list[dict[str, Any]]) -> str:
    """One row per method: return during training and of the final policy with p values against PPO,
    then the components.
    """
    runs = {name: [row for row in results if row["method"] == name] for name in METHODS}
    runs = {name: rows for name, rows in runs.items() if rows}
    training = {name: [row["during training"] for row in rows] for name, rows in runs.items()}
    final = {name: [row["final"]["return"] for row in rows] for name, rows in runs.items()}
    p_training, p_final = p_values(training), p_values(final)
    components = [key for key in results[0]["final"] if key != "return"]
    lines = [["method", "seeds", "return in training", "p", "final return", "p", *components]]
    for name, rows in runs.items():
        cells = [
            interval(training[name]),
            p_training.get(name, ""),
            interval(final[name]),
            p_final.get(name, ""),
        ]
        cells += [interval([row["final"][key] for row in rows]) for key in components]
        lines.append([name, str(len(rows)), *cells])
    return format_table(lines)


def main() -> None:
    """Read the command line, run all jobs on two processes, and write results and table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="Humanoid-v5", choices=sorted(GYMNASIUM_ENVS))
    parser.add_argument("--timesteps", type=int, default=200_000)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("logs/compare.json"))
    arguments = parser.parse_args()
    jobs = [
        (arguments.env, method, seed, arguments.timesteps)
        for seed in range(arguments.seeds)
        for method in arguments.methods
    ]
    results = []
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    with multiprocessing.get_context("spawn").Pool(arguments.processes) as pool:
        for result in tqdm(pool.imap_unordered(run, jobs), total=len(jobs), unit="run"):
            results.append(result)
            arguments.out.write_text(json.dumps(results, indent=1))
    print(
        f"{arguments.env}, {arguments.timesteps:,} steps, {EVAL_EPISODES} deterministic episodes a "
        "seed"
    )
    print(table(results))


if __name__ == "__main__":
    main()

"""The training whose log docs/logs.md shows: HalfCheetah with two reward terms, 100 000 steps."""

from __future__ import annotations

import argparse
import csv
import tempfile
from pathlib import Path

from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gcr import GCRPPO, RewardDecomposition

#: What is kept of the log: keys that begin so.
KEPT = (
    "time/total_timesteps",
    "rollout/ep_rew/",
    "gcr/conflict_rate",
    "gcr/grad_norm/",
    "gcr/weight/",
)


def train(folder: str, timesteps: int) -> None:
    """Train with a CSV log in the folder."""
    env = VecNormalize(
        make_vec_env("HalfCheetah-v5", n_envs=8, seed=0, wrapper_class=RewardDecomposition)
    )
    model = GCRPPO("MlpPolicy", env, n_steps=256, seed=0, device="cpu")
    model.set_logger(configure(folder, ["csv"]))
    model.learn(timesteps)
    model.logger.close()


def main() -> None:
    """Train, and keep the columns that the page shows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--timesteps", type=int, default=100_000)
    parser.add_argument("--out", type=Path, default=Path("docs/data/halfcheetah.csv"))
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        train(folder, arguments.timesteps)
        keep(Path(folder) / "progress.csv", arguments.out)


def keep(log: Path, out: Path) -> None:
    """Copy the columns of ``KEPT``, sorted, with six digits."""
    with log.open(newline="") as file:
        rows = list(csv.DictReader(file))
    keys = sorted(key for key in rows[0] if key.startswith(KEPT))
    with out.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(keys)
        for row in rows:
            writer.writerow([f"{float(row[key]):.6g}" if row[key] else "" for key in keys])


if __name__ == "__main__":
    main()

"""Train GCRPPO on a MuJoCo env whose reward has several terms, and look at what each term got:
``make train``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import gymnasium as gym
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gcr import GCRPPO, RESOLVERS, RewardDecomposition
from sb3_gcr.logs.report import write_report


def train(env_id: str, timesteps: int, seed: int, resolver: str, folder: Path) -> None:
    """Train, save, and write the report."""
    env = make_vec_env(env_id, n_envs=8, seed=seed, wrapper_class=RewardDecomposition)
    env = VecNormalize(env)
    model = GCRPPO("MlpPolicy", env, n_steps=256, resolver=resolver, seed=seed, device="cpu")
    model.set_logger(configure(str(folder), ["csv", "tensorboard"]))
    model.learn(timesteps, progress_bar=True)
    model.save(folder / "model")
    env.save(str(folder / "vecnormalize.pkl"))
    report = write_report(folder, model.reward_spec)
    print(report.table)
    print(f"model           {folder / 'model.zip'} with {folder / 'vecnormalize.pkl'}")
    print(f"TensorBoard log tensorboard --logdir {folder}")
    for picture in report.pictures:
        print(f"picture         {picture}")


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="Humanoid-v5", help="an env whose reward terms are known")
    parser.add_argument("--timesteps", type=int, default=250_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resolver", default="gcr", choices=sorted(RESOLVERS))
    parser.add_argument(
        "--folder", type=Path, default=Path("logs"), help="a folder for this run is made in it"
    )
    arguments = parser.parse_args()
    name = f"{arguments.env}-{arguments.resolver}-seed{arguments.seed}"
    runs = [0, *(int(path.name.rsplit("_", 1)[1]) for path in arguments.folder.glob(f"{name}_*"))]
    folder = arguments.folder / f"{name}_{max(runs) + 1}"
    print(
        f"GCRPPO ({arguments.resolver}) on {arguments.env}, {arguments.timesteps:,} steps, seed "
        f"{arguments.seed}"
    )
    try:
        train(arguments.env, arguments.timesteps, arguments.seed, arguments.resolver, folder)
    except (ValueError, gym.error.Error) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()

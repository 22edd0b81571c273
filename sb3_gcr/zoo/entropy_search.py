"""The paper's search for the entropy coefficient, as a command of rl-zoo3.

It needs rl-zoo3, so it is imported where that is known to be installed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from rl_zoo3 import ALGOS, exp_manager
from stable_baselines3.common.utils import set_random_seed

from sb3_gcr.zoo.managers import ZooManager
from sb3_gcr.zoo.patches import patched

#: Values of the entropy coefficient, and the seeds of each.
ENTROPY_GRID: dict[str, Sequence[Any]] = {
    "ent_coef": np.geomspace(1e-4, 0.03, 10).tolist(),
    "seed": [0, 1, 2],
}


class EntropyManager(ZooManager):
    """Gives each entropy coefficient of the grid several seeds and half the budget."""

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        is_given = self.n_timesteps > 0
        result = super()._preprocess_hyperparams(hyperparams)
        self.n_timesteps = self.n_timesteps if is_given else self.n_timesteps // 2
        return result

    def _create_sampler(self, sampler_method: str) -> optuna.samplers.BaseSampler:
        return optuna.samplers.GridSampler(ENTROPY_GRID)

    def objective(self, trial: optuna.Trial) -> float:
        """Train and evaluate once, with the trial's coefficient and seed.

        :param trial: Optuna's
        """
        self.study, algorithm = trial.study, ALGOS[self.algo]
        if self.study.sampler.is_exhausted(self.study):  # type: ignore[union-attr]
            self.study.stop()
            raise optuna.TrialPruned
        values, seeds = ENTROPY_GRID["ent_coef"], ENTROPY_GRID["seed"]
        chosen = {"ent_coef": trial.suggest_float("ent_coef", values[0], values[-1], log=True)}
        self.seed = trial.suggest_int("seed", seeds[0], seeds[-1])
        set_random_seed(self.seed)
        seeded = {self.algo: lambda **kwargs: algorithm(**{**kwargs, "seed": self.seed})}
        with (
            patched(exp_manager, "HYPERPARAMS_SAMPLER", {self.algo: lambda *_: chosen}),
            patched(exp_manager, "ALGOS", seeded),
        ):
            return super().objective(trial)

    def hyperparameters_optimization(self) -> None:
        """Search, and print the table."""
        super().hyperparameters_optimization()
        sys.stdout.write(entropy_table(self.study))


def entropy_table(study: optuna.Study) -> str:
    """The mean return of each entropy coefficient, and the best of those that have all seeds."""
    returns: dict[float, dict[int, float]] = {value: {} for value in ENTROPY_GRID["ent_coef"]}
    for trial in study.trials:
        if trial.state.name == "COMPLETE" and trial.value is not None:
            returns[trial.params["ent_coef"]][trial.params["seed"]] = trial.value
    means = {value: sum(found.values()) / len(found) for value, found in returns.items() if found}
    lines = ["  ent_coef        return  seeds"]
    lines += [
        f"{value:10.6f}  {mean:12.2f}  {len(returns[value]):5}" for value, mean in means.items()
    ]
    whole = [value for value in means if len(returns[value]) == len(ENTROPY_GRID["seed"])]
    if whole:
        lines.append(f"Best entropy coefficient: {max(whole, key=means.__getitem__):.6f}")
    return "\n".join(lines) + "\n"


def entropy_arguments(program: str, arguments: list[str]) -> list[str]:
    """What ``rl_zoo3.train`` needs to search the entropy coefficient."""
    parser = argparse.ArgumentParser(
        allow_abbrev=False,
        description=(
            "Search the entropy coefficient as the paper does: 10 values from 1e-4 to 0.03, 3 "
            "seeds each, half the budget. Several machines can take part: start the same command "
            "on each."
        ),
        epilog=(
            f"All other options are those of `{program} train`; with `-n` the budget of each run "
            "is as given."
        ),
    )
    parser.add_argument("--algo", required=True, help="one study per algorithm")
    parser.add_argument("--env", required=True, help="and per env")
    parser.add_argument(
        "-f", "--log-folder", default="logs", help="where the report goes (default: logs)"
    )
    parser.add_argument(
        "--storage",
        help="of Optuna: a .log file or a database (default: entropy.log in the log folder)",
    )
    parser.add_argument("--study-name", help="(default: entropy-ALGO-ENV)")
    parser.add_argument(
        "--n-jobs", type=int, choices=[1], help="1: start the command several times instead"
    )
    options, rest = parser.parse_known_args(arguments)
    storage = options.storage or str(Path(options.log_folder) / "entropy.log")
    study = options.study_name or f"entropy-{options.algo}-{options.env}"
    return [
        *("-optimize", "--algo", options.algo, "--env", options.env, "-f", options.log_folder),
        *(
            "--storage",
            storage,
            "--study-name",
            study,
            "--pruner",
            "none",
            "--n-evaluations",
            "1",
            "--eval-episodes",
            "20",
        ),
        *rest,
    ]

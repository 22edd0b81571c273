"""The table of the README: PPO, and GCRPPO in five settings, on Humanoid-v5 with several seeds.

Runs that are in the folder already are not repeated, so it goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from tqdm import tqdm

from sb3_gcr import GCRPPO, RewardDecomposition, evaluate_components
from sb3_gcr.logs.shown import format_table
from sb3_gcr.study.statistics import holm, mean_interval, welch

#: Arguments by the name in the table; all else is equal.
METHODS: dict[str, dict[str, Any]] = {
    "PPO": {},
    "sum": {"resolver": "sum"},
    "levels": {"resolver": "levels"},
    "gcr": {"resolver": "gcr"},
    "sum component": {"resolver": "sum", "surrogate_clipping": "component"},
}
ENV = "Humanoid-v5"
TIMESTEPS = 200_000
N_EVAL_EPISODES = 20
#: Marks of a page between which the tables stand.
START = "<!-- tables of examples/humanoid_table.py -->"
END = "<!-- end of the tables -->"
RESULTS = Path(__file__).parents[1] / "results" / "humanoid"


class Speed(BaseCallback):
    """The mean return of the last episodes after each rollout: its mean is the learning speed."""

    def _on_training_start(self) -> None:
        self.returns: list[float] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        if self.model.ep_info_buffer:
            returns = [episode["r"] for episode in self.model.ep_info_buffer]
            self.returns.append(float(np.mean(returns)))


def run(method: str, seed: int) -> dict[str, Any]:
    """Train one method with one seed, and evaluate the deterministic policy.

    :param method: a key of ``METHODS``
    :param seed: of everything; the evaluation's is 1000 more
    """
    env = VecNormalize(make_vec_env(ENV, 8, seed=seed, wrapper_class=RewardDecomposition))
    algorithm = PPO if method == "PPO" else GCRPPO
    model = algorithm("MlpPolicy", env, n_steps=256, seed=seed, device="cpu", **METHODS[method])
    speed = Speed()
    model.learn(TIMESTEPS, callback=speed)
    evaluation_env = make_vec_env(ENV, 4, seed=1000 + seed, wrapper_class=RewardDecomposition)
    normalised = VecNormalize(evaluation_env, training=False, norm_reward=False)
    normalised.obs_rms = env.obs_rms
    returns, _, terms = evaluate_components(  # type: ignore[misc]
        model, normalised, N_EVAL_EPISODES, return_episode_rewards=True
    )
    final = {"return": float(np.mean(returns))}
    final |= {name: float(np.mean(values)) for name, values in terms.items()}  # type: ignore[attr-defined]
    return {
        "method": method,
        "seed": seed,
        "during training": float(np.mean(speed.returns)),
        "final": final,
    }


def stored(folder: Path) -> list[dict[str, Any]]:
    """The runs in a folder, in the order of their names."""
    return [json.loads(path.read_text()) for path in sorted(folder.glob("*-*.json"))]


def rows_of(results: list[dict[str, Any]]) -> list[list[str]]:
    """One row per method: learning speed and final return, with p values against PPO, and terms."""
    runs = {name: [row for row in results if row["method"] == name] for name in METHODS}
    training = {name: [row["during training"] for row in rows] for name, rows in runs.items()}
    final = {name: [row["final"]["return"] for row in rows] for name, rows in runs.items()}
    p_training, p_final = p_values(training), p_values(final)
    terms = [key for key in results[0]["final"] if key != "return"]
    head = ["method", "", "seeds", "return in training", "minus PPO, %", "p", "final return", "p"]
    table_rows = [[*head, *terms]]
    for name, cells in runs.items():
        gap = "" if name == "PPO" else percent(training["PPO"], training[name])
        row = [name, "", str(len(cells)), interval(training[name]), gap]
        row += [p_training.get(name, ""), interval(final[name]), p_final.get(name, "")]
        row += [interval([cell["final"][term] for cell in cells]) for term in terms]
        table_rows.append(row)
    return table_rows


def markdown(rows: list[list[str]]) -> str:
    """The rows as two tables for a page, whole returns and terms, neither too wide for it."""
    tables = []
    for columns in (slice(2, 8), slice(8, None)):
        head, *others = ([row[0], *row[columns]] for row in rows)
        lines = [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *others)]
        tables.append("\n".join(lines).replace(" -", " −").replace(" −--", " ---"))
    return "\n\n".join(tables)


def write(page: Path, tables: str) -> None:
    """Put the tables between the marks of a page.

    :raises ValueError: if the page has no marks
    """
    before, start, rest = page.read_text(encoding="utf-8").partition(START)
    _, end, after = rest.partition(END)
    if not end:
        raise ValueError(f"{page} must have {START!r} and {END!r}, between which the tables go.")
    page.write_text(f"{before}{start}\n\n{tables}\n\n{end}{after}", encoding="utf-8")


def p_values(samples: dict[str, list[float]]) -> dict[str, str]:
    """Two-sided Welch tests of every method against PPO, Holm-corrected, as text by method."""
    others = [name for name in samples if name != "PPO"]
    corrected = holm([welch(samples["PPO"], samples[name]).p for name in others])
    texts = [f"{p:.2f}" if p >= 0.01 else "< 0.01" for p in corrected]
    return dict(zip(others, texts, strict=True))


def interval(values: list[float]) -> str:
    """Mean and half the width of its 95 % confidence interval over seeds."""
    found = mean_interval(values)
    return f"{found.estimate:.0f} ± {(found.high - found.low) / 2:.0f}"


def percent(a: list[float], b: list[float]) -> str:
    """Welch's 95 % interval of the relative difference b - a in per cent."""
    found = welch(a, b, relative=True)
    return f"{100 * found.low:+.0f} to {100 * found.high:+.0f}"


def main() -> None:
    """Make the runs that are missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--folder", type=Path, default=RESULTS, help="of the runs' results")
    parser.add_argument(
        "--write", type=Path, nargs="*", default=[], metavar="PAGE", help="put the tables there"
    )
    parser.add_argument("--no-runs", action="store_true", help="of what is in the folder already")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    th.set_num_threads(1)
    jobs = [(method, seed) for seed in range(arguments.seeds) for method in METHODS]
    if arguments.no_runs:
        jobs = []
    for method, seed in tqdm(jobs, unit="run"):
        path = arguments.folder / f"{method.replace(' ', '_')}-{seed}.json"
        if not path.exists():
            partial = path.with_suffix(".partial")
            partial.write_text(json.dumps(run(method, seed), indent=1) + "\n")
            os.replace(partial, path)
    rows = rows_of(stored(arguments.folder))
    print(format_table(rows))
    for page in arguments.write:
        write(page, markdown(rows))


if __name__ == "__main__":
    main()

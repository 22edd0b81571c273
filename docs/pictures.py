"""The pictures that can be drawn from what is stored here: ``python docs/pictures.py``, seconds.

The others need more. ``returns``, ``conflicts`` and ``cosines`` are those of ``make train``; frames
and curves of the trained robots are made by ``examples/show.py`` (docs/tasks.md has the commands).
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from sb3_gcr import RESOLVERS, RewardSpec
from sb3_gcr.logs.shown import cosine_figure

IMAGES = Path(__file__).parent / "images"
#: Of ``python -m benchmarks.conflicts measure``.
NOISE = Path(__file__).parent / "data" / "conflicts.json"
#: The log of a training on HalfCheetah, made by ``examples/cheetah.py``.
CHEETAH = Path(__file__).parent / "data" / "halfcheetah.csv"
#: The runs of ``examples/humanoid_table.py``, and its methods.
HUMANOID = Path(__file__).parents[1] / "results" / "humanoid"
METHODS = ("PPO", "sum", "levels", "gcr", "sum component")
#: Two tasks that conflict, and a regulariser against both.
GRADIENTS = np.array([[1.0, 0.0], [-0.6, 0.8], [-3.0, -3.0]])
LEVELS = np.array([0, 0, 1])
#: Pairs of HumanoidRun in the picture of noise.
NOISE_PAIRS = (
    ("alive", "joint_pos_limits"),
    ("progress", "joint_pos_limits"),
    ("progress", "action_l2"),
)
BLUE, ORANGE, GREY, RED = "#1f6fb4", "#d9730d", "#8a8a8a", "#b3261e"


def all_steps(resolver: str) -> list[NDArray[np.float64]]:
    """The different steps that a resolver takes in the example, over the random orders of its
    projections.
    """
    draws = [
        RESOLVERS[resolver](GRADIENTS @ GRADIENTS.T, LEVELS, np.random.default_rng(seed))
        @ GRADIENTS
        for seed in range(50)
    ]
    return [np.array(step) for step in sorted({tuple(np.round(step, 6)) for step in draws})]


def arrow(
    axis: Axes, vector: NDArray[np.float64], colour: str, label: str, width: float = 1.6
) -> None:
    """A vector from the origin, with its name beside the tip."""
    axis.annotate(
        "",
        xy=tuple(vector),
        xytext=(0, 0),
        arrowprops={"arrowstyle": "-|>", "color": colour, "lw": width},
    )
    away = vector + 0.2 * vector / np.linalg.norm(vector)
    axis.text(away[0], away[1], label, color=colour, ha="center", va="center", fontsize=10)


def counterexample() -> Figure:
    """Where the steps of three resolvers lead when two tasks conflict."""
    figure = Figure(figsize=(6.6, 6.2), layout="constrained")  # two rows: legible on a phone
    axes = figure.subplots(2, 2).flat
    for axis, resolver in zip(axes, ("sum", "gcr", "levels", "guaranteed"), strict=True):
        # No task gets worse where both inner products are >= 0: between the directions (0, 1) and
        # (0.8, 0.6).
        axis.add_patch(Polygon([(0, 0), (0, 9), (12, 9)], color="#bfe3c6", zorder=0))
        arrow(axis, GRADIENTS[0], BLUE, "$t_1$")
        arrow(axis, GRADIENTS[1], BLUE, "$t_2$")
        arrow(axis, GRADIENTS[2], GREY, "$r$")
        for step in all_steps(resolver):
            arrow(axis, step, RED, "", 2.8)
            worse = [f"t_{i + 1}" for i in range(2) if step @ GRADIENTS[i] < 0]
            harm = f"against ${', '.join(worse)}$" if worse else "no task\ngets worse"
            x, y = (-1.5, -0.9) if resolver == "sum" else step
            side, gap = ("left", 0.12) if x > 0 else ("right", -0.12)
            axis.text(
                x + gap,
                y,
                f"({step[0]:.2f}, {step[1]:.2f})\n{harm}",
                color=RED,
                ha=side,
                va="center",
                fontsize=9,
            )
        axis.set_title(f'resolver="{resolver}"', family="monospace", fontsize=11)
        axis.set(
            xlim=(-3.6, 2.6),
            ylim=(-3.5, 2.1),
            aspect="equal",
            xticks=range(-3, 3),
            yticks=range(-3, 3),
        )
        axis.axhline(0, color="#cccccc", lw=0.8, zorder=0.5)
        axis.axvline(0, color="#cccccc", lw=0.8, zorder=0.5)
    return figure


def clipping() -> Figure:
    """Surrogate of one sample with two advantages of opposite sign, against its ratio."""
    ratio = np.linspace(0.6, 1.6, 401)
    advantages = np.array([2.0, -1.0])
    clipped = ratio.clip(0.8, 1.2)
    by_component = np.minimum(ratio * advantages[:, None], clipped * advantages[:, None])
    total = advantages.sum()
    is_clipped = ratio * total > clipped * total
    jointly = np.where(is_clipped, clipped, ratio) * advantages[:, None]
    figure = Figure(figsize=(6.6, 3.2), layout="constrained")
    panels = {"component by component": by_component, "one clip per sample": jointly}
    for axis, (title, surrogates) in zip(
        figure.subplots(1, 2, sharey=True), panels.items(), strict=True
    ):
        axis.axvspan(0.8, 1.2, color="#e8f1e9", zorder=0)
        for surrogate, advantage, colour in zip(
            surrogates, advantages, (BLUE, ORANGE), strict=True
        ):
            axis.plot(ratio, surrogate, color=colour, label=f"advantage {advantage:+.0f}")
        axis.plot(ratio, surrogates.sum(0), color=RED, lw=2.8, label="their sum")
        axis.set(title=title, xlabel="ratio ρ")
        axis.grid(alpha=0.3)
    axes = figure.axes
    axes[0].set_ylabel("surrogate of one sample")
    axes[0].annotate(
        "pushes back",
        xy=(1.45, 0.95),
        xytext=(1.25, 1.9),
        color=RED,
        arrowprops={"arrowstyle": "->", "color": RED},
    )
    axes[1].annotate(
        "PPO's: flat",
        xy=(1.45, 1.2),
        xytext=(1.25, 1.9),
        color=RED,
        arrowprops={"arrowstyle": "->", "color": RED},
    )
    axes[1].legend(loc="center right", fontsize=9)
    return figure


def conflict() -> Figure:
    """Four panels of a training's log, as TensorBoard shows them."""
    with CHEETAH.open(newline="") as file:
        log = list(csv.DictReader(file))
    panels = {
        "rollout/ep_rew/<name>": ["rollout/ep_rew/reward_forward", "rollout/ep_rew/reward_ctrl"],
        "gcr/conflict_rate": ["gcr/conflict_rate"],
        "gcr/grad_norm/<name>": ["gcr/grad_norm/reward_forward", "gcr/grad_norm/reward_ctrl"],
        "gcr/weight/<name>": ["gcr/weight/reward_forward", "gcr/weight/reward_ctrl"],
    }
    figure = Figure(figsize=(6.6, 4.8), layout="constrained")
    for axis, (title, keys) in zip(figure.subplots(2, 2).flat, panels.items(), strict=True):
        for key in keys:
            rows = [row for row in log if row[key]]
            name = key.rsplit("/", 1)[1]
            colour = {"reward_forward": BLUE, "reward_ctrl": ORANGE}.get(name, GREY)
            axis.plot(
                [float(row["time/total_timesteps"]) for row in rows],
                [float(row[key]) for row in rows],
                color=colour,
                label=name,
            )
        axis.set_title(title, loc="left", family="monospace", fontsize=10)
        axis.grid(alpha=0.3)
        axis.xaxis.set_major_formatter(lambda steps, _: f"{steps / 1000:.0f}k")
        if len(keys) > 1:
            axis.legend(fontsize=9)
        else:
            axis.set_ylim(0, 1)
    return figure


def noise(pairs: Sequence[tuple[str, str]] = NOISE_PAIRS) -> Figure:
    """Cosines within minibatches over their size, against those of independent rollouts.

    :param pairs: names of the terms, one panel each
    """
    data = json.loads(NOISE.read_text())
    figure = Figure(figsize=(10.5, 3.4), layout="constrained")
    sizes = [int(size) for size in data["minibatches"]]
    for axis, pair in zip(figure.subplots(1, len(pairs), sharey=True), pairs, strict=True):
        i, j = (data["names"].index(name) for name in pair)
        of_size = {
            key: [numbers[key][i][j] for numbers in data["minibatches"].values()]
            for key in ("naive", "low", "high", "unbiased")
        }
        truth, z = data["cosines"][i][j], data["z"][i][j]
        axis.fill_between(sizes, of_size["low"], of_size["high"], color=ORANGE, alpha=0.2, lw=0)
        axis.plot(sizes, of_size["naive"], "o-", color=ORANGE, label="within a minibatch, mean")
        unbiased = np.array(of_size["unbiased"], dtype=float).clip(-1, 1)
        axis.plot(sizes, unbiased, "s--", color=BLUE, label="different samples only, all together")
        axis.axhline(truth, color=RED, lw=2, label="different rollouts")
        axis.axhline(0, color=GREY, lw=0.8)
        axis.set_xscale("log", base=2)
        axis.set_xticks(sizes, [str(size) for size in sizes])
        axis.set(xlabel="samples in a minibatch", ylim=(-1.05, 1.05))
        axis.set_title(f"{pair[0]}, {pair[1]}\n{truth:+.2f}, z = {z:+.1f}", fontsize=10)
        axis.grid(alpha=0.3)
    figure.axes[0].set_ylabel("cosine between gradients")
    figure.axes[-1].legend(fontsize=8, loc="upper right")
    return figure


def results() -> Figure:
    """One dot per seed and method on Humanoid-v5, and the means."""
    runs = [json.loads(path.read_text()) for path in sorted(HUMANOID.glob("*-*.json"))]
    figure = Figure(figsize=(6.6, 3.0), layout="constrained")
    training, final = figure.subplots(1, 2, sharey=True)
    for place, method in enumerate(METHODS):
        own = [run for run in runs if run["method"] == method]
        colour = GREY if method == "PPO" else BLUE
        dots(training, place, [run["during training"] for run in own], colour)
        dots(final, place, [run["final"]["return"] for run in own], colour)
    training.set_title("return in training", loc="left", fontsize=11)
    final.set_title("final return", loc="left", fontsize=11)
    training.set_yticks(range(len(METHODS)), METHODS, family="monospace")
    training.invert_yaxis()
    return figure


def dots(axis: Axes, place: int, values: list[float], colour: str) -> None:
    """One row of dots, with a stroke at their mean."""
    axis.plot(values, [place] * len(values), "o", color=colour, alpha=0.6)
    axis.plot(np.mean(values), place, "|", color=RED, ms=18, mew=2.5)
    axis.grid(axis="x", alpha=0.3)


#: What draws each picture, by the name of its file.
def humanoid_conflicts() -> Figure:
    """Cosines of HumanoidRun's seven terms as minibatches of 64 show them, and as they are."""
    data = json.loads(NOISE.read_text())
    spec = RewardSpec(tuple(data["names"]), (0, 0, 0, 0, 1, 1, 1))
    within = np.array(data["minibatches"]["64"]["naive"], dtype=float)
    between = np.array(data["cosines"], dtype=float)
    matrices = {"within minibatches of 64": within, "between independent rollouts": between}
    return cosine_figure(spec, matrices)


PICTURES = {
    "humanoid_conflicts": humanoid_conflicts,
    "clipping": clipping,
    "counterexample": counterexample,
    "conflict": conflict,
    "noise": noise,
    "humanoid_results": results,
}


def main() -> None:
    """Make all pictures, or those that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(PICTURES)} (all)")
    arguments = parser.parse_args()
    unknown = sorted(set(arguments.names) - set(PICTURES))
    if unknown:
        parser.error(f"Names must be among {list(PICTURES)}, found {unknown}.")
    for name in arguments.names or PICTURES:
        PICTURES[name]().savefig(IMAGES / f"{name}.png", dpi=130)


if __name__ == "__main__":
    main()

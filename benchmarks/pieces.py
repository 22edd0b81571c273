"""Where the time of a minibatch goes: each part of GCRPPO's update repeated alone; ``python -m
benchmarks.pieces``.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch as th

from benchmarks.rollouts import Setting, evaluate, fill_buffer, make_model, make_rollout
from benchmarks.updates import LARGE_2048, SMALL, SMALL_256
from sb3_gcr import GCRPPO, RESOLVERS
from sb3_gcr.gradients.by_hand import ByHand
from sb3_gcr.logs.shown import format_table
from sb3_gcr.losses import Clip, surrogate_cotangents, value_cotangents

SETTINGS = [(SMALL, 4), (SMALL, 20), (SMALL_256, 10), (LARGE_2048, 10)]
ROUNDS = 7


def microseconds(part: Callable[[], object], seconds: float = 0.1) -> float:
    """Median time of one call."""
    part()
    start = time.perf_counter()
    part()
    calls = max(1, int(seconds / max(time.perf_counter() - start, 1e-6)))
    rounds = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        for _ in range(calls):
            part()
        rounds.append((time.perf_counter() - start) / calls)
    return 1e6 * float(np.median(rounds))


@th.no_grad()
def pieces(setting: Setting, n_components: int) -> dict[str, float]:
    """Time of each part of a minibatch, by name."""
    model = make_model(GCRPPO, setting, n_components)
    rollout = make_rollout(setting, n_components)
    fill_buffer(model.rollout_buffer, rollout, *evaluate(model.policy, rollout))
    batch = next(iter(model.rollout_buffer.get(setting.batch_size)))
    networks = ByHand(model.policy, setting.batch_size)
    values, log_prob = networks.evaluate(batch.observations, batch.actions)
    old_values, returns = networks.array(batch.old_values), networks.array(batch.returns)
    arguments = (
        networks.array(batch.old_log_prob),
        networks.array(batch.advantages),
        Clip(0.2, None),
    )
    cotangents = surrogate_cotangents(log_prob, *arguments)
    value_gradients = value_cotangents(values, old_values, returns, None)
    gramian = np.asarray(networks.gramian(cotangents), dtype=float)
    levels, rng = np.array(model.reward_spec.levels), np.random.default_rng(0)

    ones = np.ones(n_components)

    def derivatives() -> None:
        surrogate_cotangents(log_prob, *arguments)
        value_cotangents(values, old_values, returns, None)

    networks.backward(cotangents, ones, value_gradients, 0.0)
    model.policy.optimizer.step()
    n_batches = setting.n_samples // setting.batch_size
    with networks.session():
        return {
            "minibatch from the rollout": microseconds(
                lambda: list(model.rollout_buffer.get(setting.batch_size))
            )
            / n_batches,
            "forward pass": microseconds(
                lambda: networks.evaluate(batch.observations, batch.actions)
            ),
            "derivatives of the losses": microseconds(derivatives),
            "signals and Gramian": microseconds(lambda: networks.gramian(cotangents)),
            "resolver": microseconds(lambda: RESOLVERS["gcr"](gramian, levels, rng)),
            "backward pass": microseconds(
                lambda: networks.backward(cotangents, ones, value_gradients, 0.0)
            ),
            "norm and clip": microseconds(lambda: networks.clip_gradients(0.5)),
            "Adam": microseconds(model.policy.optimizer.step),
        }


def main() -> None:
    """Print one column per setting."""
    th.set_num_threads(1)
    columns = [pieces(setting, k) for setting, k in SETTINGS]
    rows = [["part, µs", "", *(f"{setting} K={k}" for setting, k in SETTINGS)]]
    rows += [[name, "", *(f"{column[name]:.0f}" for column in columns)] for name in columns[0]]
    print(format_table(rows))


if __name__ == "__main__":
    main()

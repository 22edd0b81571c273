"""Rows of one update of a recurrent policy: ``train()`` on the same synthetic rollout, with the
default LSTM of sb3-contrib.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.measuring import Case, Contestant
from benchmarks.rollouts import SEED, StubEnv, mixed_signals
from benchmarks.rollouts import Setting as Shapes

N_COMPONENTS = 4
N_ENVS = 8
#: Of the state that a sequence goes on from.
STATE_SCALE = 0.1


@dataclass(frozen=True)
class Setting:
    """Sizes of an update; ``episode`` is the length of an episode, None where none begins inside
    the rollout, sb3-contrib's fast case.
    """

    n_steps: int
    batch_size: int
    episode: int | None = None

    def __str__(self) -> str:
        episodes = f", episodes of {self.episode}" if self.episode else ""
        return f"LSTM 256, {N_ENVS} envs × {self.n_steps}, B={self.batch_size}{episodes}"


def make_model(algorithm: Callable[..., Any], setting: Setting, **kwargs: Any) -> Any:
    """A model on an env that has spaces and names only."""
    n_components = N_COMPONENTS if "resolver" in kwargs else 1
    stub: Callable[[], gym.Env[Any, Any]] = partial(
        StubEnv, Shapes((64, 64), setting.batch_size, obs_size=45), n_components
    )
    model = algorithm(
        "MlpLstmPolicy",
        DummyVecEnv([stub] * N_ENVS),
        n_steps=setting.n_steps,
        batch_size=setting.batch_size,
        n_epochs=2,
        seed=SEED,
        device="cpu",
        **kwargs,
    )
    model.set_logger(configure(None, []))
    return model


def fill_buffer(buffer: Any, setting: Setting) -> None:
    """The same rollout for every algorithm, but for the sum over the components."""
    rng = np.random.default_rng(SEED)
    buffer.reset()
    n_steps, n_envs = setting.n_steps, N_ENVS
    buffer.observations[...] = rng.standard_normal(buffer.observations.shape)
    buffer.actions[...] = rng.standard_normal(buffer.actions.shape)
    signals = mixed_signals(n_steps * n_envs, N_COMPONENTS, rng).reshape(n_steps, n_envs, -1)
    if buffer.advantages.ndim == 2:
        signals = signals.sum(-1)
    buffer.advantages[...] = signals
    buffer.returns[...] = signals
    buffer.log_probs[...] = -1.4 * buffer.actions.shape[-1]
    for name in ("hidden_states_pi", "cell_states_pi", "hidden_states_vf", "cell_states_vf"):
        states = getattr(buffer, name)
        states[...] = STATE_SCALE * rng.standard_normal(states.shape, np.float32)
    if setting.episode:
        buffer.episode_starts[:: setting.episode] = 1.0
    buffer.pos, buffer.full = buffer.buffer_size, True


def update(
    label: str, algorithm: Callable[..., Any], setting: Setting, **kwargs: Any
) -> Contestant:
    """``train()``, always from the same weights, in seconds of this process's CPU."""
    model = make_model(algorithm, setting, **kwargs)
    weights = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}

    def measure() -> float:
        model.policy.load_state_dict(weights)
        fill_buffer(model.rollout_buffer, setting)
        np.random.seed(SEED)
        start = time.process_time()
        model.train()
        return time.process_time() - start

    def conflict_rate() -> float | None:
        rate = model.logger.name_to_value.get("gcr/conflict_rate")
        return None if rate is None else float(rate)

    return Contestant(label, measure, conflict_rate)


def recurrent_ppo(setting: Setting) -> Contestant:
    """sb3-contrib's RecurrentPPO on the summed reward."""
    from sb3_contrib import RecurrentPPO

    return update("RecurrentPPO", RecurrentPPO, setting)


def recurrent_gcrppo(setting: Setting, share: float | None = None) -> Contestant:
    """RecurrentGCRPPO, exact or with a Gramian from a share of each minibatch."""
    from sb3_gcr.recurrent import RecurrentGCRPPO

    n_samples = None if share is None else int(share * setting.batch_size)
    note = "" if n_samples is None else f" gramian_samples={n_samples}"
    label = f"RecurrentGCRPPO K={N_COMPONENTS}{note}"
    return update(label, RecurrentGCRPPO, setting, resolver="gcr", gramian_samples=n_samples)


#: Setting and the bars of the exact update and of that with a quarter of the samples.
SETTINGS: list[tuple[Setting, float | None, float | None]] = [
    (Setting(128, 128), 2.5, None),  # one or two sequences: no quarter of them
    (Setting(128, 1024), 2.5, 1.6),
    (Setting(32, 256), 2.5, None),
    (Setting(128, 128, episode=50), None, None),
    (Setting(128, 1024, episode=50), None, None),
]


def cases() -> list[Case]:
    """All rows of this group."""
    return [
        Case(
            "recurrent",
            str(setting),
            partial(recurrent_gcrppo, setting, share),
            partial(recurrent_ppo, setting),
            bar,
            needs=("sb3_contrib",),
        )
        for setting, exact_bar, quarter_bar in SETTINGS
        for share, bar in ((None, exact_bar), (0.25, quarter_bar))
    ]

"""``sbx.PPO``, scalar PPO compiled by JAX, on the same rollout; sbx is imported when it is needed,
because it is optional.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from benchmarks.measuring import Contestant, timed
from benchmarks.rollouts import SEED, Array, Rollout, Setting, fill_buffer, make_model, make_rollout


def sbx_ppo() -> Any:
    """The class ``sbx.PPO``."""
    return importlib.import_module("sbx").PPO


def sbx_update(setting: Setting, n_components: int) -> Contestant:
    """``train()`` of ``sbx.PPO`` on the summed advantages, always from the same weights, with the
    same minibatches.

    sbx keeps weights and optimiser in two immutable flax ``TrainState`` of its policy,
    ``actor_state`` and ``vf_state``.
    """
    jax = importlib.import_module("jax")
    model = make_model(sbx_ppo(), setting, n_components)
    policy = model.policy
    rollout = make_rollout(setting, n_components)
    states = policy.actor_state, policy.vf_state
    values, log_probs = _evaluate(states, rollout)

    def prepare() -> None:
        policy.actor_state, policy.vf_state = states
        fill_buffer(model.rollout_buffer, rollout, values, log_probs)
        np.random.seed(SEED)

    def run() -> None:
        model.train()
        # JAX returns before it has computed.
        jax.block_until_ready((policy.actor_state, policy.vf_state))

    return Contestant("sbx.PPO", timed(run, prepare))


def _evaluate(states: tuple[Any, Any], rollout: Rollout) -> tuple[Array, Array]:
    actor, critic = states
    log_probs = actor.apply_fn(actor.params, rollout.observations).log_prob(rollout.actions)
    return np.asarray(critic.apply_fn(critic.params, rollout.observations)), np.asarray(log_probs)

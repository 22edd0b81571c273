"""From a rollout to the minibatches of an update: cast, normalised, in the update's arrays."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer

from sb3_gcr.advantages import normalize_jointly
from sb3_gcr.gradients import ActorCritic
from sb3_gcr.gradients.memory import Array

#: Over what advantages can be normalised.
SCOPES = ("rollout", "minibatch")


class Minibatch(NamedTuple):
    """B samples of a rollout as the update takes them; K components."""

    observations: Any  # what the actor-critic evaluates: (B, …), or sequences
    actions: th.Tensor  # (B, …), or those of the sequences
    old_log_prob: Array  # log π_old(a|s), (B,)
    old_values: Array  # (B, K)
    returns: Array  # Ĝ, (B, K)
    advantages: Array  # Â, (B, K)
    kappa: float  # κ, or an array of one


class Normalisation(NamedTuple):
    """How the advantages of an update are normalised."""

    scope: str | None
    """"rollout", "minibatch" or None."""
    kappa_max: float
    """Bound of κ · max_k std(A^(k))."""
    kappa: float = 1.0
    """κ of the rollout, once it has been normalised."""

    def of_rollout(self, buffer: RolloutBuffer) -> Normalisation:
        """Normalise the whole rollout in its buffer, if that is the scope; with its κ.

        :param buffer: advantages of shape (T, N, K)
        """
        if self.scope != "rollout":
            return self
        buffer.advantages, kappa = normalize_jointly(buffer.advantages, kappa_max=self.kappa_max)
        return self._replace(kappa=kappa)

    def of_minibatch(self, advantages: Array) -> tuple[Array, float]:
        """Â and κ of a minibatch.

        :param advantages: shape (B, K)
        """
        if self.scope != "minibatch":
            return advantages, self.kappa
        return normalize_jointly(advantages, kappa_max=self.kappa_max)


def minibatches(
    buffer: RolloutBuffer,
    batch_size: int,
    normalisation: Normalisation,
    actor_critic: ActorCritic[Any],
    discrete: bool,
) -> Iterator[Minibatch]:
    """One pass over a rollout in random order.

    :param buffer: a rollout
    :param batch_size: B
    :param normalisation: of the advantages
    :param actor_critic: says what an array is
    :param discrete: whether actions are the numbers of choices
    """
    for data in buffer.get(batch_size):
        advantages, kappa = normalisation.of_minibatch(actor_critic.array(data.advantages))
        yield Minibatch(
            observations=data.observations,
            actions=data.actions.long().flatten() if discrete else data.actions,
            old_log_prob=actor_critic.array(data.old_log_prob),
            old_values=actor_critic.array(data.old_values),
            returns=actor_critic.array(data.returns),
            advantages=advantages,
            kappa=kappa,
        )


def refuse_infinite_rollout(buffer: RolloutBuffer, timestep: int) -> None:
    """Refuse a rollout with NaN or infinity, which rewards, observations or networks brought in.

    :param buffer: a rollout
    :param timestep: for the message
    :raises ValueError: names what is not finite, and in which env
    """
    observations = buffer.observations
    if isinstance(observations, dict):
        parts = {f"observations[{key!r}]": part for key, part in observations.items()}
    else:
        parts = {"observations": observations}
    for name in ("log_probs", "values", "advantages"):
        parts[name] = getattr(buffer, name)
    for name, part in parts.items():
        if np.isfinite(part).all():
            continue
        env_index = np.argwhere(~np.isfinite(part))[-1][1]  # of (T, N, …); the last is the cause
        suspects = (
            "observations and `log_std`" if name == "log_probs" else "rewards and observations"
        )
        raise ValueError(
            f"The rollout's `{name}` must be finite, found NaN or infinity for env index "
            f"{env_index} before the update at timestep {timestep}. The policy is as it was; "
            f"check {suspects}, e.g. with VecCheckNan."
        )

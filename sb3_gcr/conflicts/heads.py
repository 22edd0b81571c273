"""Value heads for a PPO that has one: fitted to a few rollouts, on the features of its critic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.utils import obs_as_tensor

from sb3_gcr.advantages import component_gae

#: Rollouts that the heads are fitted to.
FIT_ROLLOUTS = 4
#: Sweeps of fit and bootstrap; with γ = 0.99 and λ = 0.95 what is left of the start is below 3 %.
SWEEPS = 20
#: Ridge, as a share of the mean variance of a feature.
RIDGE = 1e-3

Numbers = NDArray[np.float64]


class Rollout(NamedTuple):
    """What a fit needs of T steps of N envs; F features, K terms."""

    features: Numbers  # φ(s_t), (T, N, F)
    last_features: Numbers  # φ(s_T), (N, F)
    rewards: Numbers  # (T, N, K)
    episode_starts: Numbers  # (T, N)
    last_dones: NDArray[np.bool_]  # (N,)


class Heads(NamedTuple):
    """Linear value heads V(s) = φ(s) W + b."""

    weights: Numbers  # W, (F, K)
    offsets: Numbers  # b, (K,)

    def values(self, features: Numbers) -> Numbers:
        """V, shape (..., K).

        :param features: φ, shape (..., F)
        """
        return np.asarray(features @ self.weights + self.offsets)


def fit_heads(rollouts: list[Rollout], gamma: float, gae_lambda: float) -> Heads:
    """Heads that are the ridge regression of their own λ-returns, by repeated sweeps from V = 0.

    :param rollouts: of the same policy
    :param gamma: γ
    :param gae_lambda: λ
    """
    features = np.concatenate([_flat(rollout.features) for rollout in rollouts])
    centre = features.mean(0)
    centred = features - centre
    covariance = centred.T @ centred / len(features)
    ridge = RIDGE * covariance.trace() / len(covariance)
    inverse = np.linalg.pinv(covariance + ridge * np.eye(len(covariance)))
    n_components = rollouts[0].rewards.shape[-1]
    heads = Heads(np.zeros((len(covariance), n_components)), np.zeros(n_components))
    for _ in range(SWEEPS):
        returns = [_flat(_returns(rollout, heads, gamma, gae_lambda)) for rollout in rollouts]
        targets = np.concatenate(returns)
        mean = targets.mean(0)
        weights = inverse @ (centred.T @ (targets - mean)) / len(features)
        heads = Heads(weights, mean - centre @ weights)
    return heads


def _flat(array: Numbers) -> Numbers:
    return array.reshape(-1, array.shape[-1])


def _returns(rollout: Rollout, heads: Heads, gamma: float, gae_lambda: float) -> Numbers:
    """Ĝ = A + V, shape (T, N, K)."""
    values = heads.values(rollout.features)
    advantages = component_gae(
        rollout.rewards,
        values,
        rollout.episode_starts,
        heads.values(rollout.last_features),
        rollout.last_dones,
        gamma,
        gae_lambda,
    )
    return np.asarray(advantages + values)


def fit_policy(model: Any, collect: Callable[[], None]) -> None:
    """Give a model value heads, though it has learned none.

    :param model: a GCRPPO; its heads are overwritten
    :param collect: fills the model's rollout buffer
    """
    rollouts: list[Rollout] = []
    _set_heads(model.policy.value_net, None)
    for _ in range(FIT_ROLLOUTS):
        collect()
        rollouts.append(_take_down(model))
        heads = fit_heads(rollouts, model.gamma, model.gae_lambda)
        _set_heads(model.policy.value_net, heads)


def _take_down(model: Any) -> Rollout:
    """The rollout in a model's buffer."""
    buffer: RolloutBuffer = model.rollout_buffer
    steps = [
        _features(model.policy, _at(buffer.observations, t)) for t in range(len(buffer.rewards))
    ]
    return Rollout(
        features=np.stack(steps),
        last_features=_features(model.policy, model._last_obs),
        rewards=buffer.rewards.astype(float),
        episode_starts=buffer.episode_starts.astype(float),
        last_dones=model._last_episode_starts,
    )


def _at(observations: Any, step: int) -> Any:
    if isinstance(observations, dict):
        return {key: rows[step] for key, rows in observations.items()}
    return observations[step]


def _features(policy: ActorCriticPolicy, observations: Any) -> Numbers:
    """What a critic's head sees, shape (N, F)."""
    tensor = obs_as_tensor(observations, policy.device)
    with th.no_grad():
        extracted = BasePolicy.extract_features(policy, tensor, policy.vf_features_extractor)
        features: th.Tensor = policy.mlp_extractor.forward_critic(extracted)
    return features.cpu().numpy().astype(float)


def _set_heads(layer: th.nn.Linear, heads: Heads | None) -> None:
    """Overwrite a linear layer; None is V = 0."""
    with th.no_grad():
        if heads is None:
            layer.weight.zero_()
            layer.bias.zero_()
            return
        layer.weight.copy_(th.as_tensor(heads.weights.T))
        layer.bias.copy_(th.as_tensor(heads.offsets))

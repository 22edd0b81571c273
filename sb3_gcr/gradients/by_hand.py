"""The actor-critic of linear layers, evaluated and differentiated by hand: one backward pass for
all K gradients.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from itertools import accumulate

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_gcr.gradients.fitting import actor_modules, critic_modules
from sb3_gcr.gradients.gramian import Layer, component_gramian, own_products, without_own
from sb3_gcr.gradients.heads import head_of
from sb3_gcr.gradients.layers import Mlp
from sb3_gcr.gradients.memory import Array, Memory, Weights, is_small


class ByHand:
    """What :class:`~sb3_gcr.gradients.by_autograd.ByAutograd` computes, at PPO's price.

    It is an :class:`~sb3_gcr.gradients.ActorCritic`; its arrays are NumPy's for small updates.

    :param policy: one that :func:`~sb3_gcr.gradients.fitting.fits`
    :param n_samples: size B of the minibatches to come; None is PyTorch in any case
    """

    def __init__(self, policy: ActorCriticPolicy, n_samples: int | None = None):
        self.policy = policy
        in_numpy = n_samples is not None and is_small(policy, n_samples)
        self.way = f"one backward pass in {'NumPy' if in_numpy else 'PyTorch'}"
        actor, critic = actor_modules(policy), critic_modules(policy)
        self._memory = Memory(_summed_parameters(policy), policy, in_numpy)
        self.actor, self.critic = Mlp(actor, self._memory), Mlp(critic, self._memory)
        self.head = head_of(policy, self._memory)
        self._widths = [len(bias) for bias in self.actor.biases]
        # Vectors pass through SB3's preprocessing and flattening as they are.
        space = policy.observation_space
        is_vector = isinstance(space, spaces.Box) and len(space.shape) == 1
        self._extractor = (
            policy.features_extractor
            if policy.share_features_extractor
            else policy.pi_features_extractor
        )
        self._takes_vectors = is_vector and type(self._extractor) is FlattenExtractor

    def session(self) -> AbstractContextManager[object]:
        """NumPy's BLAS has one thread during an update in NumPy."""
        return self._memory.one_thread()

    def array(self, tensor: th.Tensor) -> Array:
        """A tensor's numbers, in its own memory."""
        return self._memory.array(tensor)

    def evaluate(self, observations: PyTorchObs, actions: th.Tensor) -> tuple[Array, Array]:
        """Values V, shape (B, K), and log π(a|s), shape (B,)."""
        features = self.array(self._features(observations))
        values = self.critic.forward(features)
        return values, self.head.log_prob(self.actor.forward(features), actions)

    def _features(self, observations: PyTorchObs) -> th.Tensor:
        if self._takes_vectors and isinstance(observations, th.Tensor):
            return observations.float()
        return BasePolicy.extract_features(self.policy, observations, self._extractor)

    def entropy_loss(self) -> Array:
        """Minus the mean entropy."""
        return self.head.entropy_loss()

    def gramian(self, cotangents: Array, n_samples: int | None = None) -> Array:
        """G = J Jᵀ of the component gradients, shape (K, K).

        :param cotangents: C, shape (B, K)
        :param n_samples: take the first n rows instead of all
        """
        signals = self.actor.signals(self.head.signal())
        # ∂log π/∂bias is the layer's signal itself.
        self._scores = self._memory.xp.concatenate([*signals, *self.head.scores()], 1)
        rows = slice(n_samples)
        layers = [
            Layer(delta[rows], features[rows])
            for delta, features in zip(signals, self.actor.inputs, strict=True)
        ]
        self._factors = (layers, self._scores[rows], cotangents[rows])
        self._gramian = component_gramian(*self._factors)
        return self._gramian

    def begin_epoch(self) -> None:
        """Nothing is kept from one minibatch to the next."""

    def unbiased_gramian(self) -> Array | None:
        """Ĝ over pairs of different samples, shape (K, K); None for a single sample."""
        n_samples = len(self._factors[-1])
        if n_samples < 2:
            return None
        return without_own(self._gramian, own_products(*self._factors), n_samples)

    def backward(
        self, cotangents: Array, weights: Weights, value_gradients: Array, ent_coef: float
    ) -> None:
        """Set the parameters' gradients to those of the whole loss; call :meth:`gramian` before.

        :param cotangents: C, shape (B, K)
        :param weights: w, shape (K,)
        :param value_gradients: of the loss by the values, shape (B, K)
        :param ent_coef: weight of the entropy loss
        """
        self._memory.attach()
        concatenate = self._memory.xp.concatenate
        cotangent = (cotangents @ self._memory.weights(weights))[:, None]
        entropy_signal = self.head.entropy_signal() if ent_coef != 0 else None
        if entropy_signal is None:
            scores = self._scores * cotangent
        else:
            signal = self.head.signal() * cotangent + ent_coef * entropy_signal
            scores = concatenate(self.actor.signals(signal), 1)
        critic_signals = self.critic.signals(value_gradients)
        self.actor.write_weight_gradients(self._by_layer(scores))
        self.critic.write_weight_gradients(critic_signals)
        self._memory.sums[:] = concatenate([scores, *critic_signals], 1).sum(0)
        if ent_coef != 0:
            self.head.add_entropy_gradient(ent_coef)

    def _by_layer(self, scores: Array) -> list[Array]:
        """The columns of the actor's layers, each of shape (B, out)."""
        ends = accumulate(self._widths)
        columns = zip(self._widths, ends, strict=True)
        return [scores[:, end - width : end] for width, end in columns]

    def clip_gradients(self, max_norm: float) -> float:
        """Scale all gradients to a joint norm of at most ``max_norm``; return the norm before."""
        gradients = self._memory.gradients
        norm = math.sqrt(float(gradients @ gradients))
        if norm > max_norm:
            gradients *= max_norm / (norm + 1e-6)  # as th.nn.utils.clip_grad_norm_
        return norm


def _summed_parameters(policy: ActorCriticPolicy) -> list[nn.Parameter]:
    """Parameters whose gradients are sums over the samples' scores: biases and log σ, in the order
    in which :meth:`ByHand.backward` has them.
    """
    actor = [layer.bias for layer in actor_modules(policy)[::2]]
    critic = [layer.bias for layer in critic_modules(policy)[::2]]
    if isinstance(policy.action_dist, DiagGaussianDistribution):
        return [*actor, policy.log_std, *critic]  # type: ignore[list-item]
    return [*actor, *critic]  # type: ignore[list-item]

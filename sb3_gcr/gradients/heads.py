"""The distributions on top of the actor: log π, its derivatives, and those of the entropy."""

from __future__ import annotations

import math
from typing import Protocol

import torch as th
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_gcr.gradients.memory import Array, Memory

LOG_2PI = math.log(2 * math.pi)


class Head(Protocol):
    """A distribution of actions, given the output y of the actor's last layer, shape (B, A)."""

    def log_prob(self, output: Array, actions: th.Tensor) -> Array:
        """Log π(a|s), shape (B,); the other methods speak of this minibatch."""

    def signal(self) -> Array:
        """∂log π/∂y, shape (B, A)."""

    def scores(self) -> list[Array]:
        """∂log π/∂θ_own of the head's own parameters, each of shape (B, n)."""

    def entropy_loss(self) -> Array:
        """Minus the mean entropy, one number."""

    def entropy_signal(self) -> Array | None:
        """∂(entropy loss)/∂y, shape (B, A); None where it is 0."""

    def add_entropy_gradient(self, ent_coef: float) -> None:
        """Add the entropy loss's gradient by the head's own parameters, times ``ent_coef``."""


def head_of(policy: ActorCriticPolicy, memory: Memory) -> Head:
    """The head of a policy.

    :param policy: has one of the distributions of :mod:`sb3_gcr.gradients.fitting`
    :param memory: of its parameters and gradients
    """
    if isinstance(policy.action_dist, DiagGaussianDistribution):
        return GaussianHead(policy, memory)
    return LogitsHead(policy.action_dist, memory)


class GaussianHead:
    """Diagonal Gaussian with a log σ that does not depend on the state; y is the mean μ.

    :param policy: has ``log_std``
    :param memory: of its parameters and gradients
    """

    def __init__(self, policy: ActorCriticPolicy, memory: Memory):
        self.memory = memory
        self.log_std = memory.array(policy.log_std)
        self.gradient = memory.gradient(policy.log_std)
        self._halves = memory.array(th.full_like(policy.log_std, -0.5))

    def log_prob(self, output: Array, actions: th.Tensor) -> Array:
        """Log π(a|s) = -½ Σ ((a - μ) / σ)² - Σ log σ - ½ A log 2π, shape (B,)."""
        self._precision = self.memory.xp.exp(-self.log_std)  # 1 / σ
        self._z = self.memory.array(actions) - output
        self._z *= self._precision
        self._squares = self._z * self._z
        # An array of one number: NumPy 1 makes double precision of a scalar.
        self._log_det = self.log_std.sum(0, keepdims=True) + 0.5 * LOG_2PI * output.shape[1]
        return self._squares @ self._halves - self._log_det

    def signal(self) -> Array:
        """∂log π/∂μ = (a - μ) / σ², shape (B, A)."""
        return self._z * self._precision

    def scores(self) -> list[Array]:
        """∂log π/∂log σ = ((a - μ) / σ)² - 1, shape (B, A)."""
        return [self._squares - 1]

    def entropy_loss(self) -> Array:
        """Minus the entropy Σ log σ + ½ A (1 + log 2π)."""
        return -0.5 * len(self.log_std) - self._log_det

    def entropy_signal(self) -> None:
        """The entropy does not depend on the mean."""
        return None

    def add_entropy_gradient(self, ent_coef: float) -> None:
        """The entropy loss's derivative by each log σ is -1."""
        self.gradient -= ent_coef


class LogitsHead:
    """Categorical, multi-categorical or Bernoulli distribution; y are the logits, and a little
    graph of their own gives the derivatives.

    :param distribution: SB3's, without parameters
    :param memory: says what an array is
    """

    def __init__(self, distribution: Distribution, memory: Memory):
        self.distribution = distribution
        self.memory = memory

    def log_prob(self, output: Array, actions: th.Tensor) -> Array:
        """Log π(a|s), shape (B,)."""
        with th.enable_grad():
            self._logits = th.as_tensor(output).detach().requires_grad_()
            self.distribution.proba_distribution(self._logits)
            self._log_prob = self.distribution.log_prob(actions)
            entropy = self.distribution.entropy()
            assert entropy is not None
            self._entropy_loss = -entropy.mean()
        return self.memory.array(self._log_prob)

    def signal(self) -> Array:
        """∂log π/∂logits, shape (B, A)."""
        return self._derivative(self._log_prob)

    def scores(self) -> list[Array]:
        """There is no parameter beside the logits."""
        return []

    def entropy_loss(self) -> Array:
        """Minus the mean entropy."""
        return self.memory.array(self._entropy_loss)

    def entropy_signal(self) -> Array:
        """∂(entropy loss)/∂logits, shape (B, A)."""
        return self._derivative(self._entropy_loss)

    def add_entropy_gradient(self, ent_coef: float) -> None:
        """There is no parameter beside the logits."""

    def _derivative(self, figure: th.Tensor) -> Array:
        ones = th.ones_like(figure)
        gradient = th.autograd.grad(figure, self._logits, ones, retain_graph=True)[0]
        return self.memory.array(gradient)

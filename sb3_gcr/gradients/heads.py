"""The distributions on top of the actor, and their derivatives."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_gcr.gradients.memory import Array, Memory

_LOG_2PI = float(np.log(2 * np.pi))


class GaussianHead:
    """Diagonal Gaussian with a log σ that does not depend on the state.

    :param policy: has ``log_std``
    :param memory: of its parameters and gradients
    """

    def __init__(self, policy: Any, memory: Memory):
        self.memory = memory
        self.log_std, self.gradient = memory.array(policy.log_std), memory.gradient(policy.log_std)
        self._halves = memory.array(th.full_like(policy.log_std, -0.5))

    def forward(self, mean: Array, actions: th.Tensor) -> Array:
        """Return log π(a|s) = -½ Σ ((a - μ) / σ)² - Σ log σ - ½ A log 2π, shape (B,)."""
        self._scale = self.memory.xp.exp(-self.log_std)
        self._z = self.memory.array(actions) - mean
        self._z *= self._scale
        self._squares = self._z * self._z
        # An array of one number: NumPy 1 makes double precision of a scalar.
        self._log_det = self.log_std.sum(0, keepdims=True) + 0.5 * _LOG_2PI * mean.shape[1]
        return self._squares @ self._halves - self._log_det

    def signal(self) -> Array:
        """Return ∂log π/∂μ = (a - μ) / σ², shape (B, A)."""
        return self._z * self._scale

    def score(self) -> list[Array]:
        """S = ∂log π/∂log σ = ((a - μ) / σ)² - 1, shape (B, A)."""
        return [self._squares - 1]

    def entropy_loss(self) -> Array:
        """Minus the entropy Σ log σ + ½ A (1 + log 2π)."""
        return -0.5 * len(self.log_std) - self._log_det

    def entropy_signal(self) -> None:
        """The entropy does not depend on the mean."""
        return None

    def add_entropy_gradient(self, ent_coef: float) -> None:
        """Add the gradient of the entropy loss by log σ, which is -1 for each of them."""
        self.gradient -= ent_coef


class LogitsHead:
    """Categorical, multi-categorical or Bernoulli distribution; its own little graph gives the
    derivatives by the logits.

    :param policy: has SB3's ``action_dist``
    :param memory: says what an array is
    """

    def __init__(self, policy: Any, memory: Memory):
        self.distribution = policy.action_dist
        self.memory = memory

    def forward(self, logits: Array, actions: th.Tensor) -> Array:
        """Return log π(a|s), shape (B,)."""
        with th.enable_grad():
            self._logits = th.as_tensor(logits).detach().requires_grad_()
            self.distribution.proba_distribution(self._logits)
            self._log_prob: th.Tensor = self.distribution.log_prob(actions)
            self._entropy_loss: th.Tensor = -self.distribution.entropy().mean()
        return self.memory.array(self._log_prob)

    def signal(self) -> Array:
        """Return ∂log π/∂logits, shape (B, A)."""
        ones = th.ones_like(self._log_prob)
        return self.memory.array(
            th.autograd.grad(self._log_prob, self._logits, ones, retain_graph=True)[0]
        )

    def score(self) -> list[Array]:
        """There is no parameter beside the logits."""
        return []

    def entropy_loss(self) -> Array:
        """Minus the mean entropy."""
        return self.memory.array(self._entropy_loss)

    def entropy_signal(self) -> Array:
        """Derivative of the entropy loss by the logits, shape (B, A)."""
        return self.memory.array(
            th.autograd.grad(self._entropy_loss, self._logits, retain_graph=True)[0]
        )

    def add_entropy_gradient(self, ent_coef: float) -> None:
        """There is no parameter beside the logits."""

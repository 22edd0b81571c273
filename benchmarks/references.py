"""Other ways to the same update, for comparison: K losses spelled out, and two ways to turn them
into one gradient.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch.nn import functional as F

from sb3_gcr import GCRPPO


class LossByLoss(GCRPPO):
    """GCRPPO whose update computes one surrogate loss per component and leaves their gradients to a
    subclass.

    Actor and critic must not share parameters. Less is logged than GCRPPO logs, which is to its
    advantage.
    """

    def train(self) -> None:
        """Update the policy from the current rollout."""
        assert self.reward_spec is not None
        self.policy.set_training_mode(True)
        self.clip_eps = float(self.clip_range(1.0))  # type: ignore[operator]
        self.levels = np.array(self.reward_spec.levels)
        self.rng = np.random.default_rng(self.seed)
        self.actor = [
            weight for name, weight in self.policy.named_parameters() if "value" not in name
        ]
        advantages = self.rollout_buffer.advantages.reshape(-1, self.n_components)
        scale = advantages.sum(1).std(ddof=1) + 1e-8
        normalized = (advantages - advantages.mean(0)) / scale
        self.rollout_buffer.advantages = normalized.reshape(self.rollout_buffer.advantages.shape)
        for _ in range(self.n_epochs):
            for batch in self.rollout_buffer.get(self.batch_size):
                self.train_minibatch(batch)
        self._n_updates += self.n_epochs

    def train_minibatch(self, batch: Any) -> None:
        """One optimiser step: the resolved gradient of the actor, the plain one of critic and
        entropy.
        """
        values, log_prob, entropy = self.policy.evaluate_actions(batch.observations, batch.actions)
        ratio = th.exp(log_prob - batch.old_log_prob).unsqueeze(1)
        clipped = ratio.clamp(1 - self.clip_eps, 1 + self.clip_eps)
        losses = -th.min(ratio * batch.advantages, clipped * batch.advantages).mean(0)
        self.policy.optimizer.zero_grad()
        self.backward_actor(losses)
        assert entropy is not None
        value_loss = self.n_components * F.mse_loss(values, batch.returns)
        (self.vf_coef * value_loss - self.ent_coef * entropy.mean()).backward()  # type: ignore[no-untyped-call]
        th.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
        self.policy.optimizer.step()

    def backward_actor(self, losses: th.Tensor) -> None:
        """Put the gradient that K losses, shape (K,), resolve to into the actor's ``grad``; the
        graph is not kept.
        """
        raise NotImplementedError


class FlatProjection(LossByLoss):
    """K backward passes to K flat gradients, projected pair by pair where they lie, as in the
    authors' release.
    """

    def backward_actor(self, losses: th.Tensor) -> None:
        """Flatten, project, unflatten."""
        rows = []
        for loss in losses:
            gradients = th.autograd.grad(loss, self.actor, retain_graph=True)
            rows.append(th.cat([gradient.flatten() for gradient in gradients]))
        step = project_in_place(rows, self.levels, self.rng)
        pieces = step.split_with_sizes([weight.numel() for weight in self.actor])
        for weight, piece in zip(self.actor, pieces, strict=True):
            weight.grad = piece.view_as(weight)


def project_in_place(
    gradients: Sequence[th.Tensor], levels: NDArray[Any], rng: np.random.Generator
) -> th.Tensor:
    """Project each gradient off the tasks that it conflicts with as they are by then, and add up;
    (K times (D,)) -> (D,).
    """
    for i in rng.permutation(len(gradients)):
        for j in rng.permutation(len(gradients)):
            if i == j or levels[j] > 0:
                continue
            inner = gradients[i] @ gradients[j]
            if inner.item() < 0:
                gradients[i].sub_(gradients[j] * (inner / (gradients[j] @ gradients[j] + 1e-8)))
    return th.stack(list(gradients)).sum(0)


class Autojac(LossByLoss):
    """TorchJD's Jacobian descent: one vmapped backward to the K×D Jacobian, then its PCGrad, which
    knows no levels.
    """

    def backward_actor(self, losses: th.Tensor) -> None:
        """Jacobian, then aggregation."""
        from torchjd.aggregation import PCGrad
        from torchjd.autojac import backward, jac_to_grad

        # The entropy's backward comes after and shares the node of the standard deviation.
        backward(losses, inputs=self.actor, retain_graph=True)
        jac_to_grad(self.actor, PCGrad())

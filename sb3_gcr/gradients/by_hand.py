"""The actor-critic of linear layers, evaluated and differentiated by hand with one backward
pass.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext
from itertools import accumulate
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    DiagGaussianDistribution,
    MultiCategoricalDistribution,
)
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, MlpExtractor
from torch import nn

from sb3_gcr.gradients.gramian import layer_gramian
from sb3_gcr.gradients.heads import GaussianHead, LogitsHead
from sb3_gcr.gradients.layers import Mlp
from sb3_gcr.gradients.memory import SMALL, SMALL_FOR_THREADS, Array, Memory, _blas


class OneBackward:
    """An actor-critic of linear layers, evaluated and differentiated by hand: what
    ``ManyBackwards`` does, at PPO's price.

    Under ``torch.no_grad`` call :meth:`evaluate` with a minibatch, then :meth:`gramian` and
    :meth:`backward`.

    :param policy: must fit, see :meth:`fits`
    :param n_samples: size of the minibatches to come; small ones on the CPU run in NumPy. None is
        PyTorch in any case
    """

    def __init__(self, policy: Any, n_samples: int | None = None):
        self.policy = policy
        n_parameters = sum(parameter.numel() for parameter in policy.parameters())
        limit = SMALL if th.get_num_threads() == 1 else SMALL_FOR_THREADS
        in_numpy = (
            n_samples is not None
            and n_samples * n_parameters <= limit
            and policy.device.type == "cpu"
        )
        actor, critic = _actor_modules(policy), _critic_modules(policy)
        gaussian = isinstance(policy.action_dist, DiagGaussianDistribution)
        biases: list[list[Any]] = [
            [layer.bias for layer in modules[::2]] for modules in (actor, critic)
        ]
        self._memory = Memory(
            [*biases[0], *([policy.log_std] if gaussian else []), *biases[1]], policy, in_numpy
        )
        self.actor, self.critic = (
            Mlp(*actor, memory=self._memory),
            Mlp(*critic, memory=self._memory),
        )
        self.head: GaussianHead | LogitsHead
        self.head = (
            GaussianHead(policy, self._memory) if gaussian else LogitsHead(policy, self._memory)
        )
        self._widths = [bias.numel() for bias in biases[0]]
        extractor, space = policy.pi_features_extractor, policy.observation_space
        # Vectors pass through SB3's preprocessing and flattening as they are.
        self._takes_vectors = (
            type(extractor) is FlattenExtractor
            and isinstance(space, spaces.Box)
            and len(space.shape) == 1
        )

    @property
    def in_numpy(self) -> bool:
        """Whether arrays are NumPy's."""
        return self._memory.in_numpy

    @staticmethod
    def fits(policy: Any) -> bool:
        """Whether SB3's own forward pass runs in this policy, through linear layers and known
        activations alone.
        """
        overridable = (
            "evaluate_actions",
            "extract_features",
            "_get_action_dist_from_latent",
            "_build_mlp_extractor",
        )
        if any(
            getattr(type(policy), name, None) is not getattr(ActorCriticPolicy, name)
            for name in overridable
        ):
            return False
        heads = (
            DiagGaussianDistribution,
            CategoricalDistribution,
            MultiCategoricalDistribution,
            BernoulliDistribution,
        )
        if type(policy.action_dist) not in heads or type(policy.mlp_extractor) is not MlpExtractor:
            return False
        if not (Mlp.fits(*_actor_modules(policy)) and Mlp.fits(*_critic_modules(policy))):
            return False
        if not all(
            _only_flattens(e) for e in (policy.pi_features_extractor, policy.vf_features_extractor)
        ):
            return False
        hooks = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
        if any(getattr(module, name) for module in policy.modules() for name in hooks):
            return False
        modules = [
            m
            for m in (*_actor_modules(policy), *_critic_modules(policy))
            if isinstance(m, nn.Linear)
        ]
        known = {p for m in modules for p in (m.weight, m.bias)} | {
            getattr(policy, "log_std", None)
        }
        plain = (
            p.requires_grad and p.dtype == th.float32 and not p._backward_hooks
            for p in policy.parameters()
        )
        return all(p in known for p in policy.parameters()) and all(plain)

    def one_thread(self) -> AbstractContextManager[Any]:
        """Hold NumPy's BLAS, where it is used, to one thread: several would wait for each other
        longer than they work.
        """
        return _blas().limit(limits=1) if self.in_numpy else nullcontext()

    def array(self, tensor: th.Tensor) -> Array:
        """A tensor of the minibatch in the form that the other methods take and return."""
        return self._memory.array(tensor)

    def evaluate(self, observations: Any, actions: th.Tensor) -> OneBackward:
        """Forward pass of actor and critic; sets ``values`` (B, K) and ``log_prob`` (B,)."""
        if self._takes_vectors:
            features = observations.float()
        else:
            features = BasePolicy.extract_features(
                self.policy, observations, self.policy.pi_features_extractor
            )
        features = self.array(features)
        self.values = self.critic.forward(features)
        self.log_prob = self.head.forward(self.actor.forward(features), actions)
        return self

    def gramian(self, cotangents: Array, n_samples: int | None = None) -> Array:
        """Gramian of the component gradients, shape (K, K).

        :param cotangents: of log π, shape (B, K)
        :param n_samples: take the first n rows of the minibatch instead of all; they are in random
            order already
        """
        signals = self.actor.signals(self.head.signal())
        self._added = self._memory.xp.concatenate(
            [*signals, *self.head.score()], 1
        )  # ∂log π/∂bias of all layers, and S
        inputs, added = self.actor.inputs, self._added
        if n_samples is not None:
            signals, inputs = (
                [array[:n_samples] for array in arrays] for arrays in (signals, inputs)
            )
            added, cotangents = added[:n_samples], cotangents[:n_samples]
        return layer_gramian(signals, inputs, added, cotangents)

    def entropy_loss(self) -> Array:
        """PPO's entropy loss: minus the mean entropy."""
        return self.head.entropy_loss()

    def backward(self, cotangent: Array, value_cotangents: Array, ent_coef: float) -> None:
        """Set the gradient of the whole loss; call :meth:`gramian` before.

        :param cotangent: of log π, shape (B,)
        :param value_cotangents: of the values, shape (B, K)
        :param ent_coef: weight of the entropy loss
        """
        self._memory.attach()
        concatenate, column = self._memory.xp.concatenate, cotangent[:, None]
        entropy_signal = self.head.entropy_signal() if ent_coef != 0 else None
        if entropy_signal is None:
            added = self._added * column
        else:
            added = concatenate(
                self.actor.signals(self.head.signal() * column + ent_coef * entropy_signal), 1
            )
        critic_signals = self.critic.signals(value_cotangents)
        ends = list(accumulate(self._widths))
        self.actor.write_weight_gradients(
            added[:, end - n : end] for n, end in zip(self._widths, ends, strict=True)
        )
        self.critic.write_weight_gradients(critic_signals)
        self._memory.sums[:] = concatenate([added, *critic_signals], 1).sum(0)
        if ent_coef != 0:
            self.head.add_entropy_gradient(ent_coef)

    def clip_gradients(self, max_norm: float) -> float:
        """Scale all gradients down to a joint norm of at most ``max_norm``, as ``clip_grad_norm_``;
        the norm before.
        """
        flat = self._memory.flat
        norm = math.sqrt(float(flat @ flat))
        if norm > max_norm:
            flat *= max_norm / (norm + 1e-6)
        return norm


def _actor_modules(policy: Any) -> list[nn.Module]:
    return [*policy.mlp_extractor.policy_net, policy.action_net]


def _critic_modules(policy: Any) -> list[nn.Module]:
    return [*policy.mlp_extractor.value_net, policy.value_net]


def _only_flattens(extractor: nn.Module) -> bool:
    """Whether a features extractor is one of SB3's that only flatten and concatenate."""
    if type(extractor) is CombinedExtractor:
        return all(type(part) is nn.Flatten for part in extractor.extractors.values())
    return type(extractor) is FlattenExtractor

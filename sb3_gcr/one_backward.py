"""The exact Gramian of K component gradients from one backward pass, for actors made of linear layers.

With c_b^(k) = ∂L^(k)/∂log π_b the gradient of component k is g^(k) = Σ_b c_b^(k) ∂log π_b/∂θ. Reverse mode is linear in the
cotangent and samples do not mix, so one backward pass of Σ_b log π_b gives every layer's signal Δ = (δ_b) for all K. With the
layer's input H = (h_b), and S = ∂log π_b/∂log σ row by row,

    G_kl = c^(k)ᵀ M c^(l),    M = Σ_layers (Δ Δᵀ) ∘ (H Hᵀ + 1) + S Sᵀ,   (the 1 is the bias)

and the step of any weights w has the weight gradients (Δ ∘ c w)ᵀ H. Forward and backward are written out here, because for
small networks most of the time of an update is PyTorch's bookkeeping, not arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np
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
from torch.nn.functional import linear

#: Numbers that a block of K weight gradients may hold at a time, on the CPU and on other devices.
BLOCK, BLOCK_ON_DEVICE = 2**22, 2**26
#: Minibatches up to this size get M in one piece; of larger ones only the upper half, by blocks of rows of these heights.
WHOLE, LOWEST, HIGHEST = 128, 64, 256
#: Operations on the elements of M count like so many columns of Δ and H.
ELEMENTWISE = 30
_aten = th.ops.aten
_LOG_2PI = float(np.log(2 * np.pi))


#: Activations that act on each number alone and draw nothing at random.
ACTIVATIONS = (
    nn.Tanh,
    nn.ReLU,
    nn.ELU,
    nn.SELU,
    nn.CELU,
    nn.GELU,
    nn.SiLU,
    nn.Mish,
    nn.Sigmoid,
    nn.LogSigmoid,
    nn.LeakyReLU,
    nn.Softplus,
    nn.Softsign,
    nn.Hardtanh,
    nn.ReLU6,
    nn.Hardswish,
    nn.Identity,
)


def tanh_(preactivation: th.Tensor) -> th.Tensor:
    """Hyperbolic tangent in place; on the CPU by NumPy, which takes a fifth of PyTorch's time on an AMD EPYC."""
    if preactivation.device.type != "cpu":
        return preactivation.tanh_()
    array = preactivation.numpy()
    np.tanh(array, out=array)
    return preactivation


class Activation:
    """An activation behind a linear layer, and its derivative: closed where that is cheap, PyTorch's elsewhere.

    :param module: of a type in ``ACTIVATIONS``
    """

    def __init__(self, module: nn.Module):
        # The functions themselves: a call of a module costs as much as the arithmetic of a small layer.
        self.forward: Callable[[th.Tensor], th.Tensor] = module.forward
        if isinstance(module, nn.Tanh):
            self.forward, self.backward = tanh_, _aten.tanh_backward.default
        elif isinstance(module, nn.ReLU):
            self.forward, self.backward = th.relu, partial(_aten.threshold_backward.default, threshold=0)
        elif isinstance(module, nn.ELU):
            alpha = module.alpha
            self.backward = lambda signal, output: _aten.elu_backward.default(signal, alpha, 1, 1, True, output)
        else:
            self.forward, self.backward = partial(self._forward_with_graph, module), self._backward_through_graph

    #: Signal in front of the activation, from the one behind it and the activation's output.
    backward: Callable[[th.Tensor, th.Tensor], th.Tensor]

    def _forward_with_graph(self, module: nn.Module, preactivation: th.Tensor) -> th.Tensor:
        with th.enable_grad():
            self._input = preactivation.detach().requires_grad_()
            self._output = module(self._input)
        return self._output.detach()

    def _backward_through_graph(self, signal: th.Tensor, output: th.Tensor) -> th.Tensor:
        return th.autograd.grad(self._output, self._input, signal, retain_graph=True)[0]


class Mlp:
    """Linear layers with an activation behind each but the last, run forward and backward by hand.

    :param modules: linear layers and activations in turn, beginning and ending with a linear layer
    """

    def __init__(self, *modules: Any):
        self.weights = [layer.weight for layer in modules[::2]]
        self.biases = [layer.bias for layer in modules[::2]]
        self.activations = [Activation(module) for module in modules[1::2]]

    @staticmethod
    def fits(*modules: nn.Module) -> bool:
        """Whether the modules are linear layers and known activations in turn."""
        right_types = [
            type(module) is nn.Linear and module.bias is not None if index % 2 == 0 else type(module) in ACTIVATIONS
            for index, module in enumerate(modules)
        ]
        in_place = any(getattr(module, "inplace", False) for module in modules)
        return len(modules) % 2 == 1 and all(right_types) and not in_place

    def forward(self, features: th.Tensor) -> th.Tensor:
        """Output for features of shape (B, in); each layer's input H is kept."""
        self.inputs = [features]
        for weight, bias, activation in zip(self.weights, self.biases, self.activations, strict=False):
            features = activation.forward(linear(features, weight, bias))
            self.inputs.append(features)
        return linear(features, self.weights[-1], self.biases[-1])

    def signals(self, cotangent: th.Tensor) -> list[th.Tensor]:
        """The signal Δ of shape (B, out) at each layer's output, for a cotangent of the last one."""
        signals = [cotangent]
        for weight, activation, output in zip(self.weights[:0:-1], self.activations[::-1], self.inputs[:0:-1], strict=True):
            signals.append(activation.backward(th.mm(signals[-1], weight), output))
        return signals[::-1]

    def write_weight_gradients(self, signals: Iterable[th.Tensor]) -> None:
        """Set the gradient of each layer's weights to Δᵀ H."""
        for weight, signal, features in zip(self.weights, signals, self.inputs, strict=True):
            th.mm(signal.T, features, out=weight.grad)


class GaussianHead:
    """Diagonal Gaussian with a log σ that does not depend on the state.

    :param policy: has ``log_std``
    """

    def __init__(self, policy: Any):
        self.log_std = policy.log_std
        self._ones = th.ones_like(policy.log_std)

    def forward(self, mean: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Return log π(a|s) = -½ Σ ((a - μ) / σ)² - Σ log σ - ½ A log 2π, shape (B,)."""
        self._scale = th.exp(-self.log_std)
        self._z = (actions - mean) * self._scale
        self._squares = self._z * self._z
        self._log_det = self.log_std.sum() + 0.5 * _LOG_2PI * mean.shape[1]
        return th.addmv(self._log_det, self._squares, self._ones, beta=-1, alpha=-0.5)

    def signal(self) -> th.Tensor:
        """Return ∂log π/∂μ = (a - μ) / σ², shape (B, A)."""
        return self._z * self._scale

    def score(self) -> list[th.Tensor]:
        """S = ∂log π/∂log σ = ((a - μ) / σ)² - 1, shape (B, A)."""
        return [self._squares - 1]

    def entropy_loss(self) -> th.Tensor:
        """Minus the entropy Σ log σ + ½ A (1 + log 2π)."""
        return -0.5 * self.log_std.numel() - self._log_det

    def entropy_signal(self) -> None:
        """The entropy does not depend on the mean."""
        return None

    def add_entropy_gradient(self, ent_coef: float) -> None:
        """Add the gradient of the entropy loss by log σ, which is -1 for each of them."""
        self.log_std.grad.sub_(ent_coef)


class LogitsHead:
    """Categorical, multi-categorical or Bernoulli distribution; its own little graph gives the derivatives by the logits.

    :param policy: has SB3's ``action_dist``
    """

    def __init__(self, policy: Any):
        self.distribution = policy.action_dist

    def forward(self, logits: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Return log π(a|s), shape (B,)."""
        with th.enable_grad():
            self._logits = logits.detach().requires_grad_()
            self.distribution.proba_distribution(self._logits)
            self._log_prob: th.Tensor = self.distribution.log_prob(actions)
            self._entropy_loss: th.Tensor = -self.distribution.entropy().mean()
        return self._log_prob.detach()

    def signal(self) -> th.Tensor:
        """Return ∂log π/∂logits, shape (B, A)."""
        return th.autograd.grad(self._log_prob, self._logits, th.ones_like(self._log_prob), retain_graph=True)[0]

    def score(self) -> list[th.Tensor]:
        """There is no parameter beside the logits."""
        return []

    def entropy_loss(self) -> th.Tensor:
        """Minus the mean entropy."""
        return self._entropy_loss.detach()

    def entropy_signal(self) -> th.Tensor:
        """Derivative of the entropy loss by the logits, shape (B, A)."""
        return th.autograd.grad(self._entropy_loss, self._logits, retain_graph=True)[0]

    def add_entropy_gradient(self, ent_coef: float) -> None:
        """There is no parameter beside the logits."""


class OneBackward:
    """An actor-critic of linear layers, evaluated and differentiated by hand: what ``ManyBackwards`` does, at PPO's price.

    Under ``torch.no_grad`` call :meth:`evaluate` with a minibatch, then :meth:`gramian` and :meth:`backward`.

    :param policy: must fit, see :meth:`fits`
    """

    def __init__(self, policy: Any):
        self.policy = policy
        self.actor, self.critic = Mlp(*_actor_modules(policy)), Mlp(*_critic_modules(policy))
        gaussian = isinstance(policy.action_dist, DiagGaussianDistribution)
        self.head: GaussianHead | LogitsHead = GaussianHead(policy) if gaussian else LogitsHead(policy)
        added = [*self.actor.biases, *([policy.log_std] if gaussian else []), *self.critic.biases]
        # One block of memory for all gradients, first those that are plain sums over samples: their norm, their scaling, and
        # these sums are then one operation each.
        self._parameters = added + [p for p in policy.parameters() if all(p is not other for other in added)]
        self._flat = th.zeros(sum(parameter.numel() for parameter in self._parameters), device=policy.device)
        pieces = self._flat.split([parameter.numel() for parameter in self._parameters])
        self._gradients = [piece.view_as(p) for piece, p in zip(pieces, self._parameters, strict=True)]
        self._sums = self._flat[: sum(parameter.numel() for parameter in added)]
        self._widths = [bias.numel() for bias in self.actor.biases]
        extractor, space = policy.pi_features_extractor, policy.observation_space
        # Vectors pass through SB3's preprocessing and flattening as they are.
        self._takes_vectors = type(extractor) is FlattenExtractor and isinstance(space, spaces.Box) and len(space.shape) == 1

    @staticmethod
    def fits(policy: Any) -> bool:
        """Whether SB3's own forward pass runs in this policy, through linear layers and known activations alone."""
        overridable = ("evaluate_actions", "extract_features", "_get_action_dist_from_latent", "_build_mlp_extractor")
        if any(getattr(type(policy), name, None) is not getattr(ActorCriticPolicy, name) for name in overridable):
            return False
        heads = (DiagGaussianDistribution, CategoricalDistribution, MultiCategoricalDistribution, BernoulliDistribution)
        if type(policy.action_dist) not in heads or type(policy.mlp_extractor) is not MlpExtractor:
            return False
        if not (Mlp.fits(*_actor_modules(policy)) and Mlp.fits(*_critic_modules(policy))):
            return False
        if not all(_only_flattens(e) for e in (policy.pi_features_extractor, policy.vf_features_extractor)):
            return False
        hooks = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
        if any(getattr(module, name) for module in policy.modules() for name in hooks):
            return False
        modules = [m for m in (*_actor_modules(policy), *_critic_modules(policy)) if isinstance(m, nn.Linear)]
        known = {p for m in modules for p in (m.weight, m.bias)} | {getattr(policy, "log_std", None)}
        plain = (p.requires_grad and p.dtype == th.float32 and not p._backward_hooks for p in policy.parameters())
        return all(p in known for p in policy.parameters()) and all(plain)

    def evaluate(self, observations: Any, actions: th.Tensor) -> OneBackward:
        """Forward pass of actor and critic; sets ``values`` (B, K) and ``log_prob`` (B,)."""
        if self._takes_vectors:
            features = observations.float()
        else:
            features = BasePolicy.extract_features(self.policy, observations, self.policy.pi_features_extractor)
        self.values = self.critic.forward(features)
        self.log_prob = self.head.forward(self.actor.forward(features), actions)
        return self

    def gramian(self, cotangents: th.Tensor, n_samples: int | None = None) -> th.Tensor:
        """Gramian of the component gradients, shape (K, K).

        :param cotangents: of log π, shape (B, K)
        :param n_samples: take the first n rows of the minibatch instead of all; they are in random order already
        """
        signals = self.actor.signals(self.head.signal())
        self._added = th.cat([*signals, *self.head.score()], 1)  # ∂log π/∂bias of all layers, and S
        inputs, added = self.actor.inputs, self._added
        if n_samples is not None:
            signals, inputs = ([tensor[:n_samples] for tensor in tensors] for tensors in (signals, inputs))
            added, cotangents = added[:n_samples], cotangents[:n_samples]
        return layer_gramian(signals, inputs, added, cotangents)

    def entropy_loss(self) -> th.Tensor:
        """PPO's entropy loss: minus the mean entropy."""
        return self.head.entropy_loss()

    def backward(self, cotangent: th.Tensor, value_cotangents: th.Tensor, ent_coef: float) -> None:
        """Set the gradient of the whole loss; call :meth:`gramian` before.

        :param cotangent: of log π, shape (B,)
        :param value_cotangents: of the values, shape (B, K)
        :param ent_coef: weight of the entropy loss
        """
        if self._parameters[0].grad is not self._gradients[0]:
            for parameter, gradient in zip(self._parameters, self._gradients, strict=True):
                parameter.grad = gradient
        column = cotangent.unsqueeze(1)
        entropy_signal = self.head.entropy_signal() if ent_coef != 0 else None
        if entropy_signal is None:
            added = self._added * column
        else:
            added = th.cat(self.actor.signals(self.head.signal() * column + ent_coef * entropy_signal), 1)
        critic_signals = self.critic.signals(value_cotangents)
        self.actor.write_weight_gradients(added[:, : sum(self._widths)].split_with_sizes(self._widths, 1))
        self.critic.write_weight_gradients(critic_signals)
        th.sum(th.cat([added, *critic_signals], 1), 0, out=self._sums)
        if ent_coef != 0:
            self.head.add_entropy_gradient(ent_coef)

    def clip_gradients(self, max_norm: float) -> float:
        """Scale all gradients down to a joint norm of at most ``max_norm``, as ``clip_grad_norm_``; the norm before."""
        norm = math.sqrt(th.dot(self._flat, self._flat).item())
        if norm > max_norm:
            self._flat.mul_(max_norm / (norm + 1e-6))
        return norm


def layer_gramian(signals: list[th.Tensor], inputs: list[th.Tensor], added: th.Tensor, cotangents: th.Tensor) -> th.Tensor:
    """Gramian of the K gradients Σ_b c_b^(k) (δ_b h_bᵀ, …, a_b) over all layers; per layer the cheaper of two exact forms.

    :param signals: Δ of each layer, shapes (B, out)
    :param inputs: H of each layer, shapes (B, in)
    :param added: derivatives a_b by parameters that each sample has a number of its own for, biases and log σ, shape (B, n)
    :param cotangents: c, shape (B, K)
    :return: G, shape (K, K)
    """
    n_samples, n_objectives = cotangents.shape
    by_samples = [
        0.6 * n_samples * (signal.shape[1] + features.shape[1] + ELEMENTWISE)
        <= n_objectives * signal.shape[1] * features.shape[1]
        for signal, features in zip(signals, inputs, strict=True)
    ]
    layers = list(zip(signals, inputs, strict=True))
    jacobian = th.mm(cotangents.T, added)
    gramian = th.mm(jacobian, jacobian.T)
    few = [layer for layer, take in zip(layers, by_samples, strict=True) if take]
    if few:
        gramian += _gramian_by_samples(few, cotangents)
    for (signal, features), take in zip(layers, by_samples, strict=True):
        if not take:
            gramian += _gramian_by_weights(signal, features, cotangents)
    return gramian


def _gramian_by_samples(layers: list[tuple[th.Tensor, th.Tensor]], cotangents: th.Tensor) -> th.Tensor:
    """Cᵀ M C with M = Σ_layers (Δ Δᵀ) ∘ (H Hᵀ), by blocks of rows; of the symmetric M only the upper half."""
    n_samples, n_objectives = cotangents.shape
    if n_samples <= WHOLE:
        return _rows_of_products([(s, s, h, h) for s, h in layers], cotangents).mm(cotangents)
    half = cotangents.new_zeros(n_objectives, n_objectives)
    height = min(HIGHEST, max(LOWEST, n_samples // 4))
    for start in range(0, n_samples, height):
        rows, columns = slice(start, start + height), slice(start, n_samples)
        left = _rows_of_products([(s[rows], s[columns], h[rows], h[columns]) for s, h in layers], cotangents[rows])
        left[:, :height].mul_(0.5)  # the square on the diagonal is symmetric itself
        half.addmm_(left, cotangents[columns])
    return half + half.T


def _rows_of_products(layers: list[tuple[th.Tensor, ...]], cotangents: th.Tensor) -> th.Tensor:
    """Cᵀ M for a block of M's rows and columns: much faster than M C, which has K columns instead of K rows.

    :param layers: Δ and H of each layer, in the block's rows and columns: (Δ_rows, Δ_columns, H_rows, H_columns)
    :param cotangents: C in the block's rows
    """
    block: th.Tensor | None = None
    for signal, other_signal, features, other_features in layers:
        products = th.mm(signal, other_signal.T)
        overlaps = th.mm(features, other_features.T)
        block = products.mul_(overlaps) if block is None else block.addcmul_(products, overlaps)
    assert block is not None
    return th.mm(cotangents.T, block)


def _gramian_by_weights(signal: th.Tensor, features: th.Tensor, cotangents: th.Tensor) -> th.Tensor:
    """J Jᵀ with the K weight gradients (Δ ∘ c^(k))ᵀ H as rows, a block of output units at a time."""
    n_samples, n_objectives = cotangents.shape
    block = BLOCK if signal.device.type == "cpu" else BLOCK_ON_DEVICE
    width = max(1, block // (n_objectives * max(n_samples, features.shape[1])))
    gramian = cotangents.new_zeros(n_objectives, n_objectives)
    for units in signal.T.split(width):
        weighted = (cotangents.T.unsqueeze(1) * units).flatten(0, 1)  # (K · units, B)
        jacobian = th.mm(weighted, features).view(n_objectives, -1)
        gramian += jacobian @ jacobian.T
    return gramian


def _actor_modules(policy: Any) -> list[nn.Module]:
    return [*policy.mlp_extractor.policy_net, policy.action_net]


def _critic_modules(policy: Any) -> list[nn.Module]:
    return [*policy.mlp_extractor.value_net, policy.value_net]


def _only_flattens(extractor: nn.Module) -> bool:
    """Whether a features extractor is one of SB3's that only flatten and concatenate."""
    if type(extractor) is CombinedExtractor:
        return all(type(part) is nn.Flatten for part in extractor.extractors.values())
    return type(extractor) is FlattenExtractor

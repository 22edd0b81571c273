"""The exact Gramian of K component gradients from one backward pass, for actors made of linear layers.

With c_b^(k) = ∂L^(k)/∂log π_b the gradient of component k is g^(k) = Σ_b c_b^(k) ∂log π_b/∂θ. Reverse mode is linear in the
cotangent and samples do not mix, so one backward pass of Σ_b log π_b gives every layer's signal Δ = (δ_b) for all K. With the
layer's input H = (h_b), and S = ∂log π_b/∂log σ row by row,

    G_kl = c^(k)ᵀ M c^(l),    M = Σ_layers (Δ Δᵀ) ∘ (H Hᵀ + 1) + S Sᵀ,   (the 1 is the bias)

and the step of any weights w has the weight gradients (Δ ∘ c w)ᵀ H. Forward and backward are written out here, because for
small networks most of the time of an update is PyTorch's bookkeeping, not arithmetic. For the same reason small updates on
the CPU run on NumPy arrays in the tensors' memory: an ``Array`` is one of the two, the code is spelled so that both take it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from functools import cache, partial
from itertools import accumulate
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
from threadpoolctl import ThreadpoolController
from torch import nn
from torch.nn.functional import linear

Array = Any
#: Updates with at most so many (samples × parameters) on the CPU run in NumPy, with one thread for PyTorch and with more.
SMALL, SMALL_FOR_THREADS = 2**25, 2**24
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
    _tanh_in_numpy(preactivation.numpy())
    return preactivation


class Activation:
    """An activation behind a linear layer, and its derivative: closed where that is cheap, PyTorch's elsewhere.

    :param module: of a type in ``ACTIVATIONS``
    :param in_numpy: whether :meth:`forward` and :meth:`backward` take and return NumPy arrays
    """

    def __init__(self, module: nn.Module, in_numpy: bool = False):
        # The functions themselves: a call of a module costs as much as the arithmetic of a small layer.
        self.forward: Callable[[Array], Array] = module.forward
        if isinstance(module, nn.Tanh):
            self.forward, self.backward = tanh_, _aten.tanh_backward.default
        elif isinstance(module, nn.ReLU):
            self.forward, self.backward = th.relu, partial(_aten.threshold_backward.default, threshold=0)
        elif isinstance(module, nn.ELU):
            alpha = module.alpha
            self.backward = lambda signal, output: _aten.elu_backward.default(signal, alpha, 1, 1, True, output)
        else:
            self.forward, self.backward = partial(self._forward_with_graph, module), self._backward_through_graph
        if in_numpy and isinstance(module, nn.Tanh):
            self.forward, self.backward = _tanh_in_numpy, _tanh_backward_in_numpy
        elif in_numpy:
            self.forward, self.backward = _on_arrays(self.forward), _on_arrays(self.backward)

    #: Signal in front of the activation, from the one behind it and the activation's output.
    backward: Callable[[Array, Array], Array]

    def _forward_with_graph(self, module: nn.Module, preactivation: th.Tensor) -> th.Tensor:
        with th.enable_grad():
            self._input = preactivation.detach().requires_grad_()
            self._output = module(self._input)
        return self._output.detach()

    def _backward_through_graph(self, signal: th.Tensor, output: th.Tensor) -> th.Tensor:
        return th.autograd.grad(self._output, self._input, signal, retain_graph=True)[0]


def _tanh_in_numpy(preactivation: Array) -> Array:
    return np.tanh(preactivation, out=preactivation)


def _tanh_backward_in_numpy(signal: Array, output: Array) -> Array:
    slope = output * output
    np.subtract(1, slope, out=slope)
    slope *= signal
    return slope


def _on_arrays(function: Callable[..., th.Tensor]) -> Callable[..., Array]:
    """A function of tensors as one of NumPy arrays."""
    return lambda *arrays: function(*map(th.from_numpy, arrays)).numpy()


class Mlp:
    """Linear layers with an activation behind each but the last, run forward and backward by hand.

    :param modules: linear layers and activations in turn, beginning and ending with a linear layer
    :param memory: of the layers' parameters and gradients
    """

    def __init__(self, *modules: Any, memory: Memory):
        self.weights = [memory.array(layer.weight) for layer in modules[::2]]
        self.biases = [memory.array(layer.bias) for layer in modules[::2]]
        self.gradients = [memory.gradient(layer.weight) for layer in modules[::2]]
        self.activations = [Activation(module, memory.in_numpy) for module in modules[1::2]]
        self.linear = _linear_in_numpy if memory.in_numpy else linear
        self.xp = memory.xp

    @staticmethod
    def fits(*modules: nn.Module) -> bool:
        """Whether the modules are linear layers and known activations in turn."""
        right_types = [
            type(module) is nn.Linear and module.bias is not None if index % 2 == 0 else type(module) in ACTIVATIONS
            for index, module in enumerate(modules)
        ]
        in_place = any(getattr(module, "inplace", False) for module in modules)
        return len(modules) % 2 == 1 and all(right_types) and not in_place

    def forward(self, features: Array) -> Array:
        """Output for features of shape (B, in); each layer's input H is kept."""
        self.inputs = [features]
        for weight, bias, activation in zip(self.weights, self.biases, self.activations, strict=False):
            features = activation.forward(self.linear(features, weight, bias))
            self.inputs.append(features)
        return self.linear(features, self.weights[-1], self.biases[-1])

    def signals(self, cotangent: Array) -> list[Array]:
        """The signal Δ of shape (B, out) at each layer's output, for a cotangent of the last one."""
        signals = [cotangent]
        for weight, activation, output in zip(self.weights[:0:-1], self.activations[::-1], self.inputs[:0:-1], strict=True):
            signals.append(activation.backward(signals[-1] @ weight, output))
        return signals[::-1]

    def write_weight_gradients(self, signals: Iterable[Array]) -> None:
        """Set the gradient of each layer's weights to Δᵀ H."""
        for gradient, signal, features in zip(self.gradients, signals, self.inputs, strict=True):
            self.xp.matmul(signal.T, features, out=gradient)


def _linear_in_numpy(features: Array, weight: Array, bias: Array) -> Array:
    output = features @ weight.T
    output += bias
    return output


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
    """Categorical, multi-categorical or Bernoulli distribution; its own little graph gives the derivatives by the logits.

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
        return self.memory.array(th.autograd.grad(self._log_prob, self._logits, ones, retain_graph=True)[0])

    def score(self) -> list[Array]:
        """There is no parameter beside the logits."""
        return []

    def entropy_loss(self) -> Array:
        """Minus the mean entropy."""
        return self.memory.array(self._entropy_loss)

    def entropy_signal(self) -> Array:
        """Derivative of the entropy loss by the logits, shape (B, A)."""
        return self.memory.array(th.autograd.grad(self._entropy_loss, self._logits, retain_graph=True)[0])

    def add_entropy_gradient(self, ent_coef: float) -> None:
        """There is no parameter beside the logits."""


class Memory:
    """One block of memory for all gradients, and parameters and gradients as arrays.

    :param first: parameters whose gradients are plain sums over samples; they lie at the beginning, so that these sums, the
        norm of all gradients and their scaling are one operation each
    :param policy: has all parameters
    :param in_numpy: whether arrays are NumPy's, sharing the tensors' memory, or the tensors themselves
    """

    def __init__(self, first: list[Any], policy: nn.Module, in_numpy: bool):
        self.in_numpy, self.xp = in_numpy, np if in_numpy else th
        self._parameters = first + [p for p in policy.parameters() if all(p is not other for other in first)]
        sizes = [parameter.numel() for parameter in self._parameters]
        flat = th.zeros(sum(sizes), device=first[0].device)
        self._gradients = [piece.view_as(p) for piece, p in zip(flat.split(sizes), self._parameters, strict=True)]
        self.flat = self.array(flat)
        self.sums = self.flat[: sum(sizes[: len(first)])]

    def array(self, tensor: th.Tensor) -> Array:
        """A tensor's numbers, in its own memory."""
        return tensor.detach().numpy() if self.in_numpy else tensor.detach()

    def gradient(self, parameter: nn.Parameter) -> Array:
        """The memory of a parameter's gradient."""
        return self.array(next(g for g, p in zip(self._gradients, self._parameters, strict=True) if p is parameter))

    def attach(self) -> None:
        """Make the block the parameters' ``grad``."""
        if self._parameters[0].grad is not self._gradients[0]:
            for parameter, gradient in zip(self._parameters, self._gradients, strict=True):
                parameter.grad = gradient


@cache
def _blas() -> ThreadpoolController:
    """The BLAS libraries of this process; finding them takes milliseconds."""
    return ThreadpoolController().select(user_api="blas")


class OneBackward:
    """An actor-critic of linear layers, evaluated and differentiated by hand: what ``ManyBackwards`` does, at PPO's price.

    Under ``torch.no_grad`` call :meth:`evaluate` with a minibatch, then :meth:`gramian` and :meth:`backward`.

    :param policy: must fit, see :meth:`fits`
    :param n_samples: size of the minibatches to come; small ones on the CPU run in NumPy. None is PyTorch in any case
    """

    def __init__(self, policy: Any, n_samples: int | None = None):
        self.policy = policy
        n_parameters = sum(parameter.numel() for parameter in policy.parameters())
        limit = SMALL if th.get_num_threads() == 1 else SMALL_FOR_THREADS
        in_numpy = n_samples is not None and n_samples * n_parameters <= limit and policy.device.type == "cpu"
        actor, critic = _actor_modules(policy), _critic_modules(policy)
        gaussian = isinstance(policy.action_dist, DiagGaussianDistribution)
        biases: list[list[Any]] = [[layer.bias for layer in modules[::2]] for modules in (actor, critic)]
        self._memory = Memory([*biases[0], *([policy.log_std] if gaussian else []), *biases[1]], policy, in_numpy)
        self.actor, self.critic = Mlp(*actor, memory=self._memory), Mlp(*critic, memory=self._memory)
        self.head: GaussianHead | LogitsHead
        self.head = GaussianHead(policy, self._memory) if gaussian else LogitsHead(policy, self._memory)
        self._widths = [bias.numel() for bias in biases[0]]
        extractor, space = policy.pi_features_extractor, policy.observation_space
        # Vectors pass through SB3's preprocessing and flattening as they are.
        self._takes_vectors = type(extractor) is FlattenExtractor and isinstance(space, spaces.Box) and len(space.shape) == 1

    @property
    def in_numpy(self) -> bool:
        """Whether arrays are NumPy's."""
        return self._memory.in_numpy

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

    def one_thread(self) -> AbstractContextManager[Any]:
        """Hold NumPy's BLAS, where it is used, to one thread: several would wait for each other longer than they work."""
        return _blas().limit(limits=1) if self.in_numpy else nullcontext()

    def array(self, tensor: th.Tensor) -> Array:
        """A tensor of the minibatch in the form that the other methods take and return."""
        return self._memory.array(tensor)

    def evaluate(self, observations: Any, actions: th.Tensor) -> OneBackward:
        """Forward pass of actor and critic; sets ``values`` (B, K) and ``log_prob`` (B,)."""
        if self._takes_vectors:
            features = observations.float()
        else:
            features = BasePolicy.extract_features(self.policy, observations, self.policy.pi_features_extractor)
        features = self.array(features)
        self.values = self.critic.forward(features)
        self.log_prob = self.head.forward(self.actor.forward(features), actions)
        return self

    def gramian(self, cotangents: Array, n_samples: int | None = None) -> Array:
        """Gramian of the component gradients, shape (K, K).

        :param cotangents: of log π, shape (B, K)
        :param n_samples: take the first n rows of the minibatch instead of all; they are in random order already
        """
        signals = self.actor.signals(self.head.signal())
        self._added = self._memory.xp.concatenate([*signals, *self.head.score()], 1)  # ∂log π/∂bias of all layers, and S
        inputs, added = self.actor.inputs, self._added
        if n_samples is not None:
            signals, inputs = ([array[:n_samples] for array in arrays] for arrays in (signals, inputs))
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
            added = concatenate(self.actor.signals(self.head.signal() * column + ent_coef * entropy_signal), 1)
        critic_signals = self.critic.signals(value_cotangents)
        ends = list(accumulate(self._widths))
        self.actor.write_weight_gradients(added[:, end - n : end] for n, end in zip(self._widths, ends, strict=True))
        self.critic.write_weight_gradients(critic_signals)
        self._memory.sums[:] = concatenate([added, *critic_signals], 1).sum(0)
        if ent_coef != 0:
            self.head.add_entropy_gradient(ent_coef)

    def clip_gradients(self, max_norm: float) -> float:
        """Scale all gradients down to a joint norm of at most ``max_norm``, as ``clip_grad_norm_``; the norm before."""
        flat = self._memory.flat
        norm = math.sqrt(float(flat @ flat))
        if norm > max_norm:
            flat *= max_norm / (norm + 1e-6)
        return norm


def layer_gramian(signals: list[Array], inputs: list[Array], added: Array, cotangents: Array) -> Array:
    """Gramian of the K gradients Σ_b c_b^(k) (δ_b h_bᵀ, …, a_b) over all layers; per layer the cheaper of two exact forms.

    :param signals: Δ of each layer, shapes (B, out)
    :param inputs: H of each layer, shapes (B, in)
    :param added: derivatives a_b by parameters that each sample has a number of its own for, biases and log σ, shape (B, n)
    :param cotangents: c, shape (B, K)
    :return: G, shape (K, K)
    """
    n_samples, n_objectives = cotangents.shape
    jacobian = cotangents.T @ added
    gramian = jacobian @ jacobian.T
    few = []
    for signal, features in zip(signals, inputs, strict=True):
        n_outputs, n_inputs = signal.shape[1], features.shape[1]
        if 0.6 * n_samples * (n_outputs + n_inputs + ELEMENTWISE) <= n_objectives * n_outputs * n_inputs:
            few.append((signal, features))
        else:
            gramian += _gramian_by_weights(signal, features, cotangents)
    if few:
        gramian += _gramian_by_samples(few, cotangents)
    return gramian


def _gramian_by_samples(layers: list[tuple[Array, Array]], cotangents: Array) -> Array:
    """Cᵀ M C with M = Σ_layers (Δ Δᵀ) ∘ (H Hᵀ), by blocks of rows; of the symmetric M only the upper half."""
    n_samples = len(cotangents)
    if n_samples <= WHOLE:
        return _rows_of_products([(s, s, h, h) for s, h in layers], cotangents) @ cotangents
    half: Array = 0.0
    height = min(HIGHEST, max(LOWEST, n_samples // 4))
    for start in range(0, n_samples, height):
        rows, columns = slice(start, start + height), slice(start, n_samples)
        left = _rows_of_products([(s[rows], s[columns], h[rows], h[columns]) for s, h in layers], cotangents[rows])
        left[:, :height] *= 0.5  # the square on the diagonal is symmetric itself
        half = half + left @ cotangents[columns]
    return half + half.T


def _rows_of_products(layers: list[tuple[Array, ...]], cotangents: Array) -> Array:
    """Cᵀ M for a block of M's rows and columns: much faster than M C, which has K columns instead of K rows.

    :param layers: Δ and H of each layer, in the block's rows and columns: (Δ_rows, Δ_columns, H_rows, H_columns)
    :param cotangents: C in the block's rows
    """
    block: Array = None
    for signal, other_signal, features, other_features in layers:
        products = signal @ other_signal.T
        products *= features @ other_features.T
        if block is None:
            block = products
        else:
            block += products
    return cotangents.T @ block


def _gramian_by_weights(signal: Array, features: Array, cotangents: Array) -> Array:
    """J Jᵀ with the K weight gradients (Δ ∘ c^(k))ᵀ H as rows, a block of output units at a time."""
    n_samples, n_objectives = cotangents.shape
    block = BLOCK_ON_DEVICE if isinstance(signal, th.Tensor) and signal.device.type != "cpu" else BLOCK
    height = max(1, block // (n_objectives * max(n_samples, features.shape[1])))
    gramian: Array = 0.0
    for start in range(0, signal.shape[1], height):
        units = signal.T[start : start + height]
        weighted = (cotangents.T[:, None] * units).reshape(-1, n_samples)  # (K · units, B)
        jacobian = (weighted @ features).reshape(n_objectives, -1)
        gramian = gramian + jacobian @ jacobian.T
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

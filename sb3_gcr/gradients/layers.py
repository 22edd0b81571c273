"""Linear layers and activations, run forward and backward by hand."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np
import torch as th
from torch import nn
from torch.nn.functional import linear

from sb3_gcr.gradients.memory import Array, Memory

_aten = th.ops.aten


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
    """Hyperbolic tangent in place; on the CPU by NumPy, which takes a fifth of PyTorch's time on an
    AMD EPYC.
    """
    if preactivation.device.type != "cpu":
        return preactivation.tanh_()
    _tanh_in_numpy(preactivation.numpy())
    return preactivation


class Activation:
    """An activation behind a linear layer, and its derivative: closed where that is cheap,
    PyTorch's elsewhere.

    :param module: of a type in ``ACTIVATIONS``
    :param in_numpy: whether :meth:`forward` and :meth:`backward` take and return NumPy arrays
    """

    def __init__(self, module: nn.Module, in_numpy: bool = False):
        # The functions themselves: a call of a module costs as much as the arithmetic of a small
        # layer.
        self.forward: Callable[[Array], Array] = module.forward
        if isinstance(module, nn.Tanh):
            self.forward, self.backward = tanh_, _aten.tanh_backward.default
        elif isinstance(module, nn.ReLU):
            self.forward, self.backward = (
                th.relu,
                partial(_aten.threshold_backward.default, threshold=0),
            )
        elif isinstance(module, nn.ELU):
            alpha = module.alpha
            self.backward = lambda signal, output: _aten.elu_backward.default(
                signal, alpha, 1, 1, True, output
            )
        else:
            self.forward, self.backward = (
                partial(self._forward_with_graph, module),
                self._backward_through_graph,
            )
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
            type(module) is nn.Linear and module.bias is not None
            if index % 2 == 0
            else type(module) in ACTIVATIONS
            for index, module in enumerate(modules)
        ]
        in_place = any(getattr(module, "inplace", False) for module in modules)
        return len(modules) % 2 == 1 and all(right_types) and not in_place

    def forward(self, features: Array) -> Array:
        """Output for features of shape (B, in); each layer's input H is kept."""
        self.inputs = [features]
        for weight, bias, activation in zip(
            self.weights, self.biases, self.activations, strict=False
        ):
            features = activation.forward(self.linear(features, weight, bias))
            self.inputs.append(features)
        return self.linear(features, self.weights[-1], self.biases[-1])

    def signals(self, cotangent: Array) -> list[Array]:
        """The signal Δ of shape (B, out) at each layer's output, for a cotangent of the last
        one.
        """
        signals = [cotangent]
        for weight, activation, output in zip(
            self.weights[:0:-1], self.activations[::-1], self.inputs[:0:-1], strict=True
        ):
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

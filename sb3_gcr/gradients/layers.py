"""Linear layers and activations, run forward and backward by hand."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn
from torch.nn.functional import linear

from sb3_gcr.gradients.memory import Array, Memory

Numbers = NDArray[np.float32]

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
_aten = th.ops.aten


class Mlp:
    """Linear layers with an activation behind each but the last.

    :param modules: linear layers and activations in turn, from a linear layer to a linear layer
    :param memory: of the layers' parameters and gradients
    """

    def __init__(self, modules: Sequence[Any], memory: Memory):
        layers, activations = modules[::2], modules[1::2]
        self.weights = [memory.array(layer.weight) for layer in layers]
        self.biases = [memory.array(layer.bias) for layer in layers]
        self.gradients = [memory.gradient(layer.weight) for layer in layers]
        self.activations = [Activation(module, memory.in_numpy) for module in activations]
        self._linear = _linear_in_numpy if memory.in_numpy else linear
        self._matmul = memory.xp.matmul

    def forward(self, features: Array) -> Array:
        """Output, shape (B, out), for features of shape (B, in); each layer's input H is kept."""
        self.inputs = [features]
        hidden = zip(self.weights, self.biases, self.activations, strict=False)
        for weight, bias, activation in hidden:
            features = activation.forward(self._linear(features, weight, bias))
            self.inputs.append(features)
        return self._linear(features, self.weights[-1], self.biases[-1])

    def signals(self, cotangent: Array) -> list[Array]:
        """The signal Δ at each layer's output, shapes (B, out), for a cotangent of the last one."""
        signals = [cotangent]
        upwards = zip(self.weights[1:], self.activations, self.inputs[1:], strict=True)
        for weight, activation, output in reversed(list(upwards)):
            signals.append(activation.backward(signals[-1] @ weight, output))
        return signals[::-1]

    def write_weight_gradients(self, signals: Iterable[Array]) -> None:
        """Set the gradient of each layer's weights to Δᵀ H."""
        for gradient, signal, features in zip(self.gradients, signals, self.inputs, strict=True):
            self._matmul(signal.T, features, out=gradient)


class Activation:
    """An activation, and its derivative: closed where that is cheap, PyTorch's elsewhere.

    :param module: of a type in ``ACTIVATIONS``
    :param in_numpy: whether :meth:`forward` and :meth:`backward` take and return NumPy arrays
    """

    #: Output of the activation, which may overwrite its input.
    forward: Callable[[Array], Array]
    #: Signal in front of the activation, from the one behind it and the activation's output.
    backward: Callable[[Array, Array], Array]

    def __init__(self, module: nn.Module, in_numpy: bool = False):
        # The functions themselves: a call of a module costs as much as a small layer's arithmetic.
        self.forward, self.backward = self._in_pytorch(module)
        if in_numpy and isinstance(module, nn.Tanh):
            self.forward, self.backward = _tanh_in_numpy, _tanh_backward_in_numpy
        elif in_numpy:
            self.forward, self.backward = _on_arrays(self.forward), _on_arrays(self.backward)

    def _in_pytorch(
        self, module: nn.Module
    ) -> tuple[Callable[[th.Tensor], th.Tensor], Callable[[th.Tensor, th.Tensor], th.Tensor]]:
        """Forward and backward on tensors."""
        if isinstance(module, nn.Tanh):
            return tanh_, _aten.tanh_backward.default
        if isinstance(module, nn.ReLU):
            return th.relu, partial(_aten.threshold_backward.default, threshold=0)
        if isinstance(module, nn.ELU):
            alpha = module.alpha
            elu_backward = _aten.elu_backward.default
            return module.forward, lambda d, output: elu_backward(d, alpha, 1, 1, True, output)
        return partial(self._forward_with_graph, module), self._backward_through_graph

    def _forward_with_graph(self, module: nn.Module, preactivation: th.Tensor) -> th.Tensor:
        with th.enable_grad():
            self._input = preactivation.detach().requires_grad_()
            self._output: th.Tensor = module(self._input)
        return self._output.detach()

    def _backward_through_graph(self, signal: th.Tensor, output: th.Tensor) -> th.Tensor:
        return th.autograd.grad(self._output, self._input, signal, retain_graph=True)[0]


def tanh_(preactivation: th.Tensor) -> th.Tensor:
    """Hyperbolic tangent in place; on the CPU by NumPy, in a fifth of PyTorch's time on an AMD
    EPYC.
    """
    if preactivation.device.type != "cpu":
        return preactivation.tanh_()
    _tanh_in_numpy(preactivation.numpy())
    return preactivation


def _tanh_in_numpy(preactivation: Numbers) -> Numbers:
    return np.tanh(preactivation, out=preactivation)


def _tanh_backward_in_numpy(signal: Numbers, output: Numbers) -> Numbers:
    """Signal · (1 - tanh²)."""
    slope = output * output
    np.subtract(1, slope, out=slope)
    slope *= signal
    return slope


def _linear_in_numpy(features: Numbers, weight: Numbers, bias: Numbers) -> Numbers:
    output = features @ weight.T
    output += bias
    return output


def _on_arrays(function: Callable[..., th.Tensor]) -> Callable[..., Array]:
    """A function of tensors as one of NumPy arrays."""
    return lambda *arrays: function(*map(th.from_numpy, arrays)).numpy()

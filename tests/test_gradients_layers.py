"""Linear layers and activations by hand: numbers, and PyTorch's own modules."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_gcr.gradients.layers import ACTIVATIONS, Mlp
from sb3_gcr.gradients.memory import Memory


def memory_of(net: Any, in_numpy: bool) -> Memory:
    return Memory([net[0].bias], net, in_numpy)


@pytest.mark.parametrize("in_numpy", [False, True])
def test_two_layers_by_hand(in_numpy: bool) -> None:
    """h = relu(2 x - 1), y = 3 h + 1 for x = 2 and x = 0: h = 3 and 0, y = 10 and 1."""
    net = nn.Sequential(nn.Linear(1, 1), nn.ReLU(), nn.Linear(1, 1))
    with th.no_grad():
        for parameter, number in zip(net.parameters(), (2, -1, 3, 1), strict=True):
            parameter.fill_(number)
    memory = memory_of(net, in_numpy)
    mlp = Mlp([*net], memory)
    xp: Any = np.array if in_numpy else th.tensor
    features = xp([[2.0], [0.0]], dtype=np.float32 if in_numpy else th.float32)
    assert mlp.forward(features).tolist() == [[10.0], [1.0]]
    signals = mlp.signals(xp([[1.0], [4.0]], dtype=features.dtype))
    # behind the last layer the cotangent itself; in front of relu 3 where it is on
    assert [signal.tolist() for signal in signals] == [[[3.0], [0.0]], [[1.0], [4.0]]]
    mlp.write_weight_gradients(signals)
    memory.attach()
    assert net[0].weight.grad.tolist() == [[6.0]]  # 3 · 2
    assert net[2].weight.grad.tolist() == [[3.0]]  # 1 · 3


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("in_numpy", [False, True])
@th.no_grad()
def test_activations_are_pytorchs(activation: Any, in_numpy: bool) -> None:
    """Also where preactivations are large, and twice in a row."""
    th.manual_seed(0)
    net = nn.Sequential(
        nn.Linear(3, 4), activation(), nn.Linear(4, 4), activation(), nn.Linear(4, 2)
    )
    memory = memory_of(net, in_numpy)
    mlp = Mlp([*net], memory)
    for scale in (1.0, 10.0):
        features, cotangent = scale * th.randn(6, 3), th.randn(6, 2)
        output = mlp.forward(memory.array(features.clone()))
        signals = mlp.signals(memory.array(cotangent))
        mlp.write_weight_gradients(signals)
        memory.attach()
        found = [net[index].weight.grad.clone() for index in (0, 2, 4)]
        with th.enable_grad():
            expected = net(features)
            gradients = th.autograd.grad(expected, list(net.parameters()), cotangent)
        th.testing.assert_close(th.as_tensor(output), expected.detach(), rtol=1e-4, atol=1e-5)
        for mine, its in zip(found, gradients[::2], strict=True):
            th.testing.assert_close(mine, its, rtol=1e-3, atol=1e-4)
        for signal, its in zip(signals, gradients[1::2], strict=True):
            th.testing.assert_close(th.as_tensor(signal).sum(0), its, rtol=1e-3, atol=1e-4)

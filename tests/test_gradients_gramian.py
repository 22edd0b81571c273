"""The Gramian from one backward pass: numbers by hand, and the Jacobian written out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_gcr.gradients.gramian import (
    Layer,
    component_gramian,
    gramian_by_samples,
    gramian_by_weights,
)

# Two samples, a layer of one unit with a bias. δ = 1, 2 and h = 3, 1, so the derivatives of log π
# by weight and bias are (3, 1) and (2, 2).
SIGNALS, INPUTS, SCORES = [[1.0], [2.0]], [[3.0], [1.0]], [[1.0], [2.0]]
# g^(1) = 1 (3, 1) + 2 (2, 2) = (7, 5) and g^(2) = -1 (3, 1) + 1 (2, 2) = (-1, 1).
COTANGENTS = [[1.0, -1.0], [2.0, 1.0]]
OF_WEIGHT = [[49.0, -7.0], [-7.0, 1.0]]
OF_BOTH = [[74.0, -2.0], [-2.0, 2.0]]
OF_TWO_LAYERS = [[123.0, -9.0], [-9.0, 3.0]]


@pytest.mark.parametrize("xp", [th.tensor, np.array])
def test_two_samples_and_one_unit_by_hand(xp: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """In one piece, and row by row."""
    layer, cotangents = Layer(xp(SIGNALS), xp(INPUTS)), xp(COTANGENTS)
    assert gramian_by_weights(layer, cotangents).tolist() == OF_WEIGHT
    for whole, lowest in ((128, 64), (0, 1)):
        monkeypatch.setattr("sb3_gcr.gradients.gramian.WHOLE", whole)
        monkeypatch.setattr("sb3_gcr.gradients.gramian.LOWEST", lowest)
        assert gramian_by_samples([layer], cotangents).tolist() == OF_WEIGHT
        assert component_gramian([layer], xp(SCORES), cotangents).tolist() == OF_BOTH
        two = component_gramian([layer, layer], xp(SCORES), cotangents)
        assert two.tolist() == OF_TWO_LAYERS
    assert component_gramian([], xp(SCORES), cotangents).tolist() == [[25.0, 5.0], [5.0, 1.0]]


def test_cotangents_that_are_zero_have_no_gradient() -> None:
    layer = Layer(np.array(SIGNALS), np.array(INPUTS))
    cotangents = np.array([[1.0, 0.0], [2.0, 0.0]])
    found = component_gramian([layer], np.array(SCORES), cotangents)
    assert found.tolist() == [[74.0, 0.0], [0.0, 0.0]]


@pytest.mark.parametrize(
    ("n_samples", "n_components", "sizes"),
    [
        (40, 3, [(5, 4), (4, 2)]),
        (700, 3, [(90, 80), (80, 2)]),
        (1500, 2, [(3, 300), (300, 40)]),
        (600, 12, [(200, 200)]),
    ],
)
@pytest.mark.parametrize("block", [2**10, 2**22])
@pytest.mark.parametrize("width", [1, 7])
def test_both_forms_of_the_gramian(
    monkeypatch: pytest.MonkeyPatch,
    n_samples: int,
    n_components: int,
    sizes: Any,
    block: int,
    width: int,
) -> None:
    """Small and large minibatches, in one block or many, against the Jacobian written out."""
    monkeypatch.setattr("sb3_gcr.gradients.gramian.BLOCK", block)
    th.manual_seed(0)
    cotangents = th.randn(n_samples, n_components, dtype=th.double)
    signals = [th.randn(n_samples, out, dtype=th.double) for _, out in sizes]
    inputs = [th.randn(n_samples, size, dtype=th.double) for size, _ in sizes]
    added = th.randn(n_samples, width, dtype=th.double)
    rows = []
    for k in range(n_components):
        c = cotangents[:, k]
        parts = [
            th.einsum("b,bo,bi->oi", c, s, h).flatten()
            for s, h in zip(signals, inputs, strict=True)
        ]
        parts.append(c @ added)
        rows.append(th.cat(parts))
    expected = th.stack(rows) @ th.stack(rows).T
    layers = [Layer(*pair) for pair in zip(signals, inputs, strict=True)]
    th.testing.assert_close(component_gramian(layers, added, cotangents), expected)
    arrays = [Layer(layer.signals.numpy(), layer.inputs.numpy()) for layer in layers]
    actual = component_gramian(arrays, added.numpy(), cotangents.numpy())
    np.testing.assert_allclose(actual, expected, rtol=1e-7, atol=1e-9)

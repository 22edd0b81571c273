"""The exact Gramian of K component gradients from one backward pass.

With c_b^(k) = ∂L^(k)/∂log π_b the gradient of component k is g^(k) = Σ_b c_b^(k) ∂log π_b/∂θ.
Reverse mode is linear in the cotangent and samples do not mix, so one backward pass of Σ_b log π_b
gives every layer's signal Δ = (δ_b) for all K. With the layer's input H = (h_b), the scores
S = (∂log π_b/∂θ_own) of parameters that each sample has a number of its own for (biases, log σ),
and C = (c^(1) … c^(K)),

    G = Cᵀ M C,    M = Σ_layers (Δ Δᵀ) ∘ (H Hᵀ) + S Sᵀ,

since ⟨δ_a h_aᵀ, δ_b h_bᵀ⟩ = (δ_a·δ_b)(h_a·h_b). M is B×B and serves every K. Where B is large, the
K weight gradients (Δ ∘ c^(k))ᵀ H themselves are cheaper; both forms are exact.

Pure functions on NumPy arrays or tensors.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch as th

from sb3_gcr.gradients.memory import Array

#: Numbers that a block of K weight gradients may hold at a time, on the CPU.
BLOCK = 2**22
#: The same on other devices.
BLOCK_ON_DEVICE = 2**26
#: Minibatches up to this size get M in one piece.
WHOLE = 128
#: Of larger ones only the upper half is computed, by blocks of rows of at least this height.
LOWEST = 64
#: And at most this.
HIGHEST = 256
#: Operations on the elements of M count like so many columns of Δ and H.
ELEMENTWISE = 30
#: Time of a multiplication in M's symmetric half, relative to one in the weight gradients.
HALF = 0.6


class Layer(NamedTuple):
    """What one backward pass says of a linear layer."""

    signals: Array
    """Δ, derivatives of log π_b by the layer's output, shape (B, out)."""
    inputs: Array
    """H, the layer's input, shape (B, in)."""


def component_gramian(layers: list[Layer], scores: Array, cotangents: Array) -> Array:
    """G of the K gradients; for each layer by the cheaper of the two exact forms.

    :param layers: Δ and H of each layer
    :param scores: S, shape (B, n)
    :param cotangents: C, shape (B, K)
    :return: G, shape (K, K)
    """
    jacobian = cotangents.T @ scores
    gramian = jacobian @ jacobian.T
    by_samples = []
    for layer in layers:
        if _prefers_samples(layer, cotangents):
            by_samples.append(layer)
        else:
            gramian += gramian_by_weights(layer, cotangents)
    if by_samples:
        gramian += gramian_by_samples(by_samples, cotangents)
    return gramian


def own_products(layers: list[Layer], scores: Array, cotangents: Array) -> Array:
    r"""Cᵀ diag(M) C: the part of G in which a sample meets itself, and with it the noise that the K
    gradients share.

    .. math:: M_{bb} = \sum_{layers} |δ_b|^2 |h_b|^2 + |s_b|^2

    :param layers: Δ and H of each layer
    :param scores: S, shape (B, n)
    :param cotangents: C, shape (B, K)
    :return: shape (K, K)
    """
    squares = _squared_rows(scores)
    for signals, inputs in layers:
        squares = squares + _squared_rows(signals) * _squared_rows(inputs)
    return (cotangents.T * squares) @ cotangents


def _squared_rows(rows: Array) -> Array:
    """|row|², shape (B,)."""
    if isinstance(rows, th.Tensor):
        return rows.square().sum(1)
    return np.einsum("bi,bi->b", rows, rows)


def without_own(gramian: Array, own: Array, n_samples: int) -> Array:
    r"""An unbiased Gramian: the mean over pairs of different samples alone.

    .. math:: Ĝ = \frac{B}{B-1} (C^T M C - C^T \mathrm{diag}(M) C)

    :param gramian: G of the means over B samples, shape (K, K)
    :param own: of :func:`own_products`, shape (K, K)
    :param n_samples: B ≥ 2
    :return: Ĝ, shape (K, K)
    """
    return n_samples / (n_samples - 1) * (gramian - own)


def _prefers_samples(layer: Layer, cotangents: Array) -> bool:
    """Whether B² (in + out) costs less than K B in out."""
    n_samples, n_components = cotangents.shape
    n_outputs, n_inputs = layer.signals.shape[1], layer.inputs.shape[1]
    by_samples = HALF * n_samples * (n_outputs + n_inputs + ELEMENTWISE)
    return by_samples <= n_components * n_outputs * n_inputs


def gramian_by_samples(layers: list[Layer], cotangents: Array) -> Array:
    """Cᵀ M C by blocks of rows; of the symmetric M = Σ (Δ Δᵀ) ∘ (H Hᵀ) only the upper half.

    :param layers: Δ and H of each layer
    :param cotangents: C, shape (B, K)
    :return: shape (K, K)
    """
    n_samples = len(cotangents)
    if n_samples <= WHOLE:
        every = slice(None)
        return _block_product(layers, cotangents, every, every) @ cotangents
    half: Array = 0.0
    height = min(HIGHEST, max(LOWEST, n_samples // 4))
    for start in range(0, n_samples, height):
        rows, columns = slice(start, start + height), slice(start, n_samples)
        product = _block_product(layers, cotangents, rows, columns)
        product[:, :height] *= 0.5  # the square on the diagonal is symmetric itself
        half = half + product @ cotangents[columns]
    return half + half.T


def _block_product(layers: list[Layer], cotangents: Array, rows: slice, columns: slice) -> Array:
    """Cᵀ M for a block of M: much faster than M C, which has K columns instead of K rows.

    :param layers: Δ and H of each layer
    :param cotangents: C, shape (B, K)
    :param rows: rows of M
    :param columns: columns of M
    :return: shape (K, columns)
    """
    block: Array = None
    for signals, inputs in layers:
        products = signals[rows] @ signals[columns].T
        products *= inputs[rows] @ inputs[columns].T
        if block is None:
            block = products
        else:
            block += products
    return cotangents[rows].T @ block


def gramian_by_weights(layer: Layer, cotangents: Array) -> Array:
    """J Jᵀ with the K weight gradients (Δ ∘ c^(k))ᵀ H as rows, a block of output units at a time.

    :param layer: Δ and H
    :param cotangents: C, shape (B, K)
    :return: shape (K, K)
    """
    signals, inputs = layer
    n_samples, n_components = cotangents.shape
    on_device = isinstance(signals, th.Tensor) and signals.device.type != "cpu"
    block = BLOCK_ON_DEVICE if on_device else BLOCK
    height = max(1, block // (n_components * max(n_samples, inputs.shape[1])))
    gramian: Array = 0.0
    for start in range(0, signals.shape[1], height):
        units = signals.T[start : start + height]
        weighted = (cotangents.T[:, None] * units).reshape(-1, n_samples)  # (K · units, B)
        jacobian = (weighted @ inputs).reshape(n_components, -1)
        gramian = gramian + jacobian @ jacobian.T
    return gramian

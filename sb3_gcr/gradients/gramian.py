"""The exact Gramian of K component gradients from one backward pass."""

from __future__ import annotations

import torch as th

from sb3_gcr.gradients.memory import Array

#: Numbers that a block of K weight gradients may hold at a time, on the CPU and on other devices.
BLOCK, BLOCK_ON_DEVICE = 2**22, 2**26


#: Minibatches up to this size get M in one piece; of larger ones only the upper half, by blocks of
#: rows of these heights.
WHOLE, LOWEST, HIGHEST = 128, 64, 256


#: Operations on the elements of M count like so many columns of Δ and H.
ELEMENTWISE = 30


def layer_gramian(
    signals: list[Array], inputs: list[Array], added: Array, cotangents: Array
) -> Array:
    """Gramian of the K gradients Σ_b c_b^(k) (δ_b h_bᵀ, …, a_b) over all layers; per layer the
    cheaper of two exact forms.

    :param signals: Δ of each layer, shapes (B, out)
    :param inputs: H of each layer, shapes (B, in)
    :param added: derivatives a_b by parameters that each sample has a number of its own for, biases
        and log σ, shape (B, n)
    :param cotangents: c, shape (B, K)
    :return: G, shape (K, K)
    """
    n_samples, n_objectives = cotangents.shape
    jacobian = cotangents.T @ added
    gramian = jacobian @ jacobian.T
    few = []
    for signal, features in zip(signals, inputs, strict=True):
        n_outputs, n_inputs = signal.shape[1], features.shape[1]
        if (
            0.6 * n_samples * (n_outputs + n_inputs + ELEMENTWISE)
            <= n_objectives * n_outputs * n_inputs
        ):
            few.append((signal, features))
        else:
            gramian += _gramian_by_weights(signal, features, cotangents)
    if few:
        gramian += _gramian_by_samples(few, cotangents)
    return gramian


def _gramian_by_samples(layers: list[tuple[Array, Array]], cotangents: Array) -> Array:
    """Cᵀ M C with M = Σ_layers (Δ Δᵀ) ∘ (H Hᵀ), by blocks of rows; of the symmetric M only the
    upper half.
    """
    n_samples = len(cotangents)
    if n_samples <= WHOLE:
        return _rows_of_products([(s, s, h, h) for s, h in layers], cotangents) @ cotangents
    half: Array = 0.0
    height = min(HIGHEST, max(LOWEST, n_samples // 4))
    for start in range(0, n_samples, height):
        rows, columns = slice(start, start + height), slice(start, n_samples)
        left = _rows_of_products(
            [(s[rows], s[columns], h[rows], h[columns]) for s, h in layers], cotangents[rows]
        )
        left[:, :height] *= 0.5  # the square on the diagonal is symmetric itself
        half = half + left @ cotangents[columns]
    return half + half.T


def _rows_of_products(layers: list[tuple[Array, ...]], cotangents: Array) -> Array:
    """Cᵀ M for a block of M's rows and columns: much faster than M C, which has K columns instead
    of K rows.

    :param layers: Δ and H of each layer, in the block's rows and columns: (Δ_rows, Δ_columns,
        H_rows, H_columns)
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
    """J Jᵀ with the K weight gradients (Δ ∘ c^(k))ᵀ H as rows, a block of output units at a
    time.
    """
    n_samples, n_objectives = cotangents.shape
    block = (
        BLOCK_ON_DEVICE if isinstance(signal, th.Tensor) and signal.device.type != "cpu" else BLOCK
    )
    height = max(1, block // (n_objectives * max(n_samples, features.shape[1])))
    gramian: Array = 0.0
    for start in range(0, signal.shape[1], height):
        units = signal.T[start : start + height]
        weighted = (cotangents.T[:, None] * units).reshape(-1, n_samples)  # (K · units, B)
        jacobian = (weighted @ features).reshape(n_objectives, -1)
        gramian = gramian + jacobian @ jacobian.T
    return gramian

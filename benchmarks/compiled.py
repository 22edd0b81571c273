"""What ``torch.compile`` would save: a minibatch as two pure functions, eager and compiled; ``python -m benchmarks.compiled``.

Needs a C++ compiler. The two functions are those of a 64×64 tanh network with a Gaussian head, without clipping and Adam.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import torch as th

from benchmarks.pieces import microseconds

Tensors = list[th.Tensor]
OBS, ACTIONS, HIDDEN = 348, 17, 64


def until_the_gramian(weights: Tensors, observations: th.Tensor, batch: Tensors) -> tuple[th.Tensor, Tensors]:
    """Forward pass, losses, signals and Gramian: figures for the host, and what the backward pass needs."""
    w1, b1, w2, b2, w3, b3, v1, c1, v2, c2, v3, c3, log_std = weights
    actions, old_log_prob, advantages, returns = batch
    h1 = th.tanh(th.addmm(b1, observations, w1.T))
    h2 = th.tanh(th.addmm(b2, h1, w2.T))
    f1 = th.tanh(th.addmm(c1, observations, v1.T))
    f2 = th.tanh(th.addmm(c2, f1, v2.T))
    error = th.addmm(c3, f2, v3.T) - returns
    scale = th.exp(-log_std)
    z = (actions - th.addmm(b3, h2, w3.T)) * scale
    log_ratio = -0.5 * (z * z).sum(1) - log_std.sum() - old_log_prob
    ratio = log_ratio.exp().unsqueeze(1)
    surrogate, clipped = ratio * advantages, ratio.clamp(0.8, 1.2) * advantages
    cotangents = th.where(surrogate <= clipped, surrogate, 0.0) / -len(observations)
    d3 = z * scale
    d2 = (d3 @ w3) * (1 - h2 * h2)
    d1 = (d2 @ w2) * (1 - h1 * h1)
    score = z * z - 1
    m = (d3 @ d3.T) * (h2 @ h2.T + 1) + (d2 @ d2.T) * (h1 @ h1.T + 1) + (d1 @ d1.T) * (observations @ observations.T + 1)
    gramian = cotangents.T @ ((m + score @ score.T) @ cotangents)
    kl = (ratio.squeeze(1) - 1 - log_ratio).mean()
    figures = [gramian.flatten(), -th.min(surrogate, clipped).mean(0), (error * error).mean(0), kl.reshape(1)]
    return th.cat(figures), [cotangents, error / len(error), d1, d2, d3, h1, h2, f1, f2, score]


def after_the_resolver(weights: Tensors, observations: th.Tensor, resolved: th.Tensor, kept: Tensors) -> Tensors:
    """Gradients of all parameters for the resolved weights."""
    v2, v3 = weights[8], weights[10]
    cotangents, e3, d1, d2, d3, h1, h2, f1, f2, score = kept
    c = (cotangents @ resolved).unsqueeze(1)
    e2 = (e3 @ v3) * (1 - f2 * f2)
    e1 = (e2 @ v2) * (1 - f1 * f1)
    layers = [(d1 * c, observations), (d2 * c, h1), (d3 * c, h2), (e1, observations), (e2, f1), (e3, f2)]
    return [gradient for signal, inputs in layers for gradient in (signal.T @ inputs, signal.sum(0))] + [score.T @ c]


def inputs(n_samples: int, n_components: int) -> tuple[Tensors, th.Tensor, Tensors, th.Tensor]:
    """Random networks and a random minibatch."""
    th.manual_seed(0)
    sizes = [(OBS, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, ACTIONS), (OBS, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, n_components)]
    weights = [tensor for i, o in sizes for tensor in (0.1 * th.randn(o, i), th.zeros(o))] + [th.zeros(ACTIONS)]
    shapes = [(n_samples, ACTIONS), (n_samples,), (n_samples, n_components), (n_samples, n_components)]
    return weights, th.randn(n_samples, OBS), [th.randn(shape) for shape in shapes], th.ones(n_components)


@th.no_grad()
def main() -> None:
    """Print one line per setting."""
    th.set_num_threads(1)
    for n_samples, n_components in ((64, 4), (256, 10)):
        weights, observations, batch, resolved = inputs(n_samples, n_components)

        def update(first: Any, second: Any) -> None:
            _, kept = first(weights, observations, batch)  # noqa: B023
            second(weights, observations, resolved, kept)  # noqa: B023

        compiled = th.compile(until_the_gramian), th.compile(after_the_resolver)
        start = time.perf_counter()
        update(*compiled)
        seconds = time.perf_counter() - start
        eager = microseconds(partial(update, until_the_gramian, after_the_resolver))
        fast = microseconds(partial(update, *compiled))
        print(f"B={n_samples} K={n_components}: eager {eager:.0f} µs, compiled {fast:.0f} µs, {seconds:.0f} s to compile")


if __name__ == "__main__":
    main()

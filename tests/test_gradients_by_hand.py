"""The actor-critic by hand against the one by autograd."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th

from sb3_gcr.gradients.by_autograd import ByAutograd
from sb3_gcr.gradients.by_hand import ByHand
from sb3_gcr.gradients.fitting import fits
from tests.networks import FITTING, B, K, make_policy


@pytest.mark.parametrize("name", list(FITTING))
@pytest.mark.parametrize("ent_coef", [0.0, 0.7])
@pytest.mark.parametrize("n_samples", [None, B])
@th.no_grad()
def test_one_backward_is_k_backwards(name: str, ent_coef: float, n_samples: int | None) -> None:
    """Values, log π, entropy, Gramian, the resolved gradient and its clipping, to float32 rounding,
    in PyTorch and NumPy.
    """
    policy, observations = make_policy(**FITTING[name])
    policy.set_training_mode(True)
    assert fits(policy)
    with th.no_grad():
        actions = policy(observations)[0]
    if FITTING[name].get("action") == "Discrete":
        actions = actions.flatten()
    cotangents, value_cotangents = th.randn(B, K), th.randn(B, K)
    weights = np.random.default_rng(0).random(K)
    results = []
    for networks in (ByAutograd(policy), ByHand(policy, n_samples)):
        values, log_prob = networks.evaluate(observations, actions)
        mine, its = networks.array(cotangents), networks.array(value_cotangents)
        gramian = networks.gramian(mine)
        subset = networks.gramian(mine, n_samples=10)
        numbers = [values, log_prob, networks.entropy_loss().reshape(())]
        networks.backward(mine, weights, its, ent_coef)
        norm = networks.clip_gradients(0.5)
        gradients = [parameter.grad.clone() for parameter in policy.parameters()]
        results.append(
            [
                th.as_tensor(t).detach()
                for t in (gramian, subset, *numbers, th.tensor(norm), *gradients)
            ]
        )
    assert networks.way.endswith("PyTorch" if n_samples is None else "NumPy")
    for expected, actual in zip(*results, strict=True):
        th.testing.assert_close(
            actual, expected, rtol=2e-4, atol=2e-5 * max(1.0, float(expected.abs().max()))
        )

"""Distributions of actions: numbers by hand, and PyTorch's own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_gcr.gradients.heads import head_of
from sb3_gcr.gradients.memory import Memory
from tests.networks import make_policy


def head_and_memory(action: str, in_numpy: bool) -> tuple[Any, Any, Memory]:
    policy, _ = make_policy(action=action)
    memory = Memory([policy.action_net.bias], policy, in_numpy)
    return head_of(policy, memory), policy, memory


@pytest.mark.parametrize("in_numpy", [False, True])
@th.no_grad()
def test_a_gaussian_by_hand(in_numpy: bool) -> None:
    """σ = 1 and e; an action one σ and two σ from the mean."""
    head, policy, memory = head_and_memory("Box", in_numpy)
    policy.log_std.copy_(th.tensor([0.0, 1.0]))
    output = memory.array(th.tensor([[1.0, 0.0]]))
    log_prob = head.log_prob(output, th.tensor([[2.0, 2 * np.e]]))
    # -½ (1 + 4) - (0 + 1) - log 2π
    assert log_prob.tolist() == [pytest.approx(-3.5 - 1.8378771, rel=1e-6)]
    np.testing.assert_allclose(head.signal(), [[1.0, 2 / np.e]], rtol=1e-6)
    np.testing.assert_allclose(head.scores()[0], [[0.0, 3.0]], rtol=1e-6)
    # two normals have the entropy 2 · 1.4189385 + log σ_1 σ_2
    assert np.ravel(head.entropy_loss())[0] == pytest.approx(-2.8378771 - 1, rel=1e-6)
    assert head.entropy_signal() is None
    head.add_entropy_gradient(0.5)
    memory.attach()
    assert policy.log_std.grad.tolist() == [-0.5, -0.5]


@pytest.mark.parametrize("in_numpy", [False, True])
def test_a_choice_of_three_by_hand(in_numpy: bool) -> None:
    """Probabilities ½, ¼ and ¼."""
    head, _, memory = head_and_memory("Discrete", in_numpy)
    logits = memory.array(th.tensor([[np.log(2), 0.0, 0.0]], dtype=th.float32))
    assert head.log_prob(logits, th.tensor([1])).tolist() == [pytest.approx(np.log(0.25))]
    np.testing.assert_allclose(head.signal(), [[-0.5, 0.75, -0.25]], rtol=1e-6)
    assert head.scores() == []
    # ½ log 2 + 2 · ¼ log 4 = 1.0397
    assert np.ravel(head.entropy_loss())[0] == pytest.approx(-1.0397208)
    # p (log p + H): ½ (-0.6931 + 1.0397), ¼ (-1.3863 + 1.0397)
    np.testing.assert_allclose(
        head.entropy_signal(), [[0.1732868, -0.0866434, -0.0866434]], rtol=1e-5
    )


@pytest.mark.parametrize("in_numpy", [False, True])
def test_two_coins_by_hand(in_numpy: bool) -> None:
    """Three bits with probabilities ½, ¾ and ½ of a 1."""
    head, _, memory = head_and_memory("MultiBinary", in_numpy)
    logits = memory.array(th.tensor([[0.0, np.log(3), 0.0]], dtype=th.float32))
    found = head.log_prob(logits, th.tensor([[1.0, 1.0, 0.0]]))
    assert found.tolist() == [pytest.approx(np.log(0.5 * 0.75 * 0.5))]
    np.testing.assert_allclose(head.signal(), [[0.5, 0.25, -0.5]], rtol=1e-6)


@pytest.mark.parametrize("action", ["Box", "Discrete", "MultiDiscrete", "MultiBinary"])
@pytest.mark.parametrize("in_numpy", [False, True])
@th.no_grad()
def test_all_heads_are_sb3s_distributions(action: str, in_numpy: bool) -> None:
    head, policy, memory = head_and_memory(action, in_numpy)
    th.manual_seed(1)
    if action == "Box":
        policy.log_std.copy_(th.tensor([-0.3, 0.4]))
    outputs = th.randn(7, policy.action_net.out_features)
    parts = (outputs, policy.log_std) if action == "Box" else (outputs,)
    actions = policy.action_dist.proba_distribution(*parts).sample()
    found = head.log_prob(memory.array(outputs.clone()), actions)
    signal, entropy_loss = head.signal(), head.entropy_loss()
    outputs.requires_grad_()
    with th.enable_grad():
        parts = (outputs, policy.log_std) if action == "Box" else (outputs,)
        distribution = policy.action_dist.proba_distribution(*parts)
        log_prob = distribution.log_prob(actions)
        (expected,) = th.autograd.grad(log_prob.sum(), outputs)
    th.testing.assert_close(th.as_tensor(found), log_prob.detach(), rtol=1e-5, atol=1e-5)
    th.testing.assert_close(th.as_tensor(signal), expected, rtol=1e-4, atol=1e-5)
    assert np.ravel(entropy_loss)[0] == pytest.approx(
        -float(distribution.entropy().mean()), rel=1e-5
    )

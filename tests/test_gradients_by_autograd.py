"""The actor-critic by autograd: the reference, against naive loops."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_gcr.gradients.by_autograd import ByAutograd, gramian_by_passes
from tests.networks import FITTING, OTHERS, B, K, make_policy


def test_two_samples_and_one_unit_by_hand() -> None:
    """y = w h + b with h = 3, 1 and cotangents of the outputs 1, 2 and -1, 1: g^(1) = (5, 3) and
    g^(2) = (-2, 0).
    """
    layer = nn.Linear(1, 1)
    outputs = layer(th.tensor([[3.0], [1.0]]))[:, 0]
    cotangents = th.tensor([[1.0, -1.0], [2.0, 1.0]])
    found = gramian_by_passes(outputs, cotangents, list(layer.parameters()))
    assert found.tolist() == [[34.0, -10.0], [-10.0, 4.0]]


@pytest.mark.parametrize(
    ("frozen", "expected"), [([1], [[25, -10], [-10, 4]]), ([0, 1], [[0, 0], [0, 0]])]
)
def test_what_is_frozen_takes_no_part(frozen: list[int], expected: list[list[int]]) -> None:
    layer = nn.Linear(1, 1)
    parameters = list(layer.parameters())
    for index in frozen:
        parameters[index].requires_grad_(False)
    outputs = layer(th.tensor([[3.0], [1.0]]))[:, 0]
    cotangents = th.tensor([[1.0, -1.0], [2.0, 1.0]])
    trained = [parameter for parameter in parameters if parameter.requires_grad]
    assert gramian_by_passes(outputs, cotangents, trained).tolist() == expected


def test_a_graph_without_any_of_the_parameters_has_no_gradient() -> None:
    """Log π depends on something that is no parameter of the policy."""
    outside, parameter = th.ones(2, requires_grad=True), nn.Parameter(th.ones(3))
    for parameters in ([parameter], []):
        found = gramian_by_passes(2 * outside, th.ones(2, 3), parameters)
        assert found.tolist() == [[0.0] * 3] * 3


def test_gramian_by_passes_is_a_naive_double_loop() -> None:
    th.manual_seed(0)
    net, unused = (
        nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 1)),
        nn.Parameter(th.ones(2)),
    )
    x, cotangents = th.randn(B, 3), th.randn(B, K)
    parameters = [*net.parameters(), unused]
    jacobian = []
    for k in range(K):
        net.zero_grad()
        for b in range(B):
            (cotangents[b, k] * net(x[b : b + 1]).sum()).backward()
        jacobian.append(
            th.cat([p.grad.flatten().clone() for p in net.parameters() if p.grad is not None])
        )
    expected = th.stack(jacobian) @ th.stack(jacobian).T
    actual = gramian_by_passes(net(x)[:, 0], cotangents, parameters)
    th.testing.assert_close(actual, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", list(OTHERS))
@pytest.mark.filterwarnings("ignore:Implicit dimension choice for softmax")
def test_policies_of_any_kind(name: str) -> None:
    policy, observations = make_policy(**OTHERS[name])
    policy.set_training_mode(True)
    with th.no_grad():
        actions = th.zeros(B, 2)
    networks = ByAutograd(policy)
    networks.evaluate(observations, actions)
    gramian = networks.gramian(th.randn(B, K))
    assert (th.linalg.eigvalsh(gramian) > -1e-4 * gramian.diagonal().max()).all()
    networks.backward(th.randn(B, K), np.ones(K), th.randn(B, K), 0.1)
    assert policy.value_net.weight.grad.abs().sum() > 0


@pytest.mark.parametrize("name", ["default", "discrete", "GELU"])
def test_the_step_is_the_gradient_of_the_whole_loss(name: str) -> None:
    """One scalar, with the weighted cotangents as its coefficients."""
    policy, observations = make_policy(**FITTING[name])
    with th.no_grad():
        actions = policy(observations)[0]
    if name == "discrete":
        actions = actions.flatten()
    cotangents, value_gradients = th.randn(B, K), th.randn(B, K)
    weights = np.random.default_rng(0).random(K)
    networks = ByAutograd(policy)
    with th.no_grad():
        networks.evaluate(observations, actions)
        networks.backward(cotangents, weights, value_gradients, 0.7)
        norm = networks.clip_gradients(0.5)
    found = [parameter.grad.clone() for parameter in policy.parameters()]
    values, log_prob, entropy = policy.evaluate_actions(observations, actions)
    loss = -0.7 * entropy.mean() + (value_gradients * values).sum()
    for k in range(K):
        loss = loss + float(weights[k]) * (cotangents[:, k] * log_prob).sum()
    expected = th.autograd.grad(loss, list(policy.parameters()))
    assert norm == pytest.approx(float(th.cat([g.flatten() for g in expected]).norm()), rel=1e-5)
    for mine, its in zip(found, expected, strict=True):
        th.testing.assert_close(mine, its * 0.5 / norm, rtol=1e-3, atol=1e-6)


def test_a_part_of_the_samples_is_the_gramian_of_these() -> None:
    policy, observations = make_policy()
    actions, cotangents = th.randn(B, 2), th.randn(B, K)
    networks = ByAutograd(policy)
    networks.evaluate(observations, actions)
    part = networks.gramian(cotangents, n_samples=10)
    networks.evaluate(observations[:10], actions[:10])
    th.testing.assert_close(part, networks.gramian(cotangents[:10]), rtol=1e-4, atol=1e-4)

"""Losses, cotangents and Gramians against autograd and naive loops."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import scipy.linalg  # noqa: F401 loads its BLAS before the library looks for them
import torch as th
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from threadpoolctl import threadpool_info, threadpool_limits
from torch import nn

from sb3_gcr.gradients import memory
from sb3_gcr.gradients.by_autograd import ByAutograd, gramian_by_passes
from sb3_gcr.gradients.by_hand import ByHand
from sb3_gcr.gradients.fitting import fits
from sb3_gcr.gradients.gramian import Layer, component_gramian
from sb3_gcr.gradients.layers import ACTIVATIONS
from sb3_gcr.losses import surrogate_cotangents, surrogate_losses, value_cotangents, value_errors
from sb3_gcr.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from tests.envs import ACTIONS, OBSERVATIONS

B, K = 24, 5


@pytest.mark.parametrize(
    ("ratio", "advantage", "loss", "slope"),
    [
        # inside the range: -ρ A; outside: -clip(ρ) A without slope only where clipping makes it
        # larger
        (1.0, 2.0, -2.0, -2.0),
        (1.1, 2.0, -2.2, -2.2),
        (1.5, 2.0, -2.4, 0.0),
        (1.5, -2.0, 3.0, 3.0),
        (0.5, 2.0, -1.0, -1.0),
        (0.5, -2.0, 1.6, 0.0),
        (1.3, 0.0, 0.0, 0.0),
    ],
)
def test_surrogate_by_hand(ratio: float, advantage: float, loss: float, slope: float) -> None:
    log_prob, old = th.tensor([np.log(ratio)]), th.zeros(1)
    advantages = th.tensor([[advantage]], dtype=th.double)
    assert surrogate_losses(log_prob, old, advantages, 0.2).item() == pytest.approx(loss)
    assert surrogate_cotangents(log_prob.detach(), old, advantages, 0.2).item() == pytest.approx(
        slope
    )


def test_cotangents_are_the_derivative_of_the_surrogates() -> None:
    th.manual_seed(0)
    log_prob = (0.4 * th.randn(B, dtype=th.double)).requires_grad_()
    old, advantages = 0.4 * th.randn(B, dtype=th.double), th.randn(B, K, dtype=th.double)
    losses = surrogate_losses(log_prob, old, advantages, 0.2).mean(0)
    for k in range(K):
        (expected,) = th.autograd.grad(losses[k], log_prob, retain_graph=True)
        th.testing.assert_close(
            surrogate_cotangents(log_prob.detach(), old, advantages, 0.2)[:, k], expected
        )


def test_nan_is_not_clipped_away() -> None:
    nan, one = th.full((1, 1), th.nan), th.ones(1, 1)
    assert surrogate_cotangents(nan[0], one[0], one, 0.2).isnan().all()
    assert surrogate_cotangents(one[0], one[0], nan, 0.2).isnan().all()
    assert value_cotangents(nan, one, one, 0.2).isnan().all()


def test_the_sum_of_clipped_surrogates_is_never_below_the_joint_one() -> None:
    th.manual_seed(1)
    log_prob, advantages = 0.5 * th.randn(200), th.randn(200, K)
    joint = surrogate_losses(log_prob, th.zeros(200), advantages.sum(1, keepdim=True), 0.2)
    assert surrogate_losses(log_prob, th.zeros(200), advantages, 0.2).sum() > joint.sum()


@pytest.mark.parametrize("clip_range_vf", [None, 0.3])
def test_value_errors_against_autograd(clip_range_vf: float | None) -> None:
    th.manual_seed(0)
    values = th.randn(B, K, requires_grad=True)
    old, returns = values.detach() + 0.4 * th.randn(B, K), th.randn(B, K)
    predicted = (
        values
        if clip_range_vf is None
        else old + (values - old).clamp(-clip_range_vf, clip_range_vf)
    )
    expected = ((predicted - returns) ** 2).mean(0)
    arguments = (values.detach(), old, returns, clip_range_vf)
    cotangents = value_cotangents(*arguments)
    th.testing.assert_close(value_errors(*arguments).square().mean(0), expected.detach())
    th.testing.assert_close(cotangents, th.autograd.grad(expected.sum(), values)[0])


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


class Dropping(BaseFeaturesExtractor):
    """Has parameters, batch normalisation and dropout."""

    def __init__(self, observation_space: gym.Space[Any]):
        super().__init__(observation_space, 6)
        self.net = nn.Sequential(nn.Linear(4, 6), nn.BatchNorm1d(6), nn.Dropout(0.1))

    def forward(self, x: th.Tensor) -> th.Tensor:
        return self.net(x)  # type: ignore[no-any-return]


class OwnForward(MlpPolicy):
    """A user's policy with its own way through the networks."""

    def evaluate_actions(self, obs: Any, actions: th.Tensor) -> Any:
        values, log_prob, entropy = super().evaluate_actions(obs, actions)
        return values, 0.5 * log_prob, entropy


def make(
    policy_class: Any = MlpPolicy, observation: str = "Box", action: str = "Box", **kwargs: Any
) -> Any:
    th.manual_seed(0)
    policy = policy_class(
        OBSERVATIONS[observation], ACTIONS[action], lambda _: 1e-3, n_components=K, **kwargs
    )
    with th.no_grad():  # SB3 starts the action head close to zero, where nothing would be tested
        policy.action_net.weight.normal_(0, 0.5)
    space = OBSERVATIONS[observation]
    space.seed(0)
    samples = [space.sample() for _ in range(B)]
    if isinstance(space, gym.spaces.Dict):
        stacked: Any = {
            key: np.stack([np.asarray(sample[key]) for sample in samples]) for key in space
        }
    else:
        stacked = np.stack(samples)
    return policy, policy.obs_to_tensor(stacked)[0]


FITTING = {
    "default": {},
    "no hidden layer": {"net_arch": []},
    "uneven": {"net_arch": {"pi": [7], "vf": [5, 6, 4]}},
    "separate extractors": {"share_features_extractor": False},
    "discrete": {"action": "Discrete"},
    "multi-discrete": {"action": "MultiDiscrete"},
    "multi-binary": {"action": "MultiBinary"},
    "discrete observations": {"observation": "Discrete"},
    "multi-discrete observations": {"observation": "MultiDiscrete"},
    "dictionary": {"observation": "Dict", "policy_class": MultiInputPolicy},
    **{activation.__name__: {"activation_fn": activation} for activation in ACTIVATIONS},
}
OTHERS = {
    "batch norm and dropout": {"features_extractor_class": Dropping},
    "gSDE": {"use_sde": True},
    "images": {"observation": "Image", "policy_class": CnnPolicy},
    "dictionary with image": {"observation": "DictImage", "policy_class": MultiInputPolicy},
    "own forward": {"policy_class": OwnForward},
    "random activation": {"activation_fn": nn.RReLU},
    "activation with parameters": {"activation_fn": nn.PReLU},
    "activation across features": {"activation_fn": nn.Softmax},
}


@pytest.mark.parametrize("name", list(FITTING))
@pytest.mark.parametrize("ent_coef", [0.0, 0.7])
@pytest.mark.parametrize("n_samples", [None, B])
@th.no_grad()
def test_one_backward_is_k_backwards(name: str, ent_coef: float, n_samples: int | None) -> None:
    """Values, log π, entropy, Gramian, the resolved gradient and its clipping, to float32 rounding,
    in PyTorch and NumPy.
    """
    policy, observations = make(**FITTING[name])
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


@pytest.mark.parametrize(("threads", "limit"), [(1, "SMALL"), (2, "SMALL_FOR_THREADS")])
def test_small_updates_run_in_numpy_with_one_thread(threads: int, limit: str) -> None:
    policy, _ = make()
    n_parameters = sum(parameter.numel() for parameter in policy.parameters())
    largest = getattr(memory, limit) // n_parameters
    before = th.get_num_threads()
    th.set_num_threads(threads)
    try:
        small, large = ByHand(policy, largest), ByHand(policy, largest + 1)
    finally:
        th.set_num_threads(before)
    assert small.way == "one backward pass in NumPy"
    assert large.way == "one backward pass in PyTorch"

    def blas_threads() -> list[int]:
        return [
            library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"
        ]

    with threadpool_limits(2, user_api="blas"):
        assert 2 in blas_threads()
        with large.session():
            assert 2 in blas_threads()
        with small.session():
            assert set(blas_threads()) == {1}
        assert 2 in blas_threads()


@pytest.mark.parametrize("name", list(OTHERS))
@pytest.mark.filterwarnings("ignore:Implicit dimension choice for softmax")
def test_everything_else_takes_k_backwards(name: str) -> None:
    policy, observations = make(**OTHERS[name])
    assert not fits(policy)
    policy.set_training_mode(True)
    with th.no_grad():
        actions = th.zeros(B, 2)
    networks = ByAutograd(policy)
    networks.evaluate(observations, actions)
    gramian = networks.gramian(th.randn(B, K))
    assert (th.linalg.eigvalsh(gramian) > -1e-4 * gramian.diagonal().max()).all()
    networks.backward(th.randn(B, K), np.ones(K), th.randn(B, K), 0.1)
    assert policy.value_net.weight.grad.abs().sum() > 0


def test_frozen_and_double_parameters_do_not_fit() -> None:
    policy, _ = make()
    policy.action_net.weight.requires_grad_(False)
    assert not fits(policy)
    policy, _ = make()
    assert not fits(policy.double())
    policy, _ = make()
    policy.extra = nn.Parameter(th.zeros(1))
    assert not fits(policy)
    policy, _ = make()
    policy.mlp_extractor.register_forward_hook(lambda *_: None)
    assert not fits(policy)
    policy, _ = make()
    policy.action_net.weight.register_hook(lambda gradient: 2 * gradient)
    assert not fits(policy)


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

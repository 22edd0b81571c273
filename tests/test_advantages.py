"""Component GAE, the truncation bootstrap and joint normalisation."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer

from sb3_gcr.advantages import bootstrap_truncations, component_gae, normalize_jointly


def test_gae_by_hand() -> None:
    """Two steps, γ = 0.5, λ = 0.5; component 1 is ten times component 0."""
    rewards = np.array([[[1.0, 10.0]], [[2.0, 20.0]]])
    values = np.array([[[4.0, 40.0]], [[6.0, 60.0]]])
    advantages = component_gae(
        rewards,
        values,
        np.zeros((2, 1)),
        np.array([[8.0, 80.0]]),
        np.array([False]),
        gamma=0.5,
        gae_lambda=0.5,
    )
    # δ_1 = 2 + 0.5·8 - 6 = 0, δ_0 = 1 + 0.5·6 - 4 = 0
    np.testing.assert_allclose(advantages, np.zeros((2, 1, 2)))
    ended = component_gae(
        rewards,
        values,
        np.zeros((2, 1)),
        np.array([[8.0, 80.0]]),
        np.array([True]),
        gamma=0.5,
        gae_lambda=0.5,
    )
    # δ_1 = 2 - 6 = -4, A_0 = 0 + 0.25·(-4)
    np.testing.assert_allclose(ended[:, 0], [[-1, -10], [-4, -40]])
    new_episode = component_gae(
        rewards,
        values,
        np.array([[0.0], [1.0]]),
        np.array([[8.0, 80.0]]),
        np.array([False]),
        gamma=0.5,
        gae_lambda=0.5,
    )
    # δ_0 = 1 - 4
    np.testing.assert_allclose(new_episode[:, 0], [[-3, -30], [0, 0]])


def test_each_component_is_sb3s_gae() -> None:
    rng = np.random.default_rng(0)
    rewards, values = rng.normal(size=(2, 7, 3, 4)).astype(np.float32)
    starts = (rng.random((7, 3)) < 0.3).astype(np.float32)
    last_values, dones = rng.normal(size=(3, 4)).astype(np.float32), np.array([True, False, False])
    advantages = component_gae(rewards, values, starts, last_values, dones, 0.97, 0.9)
    box = gym.spaces.Box(-1, 1, (1,))
    for k in range(4):
        buffer = RolloutBuffer(7, box, box, gae_lambda=0.9, gamma=0.97, n_envs=3)
        buffer.rewards, buffer.values, buffer.episode_starts = (
            rewards[..., k],
            values[..., k],
            starts,
        )
        buffer.compute_returns_and_advantage(th.as_tensor(last_values[:, k]), dones)
        np.testing.assert_array_equal(advantages[..., k], buffer.advantages)


def test_bootstrap_adds_the_terminal_value_of_each_head() -> None:
    rewards = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    result = bootstrap_truncations(
        rewards, np.array([True, False, True]), np.array([[10.0, 20.0], [30.0, 40.0]]), 0.5
    )
    np.testing.assert_array_equal(result, [[6, 12], [3, 4], [20, 26]])
    np.testing.assert_array_equal(rewards, [[1, 2], [3, 4], [5, 6]])


def as_numpy(x: Any) -> Any:
    return np.asarray(x)


@pytest.mark.parametrize("backend", [as_numpy, th.as_tensor], ids=["numpy", "torch"])
def test_joint_normalisation_by_hand(backend: Any) -> None:
    advantages = backend(np.array([[1.0, 1.0], [3.0, 1.0], [5.0, 7.0]]))
    # sums 2, 4, 12: mean 6, variance (16 + 4 + 36) / 2 = 28
    expected = np.array([[-2.0, -2.0], [0.0, -2.0], [2.0, 4.0]]) / np.sqrt(28)
    np.testing.assert_allclose(
        as_numpy(normalize_jointly(advantages).advantages), expected, rtol=1e-6
    )
    assert float(normalize_jointly(advantages).kappa) == pytest.approx(1 / np.sqrt(28))
    assert type(normalize_jointly(advantages).advantages) is type(advantages)


@pytest.mark.parametrize("backend", [as_numpy, th.as_tensor], ids=["numpy", "torch"])
def test_components_that_cancel_are_bounded(backend: Any) -> None:
    half = np.random.default_rng(0).normal(size=200)
    advantages = backend(np.stack([half, -half + 1e-9 * half**2], axis=1))
    bounded = as_numpy(normalize_jointly(advantages, kappa_max=10.0).advantages)
    assert bounded.std(0, ddof=1).max() == pytest.approx(10, rel=1e-6)
    assert as_numpy(normalize_jointly(advantages).advantages).std(0, ddof=1).max() > 1e6


def test_bound_does_not_touch_components_that_do_not_cancel() -> None:
    advantages = np.random.default_rng(0).normal(size=(100, 5))
    np.testing.assert_array_equal(
        normalize_jointly(advantages, kappa_max=10.0).advantages,
        normalize_jointly(advantages).advantages,
    )


def test_the_sum_is_ppos_normalised_advantage() -> None:
    rng = np.random.default_rng(1)
    advantages = rng.normal(size=(64, 4)) * [1, 10, 0.1, 3] + [1, -5, 0, 2]
    total = th.as_tensor(advantages.sum(1))
    ppo = (total - total.mean()) / (total.std() + 1e-8)
    np.testing.assert_allclose(
        normalize_jointly(advantages).advantages.sum(1), ppo.numpy(), rtol=1e-9, atol=1e-12
    )


def test_rollout_shape_and_ratios_are_kept() -> None:
    advantages = np.random.default_rng(2).normal(size=(8, 3, 2))
    result = normalize_jointly(advantages).advantages
    assert result.shape == (8, 3, 2)
    centred = advantages - advantages.mean((0, 1))
    np.testing.assert_allclose(result[..., 0] * centred[..., 1], result[..., 1] * centred[..., 0])


def test_one_sample_and_constant_advantages_stay_finite() -> None:
    single = th.tensor([[1.0, 2.0]])
    assert normalize_jointly(single, kappa_max=10.0).advantages.tolist() == [[1.0, 2.0]]
    assert normalize_jointly(single).kappa == 1
    assert np.isfinite(normalize_jointly(np.ones((5, 2)), kappa_max=10.0).advantages).all()

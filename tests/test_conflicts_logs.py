"""Unbiased products inside an update: against loops over pairs of samples, and in the log."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure

from sb3_gcr import GCRPPO
from sb3_gcr.gradients.by_autograd import ByAutograd
from sb3_gcr.gradients.by_hand import ByHand
from sb3_gcr.logs.report import write_report
from sb3_gcr.policies import MlpPolicy
from tests.envs import ACTIONS, OBSERVATIONS, SPEC, Env

B, K = 12, 3


def policy_for(action: str) -> MlpPolicy:
    th.manual_seed(0)
    spaces = OBSERVATIONS["Box"], ACTIONS[action]
    return MlpPolicy(*spaces, lambda _: 1e-3, net_arch=[7, 5], n_components=K)


def samples_of(policy: MlpPolicy) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    observations = th.randn(B, 4)
    with th.no_grad():
        actions = policy(observations)[0]
    return observations, actions, th.randn(B, K)


def gradients_of_samples(policy: MlpPolicy, samples: Any) -> th.Tensor:
    """c_b^(k) ∂log π_b/∂θ, one backward pass for each sample; shape (B, K, D)."""
    observations, actions, cotangents = samples
    rows = []
    for b in range(B):
        policy.zero_grad()
        policy.evaluate_actions(observations[b : b + 1], actions[b : b + 1])[1].sum().backward()
        rows.append(
            th.cat([p.grad.flatten().clone() for p in policy.parameters() if p.grad is not None])
        )
    return cotangents[:, :, None] * th.stack(rows)[:, None]


@pytest.mark.parametrize("action", ["Box", "Discrete"])
@pytest.mark.parametrize("in_numpy", [True, False])
@th.no_grad()
def test_by_hand_no_sample_meets_itself(action: str, in_numpy: bool) -> None:
    """Σ_{b ≠ b'} · B / (B - 1), pair by pair; cotangents are those of a mean over B samples."""
    policy = policy_for(action)
    observations, actions, cotangents = samples_of(policy)
    actor_critic = ByHand(policy, B if in_numpy else None)
    actor_critic.evaluate(observations, actions)
    actor_critic.gramian(actor_critic.array(cotangents))
    found = np.asarray(actor_critic.unbiased_gramian())
    with th.enable_grad():
        rows = gradients_of_samples(policy, (observations, actions, cotangents)).double()
    expected = sum(rows[a] @ rows[b].T for a in range(B) for b in range(B) if a != b) * (
        B / (B - 1)
    )
    np.testing.assert_allclose(found, np.asarray(expected), rtol=1e-5, atol=1e-5)


def test_by_autograd_two_minibatches_meet() -> None:
    """Σ_{b, b'} over a sample of the one and a sample of the other, both ways, halved."""
    policy = policy_for("Box")
    first, second = samples_of(policy), samples_of(policy)
    actor_critic = ByAutograd(policy)
    actor_critic.begin_epoch()
    found = []
    for observations, actions, cotangents in (first, second):
        actor_critic.evaluate(observations, actions)
        actor_critic.gramian(cotangents)
        found.append(actor_critic.unbiased_gramian())
    assert found[0] is None
    left, right = (gradients_of_samples(policy, samples).double() for samples in (first, second))
    products = sum(left[a] @ right[b].T for a in range(B) for b in range(B))
    assert isinstance(products, th.Tensor)
    np.testing.assert_allclose(
        np.asarray(found[1]), np.asarray(products + products.T) / 2, rtol=1e-5, atol=1e-5
    )
    actor_critic.begin_epoch()
    actor_critic.evaluate(*first[:2])
    actor_critic.gramian(first[2])
    assert actor_critic.unbiased_gramian() is None


@th.no_grad()
def test_a_single_sample_has_no_pair() -> None:
    policy = policy_for("Box")
    observations, actions, cotangents = samples_of(policy)
    actor_critic = ByHand(policy)
    actor_critic.evaluate(observations, actions)
    actor_critic.gramian(cotangents, n_samples=1)
    assert actor_critic.unbiased_gramian() is None


@pytest.mark.parametrize("method", ["one_backward", "passes"])
def test_the_log_of_a_training(tmp_path: Path, method: str) -> None:
    model = GCRPPO(
        "MlpPolicy",
        make_vec_env(Env, 4, seed=0),
        n_steps=32,
        batch_size=32,
        n_epochs=2,
        seed=0,
        device="cpu",
        gramian_method=method,
        policy_kwargs={"net_arch": [8]},
    )
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(5 * 128)
    model.logger.close()
    progress = pd.read_csv(tmp_path / "progress.csv")
    for name in SPEC.names:
        share = progress[f"gcr/signal/{name}"].dropna()
        assert len(share) == 4  # the last update is not dumped
        assert (share < 1).all()
    table = pd.read_csv(tmp_path / "cosines_unbiased.csv")
    assert list(table.columns) == [
        "time/total_timesteps",
        *("go | stay", "go | save", "stay | save"),
        *("go * go", "go * stay", "go * save", "stay * stay", "stay * save", "save * save"),
    ]
    assert len(table) == 5
    assert table.iloc[:, 4:].notna().all(axis=None)
    assert list(pd.read_csv(tmp_path / "cosines.csv").columns) == list(table.columns[:4])
    report = write_report(tmp_path, SPEC)
    assert all(path.exists() for path in report.pictures)


def test_one_minibatch_an_epoch_has_no_disjoint_one() -> None:
    model = GCRPPO(
        "MlpPolicy",
        make_vec_env(Env, 4, seed=0),
        n_steps=8,
        batch_size=32,
        n_epochs=2,
        device="cpu",
        gramian_method="passes",
    )
    model.learn(32)
    assert not [key for key in model.logger.name_to_value if key.startswith("gcr/signal")]
    assert "gcr/grad_norm/go" in model.logger.name_to_value

"""The experiment with averaged unbiased Gramians."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gcr import GCRPPO
from sb3_gcr.averaging import GramianAverage, positive_part
from tests.envs import Env


def test_two_numbers_by_hand() -> None:
    """n = 2: the first counts alone; then half of what there was, and half of the new one."""
    average = GramianAverage(2)
    assert average.add(None) is None
    first, second = np.array([[8.0]]), np.array([[2.0]])
    np.testing.assert_allclose(average.add(first), [[8.0]])
    np.testing.assert_allclose(average.add(second), [[(0.25 * 8 + 0.5 * 2) / 0.75]])
    np.testing.assert_allclose(average.add(None), [[(0.25 * 8 + 0.5 * 2) / 0.75]])


def test_negative_eigenvalues_are_dropped() -> None:
    """(1, 1) has eigenvalue 3 and (1, -1) has -1."""
    np.testing.assert_allclose(positive_part(np.array([[1.0, 2.0], [2.0, 1.0]])), 1.5)
    gramian = np.array([[2.0, 1.0], [1.0, 2.0]])
    np.testing.assert_allclose(positive_part(gramian), gramian)


@pytest.mark.parametrize("method", ["one_backward", "passes"])
def test_resolvers_see_the_average(method: str) -> None:
    seen: list[Any] = []

    def resolver(gramian: Any, levels: Any, rng: Any) -> Any:
        seen.append(gramian.copy())
        return np.ones(len(levels))

    def gramians(n: int | None) -> list[Any]:
        seen.clear()
        model = GCRPPO(
            "MlpPolicy",
            DummyVecEnv([Env] * 2),
            n_steps=32,
            batch_size=16,
            n_epochs=3,
            seed=0,
            device="cpu",
            resolver=resolver,
            gramian_method=method,
            gramian_average=n,
            policy_kwargs={"net_arch": [8]},
        )
        model.learn(64)
        return seen[2:]  # the first ones are the checks of the constructor

    own, averaged = gramians(None), gramians(20)
    assert len(own) == len(averaged)
    assert all((np.linalg.eigvalsh(gramian) > -1e-9).all() for gramian in averaged)
    # Without its noise a gradient is shorter, and an average moves less.
    assert np.trace(averaged[-1]) < np.trace(own[-1])
    moves = [np.diff(np.array(one[4:]), axis=0) for one in (own, averaged)]
    assert abs(moves[1]).mean() < 0.5 * abs(moves[0]).mean()


def test_a_wrong_number_is_refused() -> None:
    message = "Parameter `gramian_average` must be an integer ≥ 1 or None, found 0."
    with pytest.raises(ValueError, match=message):
        GCRPPO("MlpPolicy", DummyVecEnv([Env]), gramian_average=0)

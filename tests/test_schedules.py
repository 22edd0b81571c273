"""The learning rate that follows the KL divergence."""

from __future__ import annotations

import pytest

from sb3_gcr.schedules import adapt_learning_rate


def test_adaptive_learning_rate_rule() -> None:
    assert adapt_learning_rate(1e-3, 0.021, 0.01) == pytest.approx(1e-3 / 1.5)
    assert adapt_learning_rate(1e-3, 0.004, 0.01) == pytest.approx(1.5e-3)
    assert adapt_learning_rate(1e-3, 0.01, 0.01) == 1e-3
    assert adapt_learning_rate(1.2e-5, 1.0, 0.01) == 1e-5
    assert adapt_learning_rate(9e-3, 0.0, 0.01) == 1e-2


@pytest.mark.parametrize(
    ("kl", "expected"), [(0.02, 3e-4), (0.0201, 2e-4), (0.005, 3e-4), (0.0049, 4.5e-4)]
)
def test_the_rate_stays_between_half_and_twice_the_target(kl: float, expected: float) -> None:
    assert adapt_learning_rate(3e-4, kl, 0.01) == pytest.approx(expected)

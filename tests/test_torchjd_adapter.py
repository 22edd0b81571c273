"""The adapter for other people's weightings."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sb3_gcr.resolvers import guaranteed
from sb3_gcr.torchjd_adapter import from_torchjd
from tests.test_resolvers import TORCHJD_MATRIX

torchjd = pytest.importorskip("torchjd.aggregation")


@pytest.mark.parametrize(
    ("weighting", "expected"),
    [
        (lambda: torchjd.PCGradWeighting(), (2.2222, 1.5789)),
        (lambda: torchjd.UPGradWeighting(), (1.1109, 0.7894)),
        (lambda: torchjd.DualProjWeighting(), (0.6109, 0.5)),
        (lambda: torchjd.MGDAWeighting(), (0.6, 0.4)),
        (lambda: torchjd.CAGradWeighting(c=0.5), (0.7041, 0.5)),
    ],
    ids=["PCGrad", "UPGrad", "DualProj", "MGDA", "CAGrad"],
)
@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_published_torchjd_weights_at_any_scale(
    weighting: Any, expected: Any, scale: float
) -> None:
    """The values for scale 1 are TorchJD's published ones; the adapter must not lose them for small
    gradients.
    """
    jacobian = scale * TORCHJD_MATRIX
    weights = from_torchjd(weighting())(
        jacobian @ jacobian.T, np.array([0, 1]), np.random.default_rng(0)
    )
    np.testing.assert_allclose(weights, expected, atol=1e-3 if scale != 1 else 4e-4)


def test_torchjd_adapter_keeps_the_preference_and_the_users_object() -> None:
    import torch as th

    weighting = torchjd.UPGradWeighting(pref_vector=th.ones(2))
    resolver = from_torchjd(weighting)
    jacobian = np.array([[1.0, 0.0], [-6e-4, 8e-4]])
    weights = resolver(jacobian @ jacobian.T, np.array([0, 0]), np.random.default_rng(0))
    expected = guaranteed(jacobian @ jacobian.T, np.array([0, 0]), np.random.default_rng(0))
    np.testing.assert_allclose(weights, expected, rtol=1e-3)
    assert weighting.pref_vector.tolist() == [1, 1]


def test_torchjd_adapter_skips_a_zero_row_and_refuses_an_aggregator() -> None:
    jacobian = np.array([[1.0, 0.0], [0.0, 0.0], [-1.0, 1.0]])
    weights = from_torchjd(torchjd.UPGradWeighting())(
        jacobian @ jacobian.T, np.zeros(3, int), np.random.default_rng(0)
    )
    assert weights[1] == 1
    zeros = from_torchjd(torchjd.MGDAWeighting())(
        np.zeros((2, 2)), np.zeros(2, int), np.random.default_rng(0)
    )
    assert zeros.tolist() == [1, 1]
    message = (
        r"Parameter `weighting` must be a torchjd.aggregation.\*Weighting, found UPGrad. "
        r"Aggregators such as UPGrad\(\) carry theirs as `.gramian_weighting`."
    )
    with pytest.raises(TypeError, match=f"^{message}$"):
        from_torchjd(torchjd.UPGrad())

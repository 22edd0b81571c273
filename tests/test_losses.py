"""The component losses and their cotangents: numbers worked out by hand, and autograd."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_gcr.losses import (
    CLIPPINGS,
    Clip,
    brakes,
    is_clipped,
    kl_estimates,
    leaves_range,
    surrogate_cotangents,
    surrogate_losses,
    value_cotangents,
    value_errors,
)

B, K = 24, 5
#: Each number as a tensor and as a NumPy array.
LIBRARIES: list[Any] = [th.tensor, np.array]


def sample(xp: Any, ratio: float, advantages: list[float]) -> Any:
    """One sample: log π, log π_old and Â."""
    return xp([np.log(ratio)]), xp([0.0]), xp([advantages])


@pytest.mark.parametrize("clipping", CLIPPINGS)
@pytest.mark.parametrize("xp", LIBRARIES)
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
def test_one_component_by_hand(
    clipping: str, xp: Any, ratio: float, advantage: float, loss: float, slope: float
) -> None:
    """PPO's own clipping, whatever decides: there is one sign."""
    arguments = (*sample(xp, ratio, [advantage]), Clip(0.2, None, clipping))
    assert surrogate_losses(*arguments).tolist() == [[pytest.approx(loss)]]
    assert surrogate_cotangents(*arguments).tolist() == [[pytest.approx(slope)]]


#: ρ, Â of two components, and for joint clipping and clipping by component: losses, slopes, and
#: whether PPO clips while a component still pulls.
TWO_COMPONENTS = [
    # the sum is 1: PPO clips above the range, where the second component would go on
    (1.5, [2, -1], [-2.4, 1.2], [0, 0], [-2.4, 1.5], [0, 1.5], True),
    # the sum is -1: PPO goes on, where the second component would be clipped
    (1.5, [-2, 1], [3.0, -1.5], [3.0, -1.5], [3.0, -1.2], [3.0, 0], False),
    (0.5, [2, -1], [-1.0, 0.5], [-1.0, 0.5], [-1.0, 0.8], [-1.0, 0], False),
    (0.5, [-2, 1], [1.6, -0.8], [0, 0], [1.6, -0.5], [0, -0.5], True),
    # inside the range nobody clips
    (1.1, [2, -1], [-2.2, 1.1], [-2.2, 1.1], [-2.2, 1.1], [-2.2, 1.1], False),
    # the components agree: both ways are one
    (1.5, [2, 1], [-2.4, -1.2], [0, 0], [-2.4, -1.2], [0, 0], False),
    # the sum is 0: nothing to clip for PPO
    (1.5, [1, -1], [-1.5, 1.5], [-1.5, 1.5], [-1.2, 1.5], [0, 1.5], False),
    # one component has no say
    (1.5, [2, 0], [-2.4, 0], [0, 0], [-2.4, 0], [0, 0], False),
]


@pytest.mark.parametrize("xp", LIBRARIES)
@pytest.mark.parametrize("row", TWO_COMPONENTS)
def test_two_components_by_hand(xp: Any, row: Any) -> None:
    ratio, advantages, *expected, brake = row
    arguments = sample(xp, ratio, [float(advantage) for advantage in advantages])
    for clipping in CLIPPINGS:
        clip = Clip(0.2, None, clipping)
        losses, slopes = expected[:2] if clipping == "joint" else expected[2:]
        np.testing.assert_allclose(surrogate_losses(*arguments, clip), [losses], rtol=1e-6)
        np.testing.assert_allclose(surrogate_cotangents(*arguments, clip), [slopes], rtol=1e-6)
    assert brakes(*arguments, 0.2).tolist() == [brake]


@pytest.mark.parametrize("clipping", CLIPPINGS)
def test_what_decides_has_one_column_or_k(clipping: str) -> None:
    ratio, advantages = np.array([[1.5], [1.5]]), np.array([[2.0, -1.0], [-2.0, 1.0]])
    found = is_clipped(ratio, advantages, Clip(0.2, None, clipping)).tolist()
    assert found == ([[True], [False]] if clipping == "joint" else [[True, False], [False, True]])


@pytest.mark.parametrize("clipping", CLIPPINGS)
def test_cotangents_are_the_derivative_of_the_mean_losses(clipping: str) -> None:
    th.manual_seed(0)
    clip = Clip(0.2, None, clipping)
    log_prob = (0.4 * th.randn(B, dtype=th.double)).requires_grad_()
    old, advantages = 0.4 * th.randn(B, dtype=th.double), th.randn(B, K, dtype=th.double)
    losses = surrogate_losses(log_prob, old, advantages, clip).mean(0)
    actual = surrogate_cotangents(log_prob.detach(), old, advantages, clip)
    for k in range(K):
        (expected,) = th.autograd.grad(losses[k], log_prob, retain_graph=True)
        th.testing.assert_close(actual[:, k], expected)


def test_joint_losses_sum_to_ppos_and_those_by_component_are_above() -> None:
    """PPO's loss of one component with the summed advantage, sample by sample."""
    th.manual_seed(1)
    log_prob, old, advantages = 0.5 * th.randn(200), th.zeros(200), th.randn(200, K)
    total = advantages.sum(1, keepdim=True)
    ppos = surrogate_losses(log_prob, old, total, Clip(0.2, None, "component"))[:, 0]
    joint = surrogate_losses(log_prob, old, advantages, Clip(0.2, None, "joint")).sum(1)
    th.testing.assert_close(joint, ppos, rtol=1e-5, atol=1e-5)
    by_component = surrogate_losses(log_prob, old, advantages, Clip(0.2, None, "component")).sum(1)
    assert (by_component >= ppos - 1e-5).all()
    assert by_component.sum() > ppos.sum() + 1


@pytest.mark.parametrize("clipping", CLIPPINGS)
def test_nan_is_not_clipped_away(clipping: str) -> None:
    nan, one = th.full((1, 1), th.nan), th.ones(1, 1)
    clip = Clip(0.2, 0.2, clipping)
    assert surrogate_cotangents(nan[0], one[0], one, clip).isnan().all()
    assert surrogate_cotangents(one[0], one[0], nan, clip).isnan().all()
    assert value_cotangents(nan, one, one, 0.2).isnan().all()


@pytest.mark.parametrize("xp", LIBRARIES)
@pytest.mark.parametrize(
    ("value", "old", "target", "clip_range_vf", "error", "slope"),
    [
        (1.0, 0.0, 3.0, None, -2.0, -4.0),
        (9.0, 0.0, 3.0, None, 6.0, 12.0),
        # a change of at most 0.5 is all there; what is beyond has no slope
        (0.3, 0.0, 3.0, 0.5, -2.7, -5.4),
        (1.0, 0.0, 3.0, 0.5, -2.5, 0.0),
        (-1.0, 0.0, 3.0, 0.5, -3.5, 0.0),
        (0.5, 0.0, 3.0, 0.5, -2.5, -5.0),
        (4.0, 3.75, 3.0, 0.5, 1.0, 2.0),
        (4.0, 2.0, 2.5, 0.5, 0.0, 0.0),
    ],
)
def test_value_errors_by_hand(
    xp: Any,
    value: float,
    old: float,
    target: float,
    clip_range_vf: float | None,
    error: float,
    slope: float,
) -> None:
    arguments = (xp([[value]]), xp([[old]]), xp([[target]]), clip_range_vf)
    assert value_errors(*arguments).tolist() == [[pytest.approx(error)]]
    assert value_cotangents(*arguments).tolist() == [[pytest.approx(slope)]]


def test_value_cotangents_are_means_over_samples_and_leave_heads_apart() -> None:
    """Two samples of two heads: halves of the slopes above, each head's own."""
    values = np.array([[1.0, 0.3], [9.0, 1.0]])
    old, returns = np.zeros((2, 2)), np.full((2, 2), 3.0)
    np.testing.assert_allclose(
        value_cotangents(values, old, returns, None), [[-2.0, -2.7], [6.0, -2.0]]
    )
    np.testing.assert_allclose(
        value_cotangents(values, old, returns, 0.5), [[0.0, -2.7], [0.0, 0.0]]
    )
    assert values.tolist() == [[1.0, 0.3], [9.0, 1.0]]  # they are not overwritten


@pytest.mark.parametrize("xp", LIBRARIES)
def test_divergence_and_clip_fraction_by_hand(xp: Any) -> None:
    """ρ = 2, 1 and ½: (ρ - 1) - log ρ is 0.3069, 0 and 0.1931."""
    log_prob, old = xp(np.log([2.0, 1.0, 0.5])), xp([0.0, 0.0, 0.0])
    np.testing.assert_allclose(kl_estimates(log_prob, old), [0.306853, 0, 0.193147], atol=1e-6)
    assert leaves_range(log_prob, old, 0.2).tolist() == [True, False, True]
    assert leaves_range(log_prob, old, 0.6).tolist() == [True, False, False]

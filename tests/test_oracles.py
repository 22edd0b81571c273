"""The oracles themselves, where everything can be counted."""

from __future__ import annotations

import numpy as np

from tests.oracles import authors_in_place, orders, pcgrad_with_levels


def test_all_orders_of_two_levels() -> None:
    levels = [0, 1, 0, 1]
    assert set(orders([0, 1, 2, 3], levels)) == {
        (1, 3, 0, 2),
        (1, 3, 2, 0),
        (3, 1, 0, 2),
        (3, 1, 2, 0),
    }
    assert list(orders([], levels)) == [()]


def test_two_gradients_have_one_step_by_the_paper_and_two_in_place() -> None:
    """g_1 = (1, 0), g_2 = (-1, 1): g_1' = (½, ½), g_2' = (0, 1). In place the second one meets the
    projected first one: (½, ½) and (-1, 1) do not conflict; (0, 1) and (1, 0) do not either.
    """
    jacobian = np.array([[1.0, 0.0], [-1.0, 1.0]])
    assert pcgrad_with_levels(jacobian, [0, 0]) == {(0.5, 1.5)}
    assert authors_in_place(jacobian, [0, 0]) == {(-0.5, 1.5), (1.0, 1.0)}
    assert pcgrad_with_levels(jacobian, [0, 1]) == {(1.0, 1.0)}
    assert pcgrad_with_levels(jacobian, [1, 0]) == {(-0.5, 1.5)}

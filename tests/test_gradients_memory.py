"""Where the arrays of an update lie."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg  # noqa: F401 loads its BLAS before the library looks for them
import torch as th
from threadpoolctl import threadpool_info, threadpool_limits

from sb3_gcr.gradients import memory
from sb3_gcr.gradients.by_hand import ByHand
from sb3_gcr.gradients.memory import Memory
from tests.networks import make_policy


@pytest.mark.parametrize(("threads", "limit"), [(1, "SMALL"), (2, "SMALL_FOR_THREADS")])
def test_small_updates_run_in_numpy_with_one_thread(threads: int, limit: str) -> None:
    policy, _ = make_policy()
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


@pytest.mark.parametrize("in_numpy", [False, True])
def test_all_gradients_are_one_vector(in_numpy: bool) -> None:
    """What is written into a parameter's gradient is in the vector, and in ``grad``."""
    net = th.nn.Sequential(th.nn.Linear(3, 2), th.nn.Linear(2, 1))
    block = Memory([net[1].bias, net[0].bias], net, in_numpy)
    block.attach()
    assert len(block.gradients) == 11
    block.sums[:] = 7  # the biases', in the order given
    assert net[0].bias.grad.tolist() == [7, 7]
    assert net[1].bias.grad.tolist() == [7]
    gradient = block.gradient(net[0].weight)
    gradient[:] = 2
    assert isinstance(gradient, np.ndarray if in_numpy else th.Tensor)
    assert net[0].weight.grad.tolist() == [[2] * 3] * 2
    assert float(block.gradients.sum()) == 3 * 7 + 6 * 2
    net.zero_grad()
    block.attach()
    assert net[0].bias.grad.tolist() == [7, 7]


@pytest.mark.parametrize("in_numpy", [False, True])
def test_arrays_share_the_memory_of_their_tensors(in_numpy: bool) -> None:
    parameter = th.nn.Parameter(th.ones(3))
    block = Memory([parameter], th.nn.ParameterList([parameter]), in_numpy)
    array = block.array(parameter)
    with th.no_grad():
        parameter += 1
    assert array.tolist() == [2, 2, 2]
    assert block.weights(np.array([0.5, 2])).tolist() == [0.5, 2]
    assert str(block.weights(np.array([0.5])).dtype).endswith("float32")

"""Where the arrays of an update lie: NumPy's or PyTorch's, in the same memory, and one block of it
for all gradients.

For small networks most of the time of an update is PyTorch's bookkeeping, not arithmetic, so small
updates on the CPU run on NumPy arrays in the tensors' memory. This file and its two neighbours
``layers`` and ``heads`` are all that knows of two libraries; the rest is spelled so that both fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from typing import Any, TypeAlias

import numpy as np
import torch as th
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController
from torch import nn

#: A NumPy array or a PyTorch tensor; no static type has the operators of both.
Array: TypeAlias = Any
#: The resolver's weights w, always in NumPy, shape (K,).
Weights = NDArray[np.float64]

#: Updates with at most so many (samples × parameters) on the CPU run in NumPy.
SMALL = 2**25
#: The same where PyTorch has more than one thread.
SMALL_FOR_THREADS = 2**24


def is_small(policy: nn.Module, n_samples: int) -> bool:
    """Whether an update is small enough for NumPy to be faster than PyTorch.

    :param policy: on its device
    :param n_samples: size B of a minibatch
    """
    parameters = list(policy.parameters())
    if parameters[0].device.type != "cpu":
        return False
    limit = SMALL if th.get_num_threads() == 1 else SMALL_FOR_THREADS
    return n_samples * sum(p.numel() for p in parameters) <= limit


class Memory:
    """One block of memory for all gradients, and parameters and gradients as arrays.

    :param summed: parameters whose gradients are plain sums over samples; they lie at the
        beginning, so that these sums, the norm of all gradients and their scaling are one
        operation each
    :param policy: has all parameters
    :param in_numpy: whether arrays are NumPy's, sharing the tensors' memory, or the tensors
    """

    def __init__(self, summed: Sequence[nn.Parameter], policy: nn.Module, in_numpy: bool):
        self.in_numpy = in_numpy
        self.xp: Any = np if in_numpy else th
        firsts = {id(parameter) for parameter in summed}
        others = [p for p in policy.parameters() if id(p) not in firsts]
        self._parameters = [*summed, *others]
        sizes = [p.numel() for p in self._parameters]
        block = th.zeros(sum(sizes), device=summed[0].device)
        pieces = zip(block.split(sizes), self._parameters, strict=True)
        self._gradients = [piece.view_as(p) for piece, p in pieces]
        #: All gradients as one vector, and those of ``summed`` at its beginning.
        self.gradients = self.array(block)
        self.sums = self.gradients[: sum(sizes[: len(summed)])]

    def array(self, tensor: th.Tensor) -> Array:
        """A tensor's numbers, in its own memory."""
        return tensor.detach().numpy() if self.in_numpy else tensor.detach()

    def weights(self, weights: Weights) -> Array:
        """The resolver's weights among the other arrays."""
        single = weights.astype(np.float32)
        if self.in_numpy:
            return single
        return th.from_numpy(single).to(self._parameters[0].device)

    def gradient(self, parameter: nn.Parameter) -> Array:
        """The memory of a parameter's gradient."""
        pairs = zip(self._gradients, self._parameters, strict=True)
        return self.array(next(gradient for gradient, p in pairs if p is parameter))

    def attach(self) -> None:
        """Make the block the parameters' ``grad``."""
        for parameter, gradient in zip(self._parameters, self._gradients, strict=True):
            if parameter.grad is not gradient:
                parameter.grad = gradient

    def one_thread(self) -> AbstractContextManager[object]:
        """Hold NumPy's BLAS, where it is used, to one thread: several would wait for each other
        longer than they work.
        """
        return _blas().limit(limits=1) if self.in_numpy else nullcontext()


@cache
def _blas() -> ThreadpoolController:
    """The BLAS libraries of this process; finding them takes milliseconds."""
    return ThreadpoolController().select(user_api="blas")

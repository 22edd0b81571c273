"""Where arrays live: NumPy's or PyTorch's, and one block of memory for all gradients."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch as th
from threadpoolctl import ThreadpoolController
from torch import nn

Array = Any


#: Updates with at most so many (samples × parameters) on the CPU run in NumPy, with one thread for
#: PyTorch and with more.
SMALL, SMALL_FOR_THREADS = 2**25, 2**24


class Memory:
    """One block of memory for all gradients, and parameters and gradients as arrays.

    :param first: parameters whose gradients are plain sums over samples; they lie at the beginning,
        so that these sums, the norm of all gradients and their scaling are one operation each
    :param policy: has all parameters
    :param in_numpy: whether arrays are NumPy's, sharing the tensors' memory, or the tensors
        themselves
    """

    def __init__(self, first: list[Any], policy: nn.Module, in_numpy: bool):
        self.in_numpy, self.xp = in_numpy, np if in_numpy else th
        self._parameters = first + [
            p for p in policy.parameters() if all(p is not other for other in first)
        ]
        sizes = [parameter.numel() for parameter in self._parameters]
        flat = th.zeros(sum(sizes), device=first[0].device)
        self._gradients = [
            piece.view_as(p) for piece, p in zip(flat.split(sizes), self._parameters, strict=True)
        ]
        self.flat = self.array(flat)
        self.sums = self.flat[: sum(sizes[: len(first)])]

    def array(self, tensor: th.Tensor) -> Array:
        """A tensor's numbers, in its own memory."""
        return tensor.detach().numpy() if self.in_numpy else tensor.detach()

    def gradient(self, parameter: nn.Parameter) -> Array:
        """The memory of a parameter's gradient."""
        return self.array(
            next(
                g for g, p in zip(self._gradients, self._parameters, strict=True) if p is parameter
            )
        )

    def attach(self) -> None:
        """Make the block the parameters' ``grad``."""
        if self._parameters[0].grad is not self._gradients[0]:
            for parameter, gradient in zip(self._parameters, self._gradients, strict=True):
                parameter.grad = gradient


@cache
def _blas() -> ThreadpoolController:
    """The BLAS libraries of this process; finding them takes milliseconds."""
    return ThreadpoolController().select(user_api="blas")

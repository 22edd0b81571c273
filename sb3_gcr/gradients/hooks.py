"""The hooks that users register with a policy: who has some, and when they run.

PPO has one backward pass a minibatch. Where a Gramian takes K more, hooks are silent in these, so
that each hook runs as often as under PPO and sees what it sees there: the gradient of the step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, MutableMapping
from contextlib import contextmanager
from functools import partial
from typing import Any

from torch import nn
from torch.nn.modules import module as of_all_modules

Hook = Callable[..., Any]
Hooks = MutableMapping[int, Hook]

#: Where PyTorch keeps the hooks of a module that run in a forward pass.
FORWARD = ("_forward_hooks", "_forward_pre_hooks")
#: And in a backward pass.
BACKWARD = ("_backward_hooks", "_backward_pre_hooks")
#: Where it keeps those of all modules.
OF_ALL_BACKWARD = ("_global_backward_hooks", "_global_backward_pre_hooks")
OF_ALL = ("_global_forward_hooks", "_global_forward_pre_hooks", *OF_ALL_BACKWARD)


def is_hooked(policy: nn.Module) -> bool:
    """Whether anybody watches or changes what flows through a policy.

    :param policy: as it is now
    """
    if any(getattr(of_all_modules, name) for name in OF_ALL):
        return True
    names = FORWARD + BACKWARD
    if any(getattr(module, name) for module in policy.modules() for name in names):
        return True
    return any(
        parameter._backward_hooks or getattr(parameter, "_post_accumulate_grad_hooks", None)
        for parameter in policy.parameters()
    )


class BackwardHooks:
    """A policy's hooks that would run in any backward pass.

    :param policy: as it is now
    """

    def __init__(self, policy: nn.Module):
        places: list[Hooks] = [getattr(of_all_modules, name) for name in OF_ALL_BACKWARD]
        for module in policy.modules():
            places += [getattr(module, name) for name in BACKWARD]
        self._of_modules = [hooks for hooks in places if hooks]
        of_parameters = [parameter._backward_hooks for parameter in policy.parameters()]
        self._of_parameters: list[Hooks] = [hooks for hooks in of_parameters if hooks]
        self._silent = False

    @contextmanager
    def can_be_silenced(self) -> Iterator[None]:
        """To be held during the forward pass, in which PyTorch takes down the hooks of modules."""
        before = [dict(hooks) for hooks in self._of_modules]
        for hooks in self._of_modules:
            for key, hook in hooks.items():
                hooks[key] = partial(self._run, hook)
        try:
            yield
        finally:
            for hooks, originals in zip(self._of_modules, before, strict=True):
                hooks.update(originals)

    @contextmanager
    def silent(self) -> Iterator[None]:
        """No hook runs in the backward passes inside."""
        before = [dict(hooks) for hooks in self._of_parameters]
        for hooks in self._of_parameters:
            hooks.clear()
        self._silent = True
        try:
            yield
        finally:
            self._silent = False
            for hooks, originals in zip(self._of_parameters, before, strict=True):
                hooks.update(originals)

    def _run(self, hook: Hook, *arguments: Any) -> Any:
        return None if self._silent else hook(*arguments)

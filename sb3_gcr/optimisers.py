"""PyTorch's fused Adam with less bookkeeping per step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch as th
from torch.optim import optimizer


class KernelArguments(NamedTuple):
    """What the fused kernel takes, and where it was found; one entry for each parameter."""

    parameters: list[th.Tensor]
    averages: list[th.Tensor]
    """First moments, ``exp_avg`` of the states."""
    squares: list[th.Tensor]
    """Second moments, ``exp_avg_sq`` of the states."""
    steps: list[th.Tensor]
    """Numbers of steps, ``step`` of the states; elements of ``all_steps``."""
    all_steps: th.Tensor
    """The same as one vector, to count all of them at once."""
    in_group: list[int]
    """Ids of the group's parameters, in its order."""


class FusedAdam(th.optim.Adam):
    """``torch.optim.Adam(fused=True)`` that collects its arguments once: the same numbers, state
    and state dict.

    For small networks PyTorch's step spends most of its time looking up every parameter's state and
    recording itself for the profiler. Whatever is unusual (closures, hooks, several parameter
    groups, AMSGrad, parameters without gradient, a state that is not the one of the last step)
    takes PyTorch's own step.

    :param params: as for ``torch.optim.Adam``
    :param kwargs: as for ``torch.optim.Adam``
    """

    #: As of the last of PyTorch's own steps; not saved.
    _arguments: KernelArguments | None = None

    def __init__(self, params: Any, **kwargs: Any):
        super().__init__(params, **{**kwargs, "fused": True})

    def load_state_dict(self, state_dict: Any) -> None:
        """Load a state dict of this class or of ``torch.optim.Adam``, and stay fused."""
        super().load_state_dict(state_dict)
        for group in self.param_groups:
            group["fused"], group["foreach"] = True, None

    @th.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """One step of Adam."""
        arguments = self._arguments
        if arguments is None or closure is not None or not self._are_current(arguments):
            return self._step_of_pytorch(closure)
        gradients = [p.grad for p in arguments.parameters if p.grad is not None]
        if len(gradients) < len(arguments.parameters):
            return self._step_of_pytorch(closure)
        group = self.param_groups[0]
        arguments.all_steps.add_(1)
        th._fused_adam_(
            arguments.parameters,
            gradients,
            arguments.averages,
            arguments.squares,
            [],
            arguments.steps,
            lr=group["lr"],
            beta1=group["betas"][0],
            beta2=group["betas"][1],
            weight_decay=group["weight_decay"],
            eps=group["eps"],
            amsgrad=False,
            maximize=group["maximize"],
        )
        return None

    # else PyTorch wraps it in a record that costs as much as the kernel
    step.hooked = True  # type: ignore[attr-defined]

    def _step_of_pytorch(self, closure: Callable[[], Any] | None) -> Any:
        step = th.optim.Adam.step
        if not hasattr(step, "hooked"):
            step = self.profile_hook_step(step)
        loss = step(self, closure)
        self._arguments = self._collect()
        return loss

    def _are_current(self, arguments: KernelArguments) -> bool:
        """Whether the arguments are still what PyTorch's own step would look up."""
        if (
            self._is_unusual()
            or list(map(id, self.param_groups[0]["params"])) != arguments.in_group
        ):
            return False
        if len(self.state) != len(arguments.parameters):
            return False
        # In the order of the state: a look-up costs more than a comparison.
        for found, parameter, average, squares, step in zip(
            self.state.items(),
            arguments.parameters,
            arguments.averages,
            arguments.squares,
            arguments.steps,
            strict=True,
        ):
            owner, state = found
            if (
                owner is not parameter
                or state.get("exp_avg") is not average
                or state.get("exp_avg_sq") is not squares
                or state.get("step") is not step
            ):
                return False
        return True

    def _is_unusual(self) -> bool:
        """Whether a step has more to do than the kernel for one group of parameters."""
        group = self.param_groups[0]
        return bool(
            len(self.param_groups) > 1
            or group["amsgrad"]
            or group["capturable"]
            or group["differentiable"]
            or not group["fused"]
            or group.get("decoupled_weight_decay")
            or isinstance(group["lr"], th.Tensor)
            or self._optimizer_step_pre_hooks
            or self._optimizer_step_post_hooks
            or optimizer._global_optimizer_pre_hooks
            or optimizer._global_optimizer_post_hooks
        )

    def _collect(self) -> KernelArguments | None:
        """The kernel's arguments, if every parameter has a state and nothing is unusual."""
        in_group = list(map(id, self.param_groups[0]["params"]))
        parameters = list(self.state)
        states = list(self.state.values())
        if (
            self._is_unusual()
            or {id(parameter) for parameter in parameters} != {*in_group}
            or not all(states)
            or len({parameter.device for parameter in parameters}) > 1
        ):
            return None
        all_steps = th.stack([state["step"] for state in states])
        for state, step in zip(states, all_steps.unbind(), strict=True):
            state["step"] = step
        return KernelArguments(
            parameters,
            [state["exp_avg"] for state in states],
            [state["exp_avg_sq"] for state in states],
            [state["step"] for state in states],
            all_steps,
            in_group,
        )

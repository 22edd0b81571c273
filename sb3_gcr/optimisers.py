"""PyTorch's fused Adam with less bookkeeping per step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch as th
from torch.optim import optimizer


class FusedAdam(th.optim.Adam):
    """``torch.optim.Adam(fused=True)`` that collects its arguments once: the same numbers, state
    and state dict.

    For small networks PyTorch's step spends most of its time looking up every parameter's state and
    recording itself for the profiler. Whatever is unusual (closures, hooks, several parameter
    groups, AMSGrad, parameters without gradient, a changed state) takes PyTorch's own step.

    :param params: as for ``torch.optim.Adam``
    :param kwargs: as for ``torch.optim.Adam``
    """

    #: Parameters and their states, in the order of the kernel's arguments; not saved.
    _arguments: tuple[list[th.Tensor], ...] | None = None
    #: The steps of all parameters as one vector; the states hold its elements.
    _steps: th.Tensor

    def __init__(self, params: Any, **kwargs: Any):
        super().__init__(params, **{**kwargs, "fused": True})

    def load_state_dict(self, state_dict: Any) -> None:
        """Load a state dict of this class or of ``torch.optim.Adam``, and stay fused."""
        super().load_state_dict(state_dict)
        for group in self.param_groups:
            group["fused"], group["foreach"] = True, None
        self._arguments = None

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Add a group of parameters."""
        super().add_param_group(param_group)
        self._arguments = None

    @th.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """One step of Adam."""
        gradients = (
            [p.grad for p in self._arguments[0] if p.grad is not None]
            if self._arguments is not None
            else []
        )
        if (
            closure is not None
            or self._has_hooks()
            or self._arguments is None
            or len(gradients) < len(self._arguments[0])
        ):
            step = th.optim.Adam.step
            loss = (step if hasattr(step, "hooked") else self.profile_hook_step(step))(
                self, closure
            )
            self._arguments = self._collect()
            return loss
        parameters, averages, squares, steps = self._arguments
        group = self.param_groups[0]
        self._steps.add_(1)
        th._fused_adam_(
            parameters,
            gradients,
            averages,
            squares,
            [],
            steps,
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

    def _has_hooks(self) -> bool:
        return bool(
            self._optimizer_step_pre_hooks
            or self._optimizer_step_post_hooks
            or optimizer._global_optimizer_pre_hooks
            or optimizer._global_optimizer_post_hooks
        )

    def _collect(self) -> tuple[list[th.Tensor], ...] | None:
        """The kernel's arguments, if every parameter has a state and nothing is unusual."""
        group = self.param_groups[0]
        unusual = (
            len(self.param_groups) > 1
            or group["amsgrad"]
            or group["capturable"]
            or isinstance(group["lr"], th.Tensor)
        )
        parameters = group["params"]
        states = [
            state for state in (self.state.get(parameter) for parameter in parameters) if state
        ]
        if (
            unusual
            or len(states) < len(parameters)
            or len({parameter.device for parameter in parameters}) > 1
        ):
            return None
        self._steps = th.stack([state["step"] for state in states])
        for state, step in zip(states, self._steps.unbind(), strict=True):
            state["step"] = step
        return parameters, *(
            [state[name] for state in states] for name in ("exp_avg", "exp_avg_sq", "step")
        )

"""When the hooks of a policy run."""

from __future__ import annotations

from typing import Any

import pytest
import torch as th
from torch import nn
from torch.nn.modules import module as of_all_modules

from sb3_gcr.gradients.hooks import BackwardHooks, is_hooked


def net() -> Any:
    return nn.Sequential(nn.Linear(2, 3), nn.Tanh(), nn.Linear(3, 1))


def on_a_parameter(policy: Any, hook: Any) -> Any:
    return policy[0].weight.register_hook(lambda gradient: hook())


def before_a_module(policy: Any, hook: Any) -> Any:
    return policy[2].register_full_backward_pre_hook(lambda *_: hook())


def behind_a_module(policy: Any, hook: Any) -> Any:
    return policy[2].register_full_backward_hook(lambda *_: hook())


def of_all(policy: Any, hook: Any) -> Any:
    return of_all_modules.register_module_full_backward_hook(
        lambda module, *_: hook() if module is policy[2] else None
    )


@pytest.mark.parametrize("register", [on_a_parameter, before_a_module, behind_a_module, of_all])
@pytest.mark.filterwarnings("ignore:Full backward hook is firing")
def test_hooks_are_silent_where_they_are_told_to_be(register: Any) -> None:
    policy, calls = net(), []
    handle = register(policy, lambda: calls.append(1))
    try:
        assert is_hooked(policy)
        hooks = BackwardHooks(policy)
        with hooks.can_be_silenced():
            output = policy(th.ones(4, 2)).sum()
        with hooks.silent():
            for _ in range(3):
                th.autograd.grad(output, list(policy.parameters()), retain_graph=True)
        assert calls == []
        output.backward(retain_graph=True)
        assert len(calls) == 1
        with pytest.raises(RuntimeError), hooks.silent():
            raise RuntimeError
        output.backward()
        assert len(calls) == 2
        policy(th.ones(4, 2)).sum().backward()  # without us, as it was
        assert len(calls) == 3
    finally:
        handle.remove()
    assert not is_hooked(policy)
    policy(th.ones(4, 2)).sum().backward()
    assert len(calls) == 3


def test_a_hook_that_changes_a_gradient_changes_it_once() -> None:
    policy = net()
    policy[0].weight.register_hook(lambda gradient: 0 * gradient)
    hooks = BackwardHooks(policy)
    with hooks.can_be_silenced():
        output = policy(th.ones(4, 2)).sum()
    with hooks.silent():
        (gradient,) = th.autograd.grad(output, policy[0].weight, retain_graph=True)
    assert gradient.abs().sum() > 0
    output.backward()
    assert policy[0].weight.grad.abs().sum() == 0


def test_forward_and_post_accumulate_hooks_are_hooks() -> None:
    for register in (
        lambda policy: policy[1].register_forward_hook(lambda *_: None),
        lambda policy: policy[1].register_forward_pre_hook(lambda *_: None),
        lambda policy: policy[0].bias.register_post_accumulate_grad_hook(lambda _: None),
    ):
        policy = net()
        assert not is_hooked(policy)
        handle = register(policy)
        assert is_hooked(policy)
        handle.remove()
        assert not is_hooked(policy)

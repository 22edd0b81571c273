"""The fused Adam against PyTorch's."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch as th
from torch.optim.optimizer import register_optimizer_step_post_hook

from sb3_gcr.optimisers import FusedAdam

SHAPES = [(4, 3), (4,), (2, 4), (2,)]


def networks(kwargs: Any) -> Any:
    th.manual_seed(0)
    first = [th.nn.Parameter(th.randn(shape)) for shape in SHAPES]
    second = [th.nn.Parameter(parameter.detach().clone()) for parameter in first]
    return (first, th.optim.Adam(first, **kwargs)), (second, FusedAdam(second, **kwargs))


def train(pairs: Any, steps: int, seed: int = 0, lr: float | None = None) -> None:
    for parameters, optimizer in pairs:
        th.manual_seed(seed)
        if lr is not None:
            optimizer.param_groups[0]["lr"] = lr
        for _ in range(steps):
            for parameter in parameters:
                parameter.grad = th.randn_like(parameter)
            optimizer.step()


def same(pairs: Any) -> None:
    for mine, theirs in zip(pairs[0][0], pairs[1][0], strict=True):
        th.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"eps": 1e-5},
        {"betas": (0.5, 0.9), "weight_decay": 0.1},
        {"amsgrad": True},
        {"maximize": True},
    ],
)
def test_same_steps_as_pytorch(kwargs: Any) -> None:
    pairs = networks({"lr": 0.01, **kwargs})
    train(pairs, 5)
    same(pairs)
    train(pairs, 5, seed=1, lr=0.1)
    same(pairs)
    assert (pairs[1][1]._arguments is None) is bool(kwargs.get("amsgrad"))


def test_a_parameter_without_gradient_is_left_alone() -> None:
    pairs = networks({"lr": 0.01})
    train(pairs, 3)
    for parameters, optimizer in pairs:
        for parameter in parameters:
            parameter.grad = None
        parameters[0].grad = th.ones_like(parameters[0])
        optimizer.step()
    same(pairs)
    train(pairs, 3, seed=2)
    same(pairs)


@pytest.mark.parametrize("source", [0, 1])
def test_state_dicts_are_those_of_adam(source: int) -> None:
    pairs = networks({"lr": 0.01})
    train(pairs, 3)
    state = copy.deepcopy(pairs[source][1].state_dict())
    others = networks({"lr": 0.5})
    for (parameters, optimizer), (origin, _) in zip(
        others, (pairs[source], pairs[source]), strict=True
    ):
        with th.no_grad():
            for mine, theirs in zip(parameters, origin, strict=True):
                mine.copy_(theirs)
        optimizer.load_state_dict(copy.deepcopy(state))
    train(others, 4, seed=3)
    same(others)
    assert others[1][1]._arguments is not None


def test_groups_closures_and_copies() -> None:
    pairs = networks({"lr": 0.01})
    train(pairs, 2)
    extra = [th.nn.Parameter(th.ones(3)) for _ in range(2)]
    for (parameters, optimizer), parameter in zip(pairs, extra, strict=True):
        optimizer.add_param_group({"params": [parameter], "lr": 0.1})
        parameters.append(parameter)
    train(pairs, 3, seed=4)
    same(pairs)
    assert pairs[1][1]._arguments is None
    (parameters, optimizer) = networks({"lr": 0.01})[1]
    train([(parameters, optimizer)], 2)
    assert optimizer.step(lambda: th.tensor(7.0)) == 7
    clone = copy.deepcopy(optimizer)
    assert clone.state_dict()["state"][0]["step"] == optimizer.state_dict()["state"][0]["step"] == 3


@pytest.mark.parametrize("other_adams", [False, True])
def test_hooks_run_once_a_step(other_adams: bool) -> None:
    _, (parameters, optimizer) = networks({"lr": 0.01})
    if other_adams:  # PyTorch wraps the step of a class when the first of its optimisers is made
        th.optim.Adam([th.nn.Parameter(th.ones(1))])
    calls: list[str] = []
    train([(parameters, optimizer)], 2)
    handles = [
        optimizer.register_step_pre_hook(lambda *_: calls.append("before")),
        optimizer.register_step_post_hook(lambda *_: calls.append("after")),
    ]
    train([(parameters, optimizer)], 2)
    assert calls == ["before", "after"] * 2
    for handle in handles:
        handle.remove()
    train([(parameters, optimizer)], 2)
    assert len(calls) == 4
    assert [state["step"] for state in optimizer.state.values()] == [6] * len(SHAPES)


def test_hooks_of_all_optimisers_run() -> None:
    calls: list[Any] = []
    handle = register_optimizer_step_post_hook(lambda optimizer, *_: calls.append(optimizer))
    try:
        pairs = networks({"lr": 0.01})
        train(pairs, 4)
        same(pairs)
    finally:
        handle.remove()
    assert calls == [pairs[0][1]] * 4 + [pairs[1][1]] * 4

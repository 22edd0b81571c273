"""The fused Adam against PyTorch's."""

from __future__ import annotations

import copy
import pickle
from collections import defaultdict
from collections.abc import Callable
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


def count_pytorchs_steps(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """From now on; a step of PyTorch's own is several times as slow."""
    calls: list[None] = []
    original = th.optim.Adam.step

    def step(*args: Any, **kwargs: Any) -> Any:
        calls.append(None)
        return original(*args, **kwargs)

    step.hooked = True  # type: ignore[attr-defined]
    monkeypatch.setattr(th.optim.Adam, "step", step)
    return lambda: len(calls)


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
def test_same_steps_as_pytorch(kwargs: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """All but the first are the kernel's, where that has all there is to do."""
    pairs = networks({"lr": 0.01, **kwargs})
    train(pairs, 5)
    same(pairs)
    n_steps = count_pytorchs_steps(monkeypatch)
    train(pairs[1:], 5, seed=1, lr=0.1)
    assert n_steps() == (5 if kwargs.get("amsgrad") else 0)
    train(pairs[:1], 5, seed=1, lr=0.1)
    same(pairs)


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
def test_state_dicts_are_those_of_adam(source: int, monkeypatch: pytest.MonkeyPatch) -> None:
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
    train(others, 1, seed=3)
    n_steps = count_pytorchs_steps(monkeypatch)
    train(others[1:], 3, seed=4)
    assert n_steps() == 0
    train(others[:1], 3, seed=4)
    same(others)


def test_groups_closures_and_copies() -> None:
    pairs = networks({"lr": 0.01})
    train(pairs, 2)
    extra = [th.nn.Parameter(th.ones(3)) for _ in range(2)]
    for (parameters, optimizer), parameter in zip(pairs, extra, strict=True):
        optimizer.add_param_group({"params": [parameter], "lr": 0.1})
        parameters.append(parameter)
    train(pairs, 3, seed=4)
    same(pairs)
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


def clear(optimizer: Any) -> None:
    optimizer.state.clear()


def replace_state(optimizer: Any) -> None:
    optimizer.state = defaultdict(dict)


def new_moments(optimizer: Any) -> None:
    for state in optimizer.state.values():
        state.update({name: th.zeros_like(number) for name, number in state.items()})


def zero_moments(optimizer: Any) -> None:
    for state in optimizer.state.values():
        for number in state.values():
            number.zero_()


def one_moment(optimizer: Any) -> None:
    list(optimizer.state.values())[2]["exp_avg_sq"] = th.ones(SHAPES[2])


def one_step(optimizer: Any) -> None:
    list(optimizer.state.values())[1]["step"] = th.tensor(100.0)


def one_state(optimizer: Any) -> None:
    parameter = optimizer.param_groups[0]["params"][3]
    optimizer.state[parameter] = {}


def forget_one(optimizer: Any) -> None:
    optimizer.state.pop(optimizer.param_groups[0]["params"][0])


def drop_a_parameter(optimizer: Any) -> None:
    optimizer.state.pop(optimizer.param_groups[0]["params"].pop())


def stop_stepping_a_parameter(optimizer: Any) -> None:
    optimizer.param_groups[0]["params"].pop()


def other_settings(optimizer: Any) -> None:
    optimizer.param_groups[0].update(betas=(0.3, 0.5), eps=1e-3, weight_decay=0.5, maximize=True)


def tensor_as_rate(optimizer: Any) -> None:
    optimizer.param_groups[0]["lr"] = th.tensor(0.2)


def decoupled_decay(optimizer: Any) -> None:
    optimizer.param_groups[0].update(weight_decay=0.5, decoupled_weight_decay=True)


def another_group_list(optimizer: Any) -> None:
    optimizer.param_groups = [dict(optimizer.param_groups[0])]


def reverse_the_state(optimizer: Any) -> None:
    optimizer.state = defaultdict(dict, reversed(list(optimizer.state.items())))


@pytest.mark.parametrize(
    "change",
    [
        clear,
        replace_state,
        new_moments,
        zero_moments,
        one_moment,
        one_step,
        one_state,
        forget_one,
        drop_a_parameter,
        stop_stepping_a_parameter,
        other_settings,
        tensor_as_rate,
        decoupled_decay,
        another_group_list,
        reverse_the_state,
    ],
    ids=lambda change: change.__name__,
)
def test_a_state_that_somebody_has_changed_is_the_one_that_counts(change: Any) -> None:
    """What PyTorch's Adam does, with parameters and state."""
    pairs = networks({"lr": 0.01})
    train(pairs, 4)
    for _, optimizer in pairs:
        change(optimizer)
    for seed in (5, 6):
        train(pairs, 3, seed=seed)
        same(pairs)
    for mine, its in zip(*(optimizer.state.values() for _, optimizer in pairs), strict=True):
        for name, number in mine.items():
            th.testing.assert_close(its[name], number, rtol=1e-4, atol=1e-7)


def test_the_kernel_comes_back_after_a_change(monkeypatch: pytest.MonkeyPatch) -> None:
    _, (parameters, optimizer) = networks({"lr": 0.01})
    train([(parameters, optimizer)], 3)
    clear(optimizer)
    n_steps = count_pytorchs_steps(monkeypatch)
    train([(parameters, optimizer)], 5)
    assert n_steps() == 1


def test_a_copy_and_its_original_go_their_own_ways() -> None:
    """A shallow copy shares the state; a pickled one has its own."""
    pairs = networks({"lr": 0.01})
    train(pairs, 3)
    for _, optimizer in pairs:
        other = copy.copy(optimizer)
        other.step()
        optimizer.step()
        other.step()
    same(pairs)
    (parameters, optimizer) = pairs[1]
    clone = pickle.loads(pickle.dumps(optimizer))
    assert type(clone) is FusedAdam
    theirs = clone.param_groups[0]["params"]
    train([(parameters, optimizer), (theirs, clone)], 3, seed=7)
    for mine, its in zip(parameters, theirs, strict=True):
        assert th.equal(mine, its)
        assert mine is not its

"""Which policies are computed by hand; what users may change is in ``test_changed_policies``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch as th
from torch import nn
from torch.nn.modules import module as of_all_modules

from sb3_gcr.gradients import METHODS, choose
from sb3_gcr.gradients.fitting import fits, fits_mlp
from tests.networks import FITTING, OTHERS, make_policy


@pytest.mark.parametrize("name", list(FITTING))
def test_linear_layers_and_common_activations_fit(name: str) -> None:
    assert fits(make_policy(**FITTING[name])[0])


@pytest.mark.parametrize("name", list(OTHERS))
def test_everything_else_does_not(name: str) -> None:
    assert not fits(make_policy(**OTHERS[name])[0])


def freeze(policy: Any) -> None:
    policy.action_net.weight.requires_grad_(False)


def double(policy: Any) -> None:
    policy.double()


def extra_parameter(policy: Any) -> None:
    policy.extra = nn.Parameter(th.zeros(1))


def half_a_layer(policy: Any) -> None:
    policy.value_net.weight.data = policy.value_net.weight.data.half()


def strided(policy: Any) -> None:
    policy.action_net.weight.data = th.zeros(64, 2).T


def without_bias(policy: Any) -> None:
    policy.value_net = nn.Linear(64, 5, bias=False)


def other_class(policy: Any) -> None:
    class Linear(nn.Linear):
        """Could do anything."""

    policy.value_net = Linear(64, 5)


def other_parameter_class(policy: Any) -> None:
    class Parameter(nn.Parameter):
        """Could do anything."""

    policy.action_net.bias = Parameter(policy.action_net.bias.detach())


def forward_hook(policy: Any) -> None:
    policy.mlp_extractor.register_forward_hook(lambda *_: None)


def tensor_hook(policy: Any) -> None:
    policy.action_net.weight.register_hook(lambda gradient: 2 * gradient)


def post_accumulate_hook(policy: Any) -> None:
    policy.action_net.weight.register_post_accumulate_grad_hook(lambda parameter: None)


def optimiser_without_a_parameter(policy: Any) -> None:
    policy.optimizer = th.optim.SGD(list(policy.parameters())[1:], lr=0.1)


def optimiser_with_a_parameter_more(policy: Any) -> None:
    more = nn.Parameter(th.zeros(1))
    policy.optimizer = th.optim.SGD([*policy.parameters(), more], lr=0.1)


def in_place(policy: Any) -> None:
    policy.mlp_extractor.policy_net[1] = nn.ReLU(inplace=True)


def weight_norm(policy: Any) -> None:
    nn.utils.parametrizations.weight_norm(policy.action_net)


def parametrised_log_std(policy: Any) -> None:
    nn.utils.parametrize.register_parametrization(policy, "log_std", nn.Hardtanh())


@pytest.mark.parametrize(
    "change",
    [
        freeze,
        double,
        extra_parameter,
        half_a_layer,
        strided,
        without_bias,
        other_class,
        other_parameter_class,
        forward_hook,
        tensor_hook,
        post_accumulate_hook,
        optimiser_without_a_parameter,
        optimiser_with_a_parameter_more,
        in_place,
        weight_norm,
        parametrised_log_std,
    ],
    ids=lambda change: change.__name__,
)
def test_what_does_not_fit_any_more(change: Callable[[Any], None]) -> None:
    policy, _ = make_policy()
    assert fits(policy)
    change(policy)
    assert not fits(policy)


@pytest.mark.parametrize(
    "register",
    [
        of_all_modules.register_module_forward_hook,
        of_all_modules.register_module_forward_pre_hook,
        of_all_modules.register_module_full_backward_hook,
        of_all_modules.register_module_full_backward_pre_hook,
    ],
)
def test_hooks_of_all_modules_count_as_the_policys(register: Any) -> None:
    policy, _ = make_policy()
    handle = register(lambda *_: None)
    try:
        assert not fits(policy)
    finally:
        handle.remove()
    assert fits(policy)


@pytest.mark.parametrize(
    ("modules", "expected"),
    [
        ([nn.Linear(2, 3)], True),
        ([nn.Linear(2, 3), nn.Tanh(), nn.Linear(3, 1)], True),
        ([nn.Linear(2, 3), nn.Linear(3, 1)], False),
        ([nn.Linear(2, 3), nn.Tanh()], False),
        ([nn.Tanh(), nn.Linear(3, 1)], False),
        ([nn.Linear(2, 3), nn.Dropout(), nn.Linear(3, 1)], False),
        ([], False),
    ],
)
def test_layers_and_activations_in_turn(modules: Any, expected: bool) -> None:
    assert fits_mlp(modules) is expected


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", ["default", "gSDE"])
def test_the_choice_of_a_way(method: str, name: str) -> None:
    policy, _ = make_policy(**{**FITTING, **OTHERS}[name])
    if (method, name) == ("one_backward", "gSDE"):
        with pytest.raises(ValueError, match="must be 'auto' or 'passes' for this policy"):
            choose(policy, method, 16)
        return
    by_hand = name == "default" and method != "passes"
    expected = "one backward pass in NumPy" if by_hand else "K backward passes in PyTorch"
    assert choose(policy, method, 16).way == expected

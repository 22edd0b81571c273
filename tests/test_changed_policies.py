"""What a user may do to a policy between two ``learn``s, or while one runs: whatever it is, GCRPPO
trains what an update written out with autograd trains, and with one component what PPO trains.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn
from torch.nn.modules import module as of_all_modules

from sb3_gcr import GCRPPO, RewardSpec
from tests.envs import SPEC, Env

ONE = RewardSpec(("only",), (0,))
#: Nothing is normalised or clipped, so that the losses of the oracle are one line each.
SETTINGS: dict[str, Any] = {
    "n_steps": 32,
    "batch_size": 16,
    "n_epochs": 2,
    "learning_rate": 3e-3,
    "clip_range": 1e3,
    "normalize_advantage": False,
    "ent_coef": 0.01,
    "seed": 0,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [4, 4]},
}
N_MINIBATCHES = 4


def weigh(gramian: Any, levels: Any, rng: Any) -> Any:
    """Weights in which each number of the Gramian shows, and 1 for one component."""
    norms = np.sqrt(gramian.diagonal()) + 1e-12
    return 1 + 0.5 * (np.tril(gramian, -1) / norms / norms[:, None]).sum(1)


class Hooks:
    """What the hooks of a change have seen; silent while the oracle takes its K passes."""

    def __init__(self) -> None:
        self.silent = False
        self.n_calls = 0

    def count(self, result: Any = None) -> Any:
        if self.silent:
            return None
        self.n_calls += 1
        return result


class Oracle(GCRPPO):
    """The update in the words of SB3's PPO, with a call of backward for each component's row."""

    hooks: Hooks

    def train(self) -> None:
        policy: Any = self.policy
        policy.set_training_mode(True)
        self._update_learning_rate(policy.optimizer)
        for _ in range(self.n_epochs):
            for batch in self.rollout_buffer.get(self.batch_size):
                values, log_prob, entropy = policy.evaluate_actions(
                    batch.observations, batch.actions
                )
                ratio = (log_prob - batch.old_log_prob).exp()
                losses = [-(ratio * advantages).mean() for advantages in batch.advantages.T]
                jacobian = np.stack([self._row(loss) for loss in losses])
                weights = weigh(jacobian @ jacobian.T, None, None)
                policy_loss = sum(w * loss for w, loss in zip(weights, losses, strict=True))
                value_loss = sum(
                    nn.functional.mse_loss(returns, value)
                    for returns, value in zip(batch.returns.T, values.T, strict=True)
                )
                loss = policy_loss - self.ent_coef * entropy.mean() + self.vf_coef * value_loss
                policy.optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(policy.parameters(), self.max_grad_norm)
                policy.optimizer.step()

    def _row(self, loss: th.Tensor) -> Any:
        """The gradient of a loss by all parameters; what these had before comes back."""
        parameters = list(self.policy.parameters())
        before = [parameter.grad for parameter in parameters]
        self.policy.zero_grad(set_to_none=True)
        self.hooks.silent = True
        if loss.requires_grad:
            loss.backward(retain_graph=True)
        self.hooks.silent = False
        parts = []
        for parameter, gradient in zip(parameters, before, strict=True):
            own = th.zeros_like(parameter) if parameter.grad is None else parameter.grad
            parts.append(own.detach().double().flatten())
            parameter.grad = gradient
        return th.cat(parts).numpy()


def actor_of(policy: Any) -> list[nn.Parameter]:
    modules = (policy.mlp_extractor.policy_net, policy.action_net)
    return [*modules[0].parameters(), *modules[1].parameters(), policy.log_std]


def freeze(parameters: Any) -> None:
    for parameter in parameters:
        parameter.requires_grad_(False)


def new_optimiser(policy: Any, optimiser: Any = th.optim.Adam, **kwargs: Any) -> None:
    policy.optimizer = optimiser(policy.parameters(), lr=3e-3, **kwargs)


# ------------------------------------------------------------------- changes


def freeze_actor(policy: Any, hooks: Hooks) -> None:
    freeze(actor_of(policy))


def freeze_critic(policy: Any, hooks: Hooks) -> None:
    freeze([*policy.mlp_extractor.value_net.parameters(), *policy.value_net.parameters()])


def freeze_first_layer(policy: Any, hooks: Hooks) -> None:
    freeze(policy.mlp_extractor.policy_net[0].parameters())


def freeze_log_std(policy: Any, hooks: Hooks) -> None:
    freeze([policy.log_std])


def freeze_and_step_the_critic_alone(policy: Any, hooks: Hooks) -> None:
    freeze(actor_of(policy))
    critic = [parameter for parameter in policy.parameters() if parameter.requires_grad]
    policy.optimizer = th.optim.SGD(critic, lr=0.1)


def step_the_critic_alone(policy: Any, hooks: Hooks) -> None:
    critic = [*policy.mlp_extractor.value_net.parameters(), *policy.value_net.parameters()]
    policy.optimizer = th.optim.SGD(critic, lr=0.1)


def replace_a_layer_and_the_optimiser(policy: Any, hooks: Hooks) -> None:
    th.manual_seed(7)
    policy.mlp_extractor.policy_net[0] = nn.Linear(4, 4)
    new_optimiser(policy)


def replace_a_layer_alone(policy: Any, hooks: Hooks) -> None:
    th.manual_seed(7)
    policy.action_net = nn.Linear(4, 2)


def replace_the_activation(policy: Any, hooks: Hooks) -> None:
    policy.mlp_extractor.policy_net[1] = nn.GELU()


def replace_the_features_extractor(policy: Any, hooks: Hooks) -> None:
    class Scaled(BaseFeaturesExtractor):
        def __init__(self, space: Any):
            super().__init__(space, 4)
            self.scale = nn.Parameter(th.full((4,), 0.5))

        def forward(self, observations: th.Tensor) -> th.Tensor:
            return self.scale * observations

    policy.features_extractor = Scaled(policy.observation_space)
    new_optimiser(policy)


def replace_the_hidden_layers_by_one_module(policy: Any, hooks: Hooks) -> None:
    th.manual_seed(7)
    policy.mlp_extractor.policy_net = nn.Linear(4, 4)
    new_optimiser(policy)


def replace_the_container(policy: Any, hooks: Hooks) -> None:
    class Residual(nn.Sequential):
        def forward(self, features: th.Tensor) -> th.Tensor:
            return features + super().forward(features)

    policy.mlp_extractor.policy_net = Residual(*policy.mlp_extractor.policy_net)


def replace_the_optimiser(policy: Any, hooks: Hooks) -> None:
    new_optimiser(policy, th.optim.SGD, momentum=0.9)


def other_betas_and_decay(policy: Any, hooks: Hooks) -> None:
    policy.optimizer.param_groups[0].update(betas=(0.5, 0.9), weight_decay=0.1)


def clear_the_state(policy: Any, hooks: Hooks) -> None:
    policy.optimizer.state.clear()


def replace_the_state(policy: Any, hooks: Hooks) -> None:
    policy.optimizer.state = defaultdict(dict)


def replace_the_moments(policy: Any, hooks: Hooks) -> None:
    for state in policy.optimizer.state.values():
        state.update({name: th.zeros_like(number) for name, number in state.items()})


def zero_the_moments(policy: Any, hooks: Hooks) -> None:
    for state in policy.optimizer.state.values():
        for number in state.values():
            number.zero_()


def clear_the_state_of_one_parameter(policy: Any, hooks: Hooks) -> None:
    policy.optimizer.state.pop(policy.action_net.weight)


def reload_the_state(policy: Any, hooks: Hooks) -> None:
    policy.optimizer.load_state_dict(policy.optimizer.state_dict())


def two_groups(policy: Any, hooks: Hooks) -> None:
    parameters = [*policy.parameters()]
    groups = [{"params": parameters[:3], "weight_decay": 0.1}, {"params": parameters[3:]}]
    policy.optimizer = type(policy.optimizer)(groups, lr=3e-3)


def forward_hook(policy: Any, hooks: Hooks) -> None:
    policy.mlp_extractor.policy_net[0].register_forward_hook(
        lambda module, inputs, output: hooks.count(0.5 * output)
    )


def forward_pre_hook(policy: Any, hooks: Hooks) -> None:
    policy.action_net.register_forward_pre_hook(
        lambda module, inputs: hooks.count((0.5 * inputs[0],))
    )


def backward_hook(policy: Any, hooks: Hooks) -> None:
    policy.action_net.register_full_backward_hook(
        lambda module, into, out: hooks.count(tuple(0.5 * gradient for gradient in into))
    )


def backward_pre_hook(policy: Any, hooks: Hooks) -> None:
    policy.action_net.register_full_backward_pre_hook(
        lambda module, out: hooks.count(tuple(0.5 * gradient for gradient in out))
    )


def tensor_hook(policy: Any, hooks: Hooks) -> None:
    policy.action_net.weight.register_hook(lambda gradient: hooks.count(0.5 * gradient))


def mask_by_a_tensor_hook(policy: Any, hooks: Hooks) -> None:
    mask = th.tensor([[1.0], [0.0]])
    policy.action_net.weight.register_hook(lambda gradient: hooks.count(mask * gradient))


def post_accumulate_hook(policy: Any, hooks: Hooks) -> None:
    def halve(parameter: nn.Parameter) -> None:
        if not hooks.silent:
            hooks.count()
            assert parameter.grad is not None
            parameter.grad.mul_(0.5)

    policy.action_net.weight.register_post_accumulate_grad_hook(halve)


def optimiser_hook(policy: Any, hooks: Hooks) -> None:
    def halve(optimiser: Any, args: Any, kwargs: Any) -> None:
        hooks.count()
        policy.action_net.weight.grad.mul_(0.5)

    policy.optimizer.register_step_pre_hook(halve)


def override_evaluate_actions(policy: Any, hooks: Hooks) -> None:
    original = policy.evaluate_actions

    def halved(observations: Any, actions: Any) -> Any:
        values, log_prob, entropy = original(observations, actions)
        return 2 * values, 0.5 * log_prob, entropy

    policy.evaluate_actions = halved


def override_the_action_distribution(policy: Any, hooks: Hooks) -> None:
    original = policy.action_dist.proba_distribution
    policy.action_dist.proba_distribution = lambda mean, log_std: original(
        th.tanh(mean), log_std.clamp(max=-0.1)
    )


def override_extract_features(policy: Any, hooks: Hooks) -> None:
    original = policy.extract_features
    policy.extract_features = lambda observations, *args: 0.5 * original(observations, *args)


def override_the_extractors_forward(policy: Any, hooks: Hooks) -> None:
    original = policy.features_extractor.forward
    policy.features_extractor.forward = lambda observations: 0.5 * original(observations)


def override_the_mlps_forward(policy: Any, hooks: Hooks) -> None:
    original = policy.mlp_extractor.forward_actor
    policy.mlp_extractor.forward_actor = lambda features: 0.5 * original(features)


def override_a_layers_forward(policy: Any, hooks: Hooks) -> None:
    layer = policy.mlp_extractor.policy_net[0]
    original = layer.forward
    layer.forward = lambda features: 0.5 * original(features)


def override_an_activations_forward(policy: Any, hooks: Hooks) -> None:
    policy.mlp_extractor.policy_net[1].forward = th.sigmoid


def tie_a_weight(policy: Any, hooks: Hooks) -> None:
    hidden = policy.mlp_extractor
    hidden.value_net[0].weight = hidden.policy_net[0].weight


def share_a_layer(policy: Any, hooks: Hooks) -> None:
    hidden = policy.mlp_extractor
    hidden.value_net[0] = hidden.policy_net[0]


def share_all_hidden_layers(policy: Any, hooks: Hooks) -> None:
    policy.mlp_extractor.value_net = policy.mlp_extractor.policy_net
    new_optimiser(policy)


def same_layer_twice(policy: Any, hooks: Hooks) -> None:
    hidden = policy.mlp_extractor
    hidden.policy_net[2] = hidden.policy_net[0]


def log_std_as_a_buffer(policy: Any, hooks: Hooks) -> None:
    log_std = policy.log_std.detach().clone()
    del policy.log_std
    policy.register_buffer("log_std", log_std)


def one_log_std_for_all_actions(policy: Any, hooks: Hooks) -> None:
    policy.log_std = nn.Parameter(th.zeros(1))
    new_optimiser(policy)


def set_log_std(policy: Any, hooks: Hooks) -> None:
    with th.no_grad():
        policy.log_std.fill_(-0.5)


def new_data_of_log_std(policy: Any, hooks: Hooks) -> None:
    policy.log_std.data = th.full((2,), -0.5)


def an_extra_parameter(policy: Any, hooks: Hooks) -> None:
    policy.extra = nn.Parameter(th.ones(3))
    new_optimiser(policy)


def nothing(policy: Any, hooks: Hooks) -> None:
    """As it was."""


#: Changes after which one backward pass still computes what the policy computes.
BY_HAND = (
    nothing,
    replace_a_layer_and_the_optimiser,
    replace_the_activation,
    replace_the_optimiser,
    other_betas_and_decay,
    clear_the_state,
    replace_the_state,
    replace_the_moments,
    zero_the_moments,
    clear_the_state_of_one_parameter,
    reload_the_state,
    two_groups,
    optimiser_hook,
    set_log_std,
    new_data_of_log_std,
)
BY_AUTOGRAD = (
    freeze_actor,
    freeze_critic,
    freeze_first_layer,
    freeze_log_std,
    freeze_and_step_the_critic_alone,
    step_the_critic_alone,
    replace_a_layer_alone,
    replace_the_features_extractor,
    replace_the_hidden_layers_by_one_module,
    replace_the_container,
    forward_hook,
    forward_pre_hook,
    backward_hook,
    backward_pre_hook,
    tensor_hook,
    mask_by_a_tensor_hook,
    post_accumulate_hook,
    override_evaluate_actions,
    override_the_action_distribution,
    override_extract_features,
    override_the_extractors_forward,
    override_the_mlps_forward,
    override_a_layers_forward,
    override_an_activations_forward,
    tie_a_weight,
    share_a_layer,
    share_all_hidden_layers,
    same_layer_twice,
    log_std_as_a_buffer,
    one_log_std_for_all_actions,
    an_extra_parameter,
)
Change = Callable[[Any, Hooks], None]


class Trained(NamedTuple):
    """What a training with a change in the middle leaves behind."""

    parameters: dict[str, th.Tensor]
    n_calls: int
    logged: dict[str, Any]


def train(algorithm: Any, spec: RewardSpec, change: Change, **kwargs: Any) -> Trained:
    """Train a rollout, make a change, train another one."""
    hooks = Hooks()
    if algorithm is Oracle:
        algorithm = type("TheOracle", (Oracle,), {"hooks": hooks})
        kwargs["policy_kwargs"] = {"net_arch": [4, 4], "optimizer_class": th.optim.Adam}
    env = make_vec_env(lambda: Env(spec, p_end=0.0, limit=1000), 1, seed=0)
    model = algorithm("MlpPolicy", env, **{**SETTINGS, **kwargs})
    model.learn(32)
    change(model.policy, hooks)
    model.learn(32, reset_num_timesteps=False)
    parameters = {name: p.detach().clone() for name, p in model.policy.named_parameters()}
    return Trained(parameters, hooks.n_calls, model.logger.name_to_value)


def same(first: Trained, second: Trained) -> None:
    assert first.parameters.keys() == second.parameters.keys()
    for name, parameter in first.parameters.items():
        th.testing.assert_close(second.parameters[name], parameter, rtol=1e-3, atol=2e-5, msg=name)


def name_of(change: Change) -> str:
    return change.__name__


@pytest.mark.parametrize("change", BY_HAND + BY_AUTOGRAD, ids=name_of)
def test_a_changed_policy_is_trained_as_it_is(change: Change) -> None:
    """Against the oracle, in both ways."""
    expected = train(Oracle, SPEC, change)
    kwargs = {"resolver": weigh}
    auto = train(GCRPPO, SPEC, change, **kwargs)
    passes = train(GCRPPO, SPEC, change, gramian_method="passes", **kwargs)
    assert bool(auto.logged["gcr/one_backward"]) is (change in BY_HAND)
    same(passes, auto)
    same(expected, passes)
    assert auto.n_calls == passes.n_calls == expected.n_calls


@pytest.mark.parametrize("change", BY_HAND + BY_AUTOGRAD, ids=name_of)
def test_a_changed_policy_with_one_component_is_ppos(change: Change) -> None:
    """SB3's own loop bit for bit, and ours, which an ``advantage_scope`` asks for, to rounding."""
    expected = train(PPO, ONE, change)
    scalar = train(GCRPPO, ONE, change)
    assert all(
        th.equal(scalar.parameters[name], parameter)
        for name, parameter in expected.parameters.items()
    )
    for method in ("auto", "passes"):
        ours = train(GCRPPO, ONE, change, advantage_scope="rollout", gramian_method=method)
        assert "gcr/one_backward" in ours.logged
        same(expected, ours)
        assert ours.n_calls == scalar.n_calls == expected.n_calls


@pytest.mark.parametrize(
    "change",
    [backward_hook, backward_pre_hook, tensor_hook, post_accumulate_hook, optimiser_hook],
    ids=name_of,
)
def test_hooks_of_the_backward_pass_run_once_a_minibatch(change: Change) -> None:
    assert train(GCRPPO, SPEC, change).n_calls == N_MINIBATCHES


@pytest.mark.filterwarnings("ignore:Full backward hook is firing")
def test_hooks_of_all_modules_run_as_often_as_under_ppo() -> None:
    counts = []
    for algorithm, spec in ((PPO, ONE), (GCRPPO, SPEC)):
        hooks = Hooks()
        env = make_vec_env(lambda spec=spec: Env(spec, p_end=0.0, limit=1000), 1, seed=0)
        model = algorithm("MlpPolicy", env, **SETTINGS)
        handles = [
            of_all_modules.register_module_forward_hook(lambda *_, h=hooks: h.count()),
            of_all_modules.register_module_full_backward_pre_hook(lambda *_, h=hooks: h.count()),
        ]
        try:
            model.learn(64)
        finally:
            for handle in handles:
                handle.remove()
        counts.append(hooks.n_calls)
    assert counts[0] == counts[1] > 0


def test_hooks_are_what_they_were_after_an_update() -> None:
    env = make_vec_env(Env, 1, seed=0)
    model = GCRPPO("MlpPolicy", env, **SETTINGS)
    calls: list[str] = []
    layer = model.policy.action_net
    handles = [
        layer.weight.register_hook(lambda gradient: calls.append("tensor")),
        layer.register_full_backward_hook(lambda *_: calls.append("module")),
    ]
    model.learn(32)
    assert sorted(calls) == ["module"] * N_MINIBATCHES + ["tensor"] * N_MINIBATCHES
    layer(th.ones(1, 4, requires_grad=True)).sum().backward()
    assert len(calls) == 2 * N_MINIBATCHES + 2
    for handle in handles:
        handle.remove()
    model.learn(32)
    assert len(calls) == 2 * N_MINIBATCHES + 2
    assert model.logger.name_to_value["gcr/one_backward"] == 1


@pytest.mark.parametrize("method", ["auto", "passes"])
@pytest.mark.parametrize(
    "change", [freeze_actor, freeze_first_layer, freeze_log_std, freeze_critic], ids=name_of
)
def test_frozen_stays_frozen_and_thaws(change: Change, method: str) -> None:
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 1, seed=0), gramian_method=method, **SETTINGS)
    model.learn(64)
    change(model.policy, Hooks())
    frozen = [parameter for parameter in model.policy.parameters() if not parameter.requires_grad]
    others = [parameter for parameter in model.policy.parameters() if parameter.requires_grad]
    before = [parameter.detach().clone() for parameter in frozen]
    before_others = [parameter.detach().clone() for parameter in others]
    model.learn(64, reset_num_timesteps=False)
    assert all(th.equal(old, new) for old, new in zip(before, frozen, strict=True))
    assert not any(th.equal(old, new) for old, new in zip(before_others, others, strict=True))
    for parameter in frozen:
        parameter.requires_grad_(True)
    model.learn(64, reset_num_timesteps=False)
    assert not any(th.equal(old, new) for old, new in zip(before, frozen, strict=True))
    assert model.logger.name_to_value["gcr/one_backward"] == float(method == "auto")


class Schedule(BaseCallback):
    """Sets log σ at each rollout and holds it fast."""

    def _on_rollout_start(self) -> None:
        with th.no_grad():
            self.model.policy.log_std.fill_(-0.1 * (1 + self.num_timesteps // 32))

    def _on_rollout_end(self) -> None:
        self.model.policy.log_std.requires_grad_(self.num_timesteps > 64)

    def _on_step(self) -> bool:
        return True


@pytest.mark.parametrize("n_components", [1, 3])
@pytest.mark.parametrize("method", ["auto", "passes"])
def test_a_callback_that_sets_and_freezes_log_std_during_training(
    n_components: int, method: str
) -> None:
    """Updates 1 and 2 hold it, update 3 trains it."""
    spec = SPEC if n_components == 3 else ONE
    env = make_vec_env(lambda: Env(spec), 1, seed=0)
    model = GCRPPO("MlpPolicy", env, gramian_method=method, **SETTINGS)
    model.learn(32, callback=Schedule())
    assert model.policy.log_std.tolist() == pytest.approx([-0.1, -0.1], rel=1e-7)
    model.learn(32, callback=Schedule(), reset_num_timesteps=False)
    assert model.policy.log_std.tolist() == pytest.approx([-0.2, -0.2], rel=1e-7)
    model.learn(32, callback=Schedule(), reset_num_timesteps=False)
    assert model.policy.log_std.tolist() != pytest.approx([-0.3, -0.3], rel=1e-4)


def test_cleared_moments_are_saved_and_counted_anew(tmp_path: Any) -> None:
    env = make_vec_env(Env, 1, seed=0)
    model = GCRPPO("MlpPolicy", env, **SETTINGS).learn(64)
    model.policy.optimizer.state.clear()
    model.learn(32, reset_num_timesteps=False)
    model.save(tmp_path / "model")
    loaded = GCRPPO.load(tmp_path / "model")
    state = loaded.policy.optimizer.state_dict()["state"]
    assert [float(entry["step"]) for entry in state.values()] == [N_MINIBATCHES] * 13

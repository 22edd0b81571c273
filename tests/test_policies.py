"""Policies with a value head per component, and those of users that forget it."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from sb3_gcr import GCRPPO, RewardSpec
from sb3_gcr.policies import CnnPolicy, MlpPolicy, MultiInputPolicy, check_value_heads
from tests.envs import ACTIONS, OBSERVATIONS, SPEC, Env
from tests.test_changed_policies import SETTINGS


def make(policy_class: Any = MlpPolicy, observation: str = "Box", **kwargs: Any) -> Any:
    th.manual_seed(0)
    return policy_class(OBSERVATIONS[observation], ACTIONS["Box"], lambda _: 1e-3, **kwargs)


def with_head(head: Any, base: Any = MlpPolicy) -> Any:
    """A user's policy whose critic ends in layers of its own."""

    class Own(base):  # type: ignore[misc]
        def _build(self, lr_schedule: Any) -> None:
            super()._build(lr_schedule)
            self.value_net = head(self, self.mlp_extractor.latent_dim_vf)
            self.optimizer = self.optimizer_class(
                self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs
            )

    return Own


HEADS = {
    "linear": lambda policy, width: nn.Linear(width, 1),
    "deep": lambda policy, width: nn.Sequential(nn.Linear(width, 8), nn.Tanh(), nn.Linear(8, 1)),
    "flat": lambda policy, width: nn.Sequential(nn.Linear(width, 1), nn.Flatten(0)),
    "two": lambda policy, width: nn.Linear(width, 2),
}
FOUND = {"linear": "(B, 1)", "deep": "(B, 1)", "flat": "(B,)", "two": "(B, 2)"}


@pytest.mark.parametrize("name", list(HEADS))
@pytest.mark.parametrize("method", ["auto", "passes"])
def test_a_critic_with_another_number_of_heads_is_refused_at_construction(
    name: str, method: str
) -> None:
    message = (
        "Parameter `policy` must have a critic with one value per reward component, shape (B, 3), "
        f"found shape {FOUND[name]}. Give the last layer `self.n_components` outputs."
    )
    env = Env()
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        GCRPPO(with_head(HEADS[name]), env, gramian_method=method, device="cpu")
    assert not hasattr(env, "t")  # not even reset


def test_a_critic_of_ones_own_with_a_head_per_component_learns() -> None:
    own = with_head(lambda policy, width: nn.Linear(width, policy.n_components))
    model = GCRPPO(own, Env(), **SETTINGS).learn(32)
    assert model.policy.predict_values(th.zeros(5, 4)).shape == (5, 3)
    deep = with_head(
        lambda policy, width: nn.Sequential(nn.Linear(width, 8), nn.Linear(8, policy.n_components))
    )
    assert GCRPPO(deep, Env(), **SETTINGS).learn(32).num_timesteps == 32


def test_one_component_takes_ppos_head() -> None:
    one = RewardSpec(("only",), (0,))
    for kwargs in ({}, {"advantage_scope": "rollout"}):
        model = GCRPPO(with_head(HEADS["deep"]), Env(one), **SETTINGS, **kwargs).learn(32)
        assert model.num_timesteps == 32


def test_a_head_that_is_replaced_later_is_refused_before_the_update() -> None:
    model = GCRPPO("MlpPolicy", Env(), **SETTINGS).learn(32)
    model.policy.value_net = nn.Linear(4, 1)
    message = "The policy's values must have shape (N, 3), one per reward component, found (1, 1)."
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        model.learn(32, reset_num_timesteps=False)


@pytest.mark.parametrize(
    ("policy_class", "observation"),
    [
        (MlpPolicy, "Discrete"),
        (MlpPolicy, "MultiDiscrete"),
        (CnnPolicy, "Image"),
        (MultiInputPolicy, "DictImage"),
    ],
)
def test_the_check_leaves_everything_as_it_was(policy_class: Any, observation: str) -> None:
    policy = make(policy_class, observation, n_components=3)
    norm = nn.BatchNorm1d(policy.mlp_extractor.latent_dim_vf)
    policy.value_net = nn.Sequential(norm, nn.Dropout(0.5), policy.value_net)
    np.random.seed(0)
    numpys, torchs = np.random.get_state()[1], th.random.get_rng_state()
    check_value_heads(policy, 3, policy.predict_values)
    assert th.equal(th.random.get_rng_state(), torchs)
    np.testing.assert_array_equal(np.random.get_state()[1], numpys)
    assert policy.training
    assert not norm.running_mean.any()


@pytest.mark.parametrize("share", [True, False])
def test_one_head_is_sb3s_policy_weight_for_weight(share: bool) -> None:
    ours = make(n_components=1, share_features_extractor=share)
    theirs = make(ActorCriticPolicy, share_features_extractor=share)
    for (name, mine), (its_name, its) in zip(
        ours.named_parameters(), theirs.named_parameters(), strict=True
    ):
        assert name == its_name
        assert th.equal(mine, its)
    assert type(ours.optimizer) is type(theirs.optimizer)


def test_values_have_a_column_per_component_everywhere() -> None:
    policy = make(n_components=3)
    observations = th.zeros(6, 4)
    actions, values, log_prob = policy(observations)
    assert values.shape == policy.predict_values(observations).shape == (6, 3)
    assert policy.evaluate_actions(observations, actions)[0].shape == (6, 3)
    assert log_prob.shape == (6,)


def test_heads_start_as_orthogonal_as_ppos_one() -> None:
    weight = make(n_components=3).value_net.weight
    th.testing.assert_close(weight @ weight.T, th.eye(3), rtol=1e-5, atol=1e-5)
    loose = make(n_components=3, ortho_init=False).value_net.weight
    assert not th.allclose(loose @ loose.T, th.eye(3), atol=0.1)


def test_an_optimiser_of_the_users_choice_stays() -> None:
    chosen = make(n_components=3, optimizer_class=th.optim.SGD)
    assert type(chosen.optimizer) is th.optim.SGD
    adam = make(n_components=3, optimizer_kwargs={"eps": 1e-3})
    assert type(adam.optimizer) is th.optim.Adam
    assert adam.optimizer.param_groups[0]["eps"] == 1e-3
    assert len(chosen.optimizer.param_groups[0]["params"]) == len(list(chosen.parameters()))


def test_a_saved_policy_comes_back_with_its_heads(tmp_path: Any) -> None:
    policy = make(n_components=3, share_features_extractor=False, net_arch=[5])
    policy.save(tmp_path / "policy.pth")
    loaded = MlpPolicy.load(tmp_path / "policy.pth", device="cpu")
    assert loaded.n_components == len(SPEC)
    assert not loaded.share_features_extractor
    for mine, its in zip(policy.parameters(), loaded.parameters(), strict=True):
        assert th.equal(mine, its)

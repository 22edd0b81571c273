"""RecurrentGCRPPO: reductions to sb3-contrib's RecurrentPPO, rollouts, files and errors."""

from __future__ import annotations

import importlib
import pickle
import re
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_gcr import GCRPPO, RewardSpec, evaluate_components
from tests.envs import SPEC, Env

pytest.importorskip("sb3_contrib")
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy

from sb3_gcr.recurrent import MlpLstmPolicy, RecurrentGCRPPO

SMALL: dict[str, Any] = {
    "n_steps": 24,
    "batch_size": 20,
    "n_epochs": 2,
    "seed": 0,
    "device": "cpu",
}
SEPARATE: dict[str, Any] = {"lstm_hidden_size": 8}
SHARED = {**SEPARATE, "shared_lstm": True, "enable_critic_lstm": False}
ACTOR_ONLY = {**SEPARATE, "enable_critic_lstm": False}
POLICIES = {"Box": "MlpLstmPolicy", "Image": "CnnLstmPolicy", "Dict": "MultiInputLstmPolicy"}


def envs(spec: RewardSpec | None = SPEC, **kwargs: Any) -> Any:
    return make_vec_env(lambda: Env(spec=spec, **kwargs), 3, seed=0)


def make(spec: RewardSpec | None = SPEC, observation: str = "Box", **kwargs: Any) -> Any:
    env = envs(spec, observation=observation)
    arguments = {"policy_kwargs": SEPARATE, **SMALL, **kwargs}
    return RecurrentGCRPPO(POLICIES[observation], env, **arguments)


def numbers(model: Any) -> th.Tensor:
    return th.cat([parameter.detach().flatten() for parameter in model.policy.parameters()])


@pytest.mark.parametrize(
    ("observation", "action", "policy_kwargs"),
    [
        ("Box", "Box", SEPARATE),
        ("Box", "Discrete", SHARED),
        ("Box", "MultiDiscrete", ACTOR_ONLY),
        ("Dict", "Box", SEPARATE),
        ("Image", "Box", SHARED),
    ],
)
def test_one_component_is_recurrent_ppo_bit_for_bit(
    observation: str, action: str, policy_kwargs: Any
) -> None:
    models = [
        algorithm(
            POLICIES[observation],
            envs(None, observation=observation, action=action),
            policy_kwargs=policy_kwargs,
            ent_coef=0.01,
            **SMALL,
        ).learn(144)
        for algorithm in (RecurrentPPO, RecurrentGCRPPO)
    ]
    assert th.equal(*map(numbers, models))


class Idle(RecurrentGCRPPO):
    """Collects rollouts, and learns nothing."""

    def train(self) -> None:
        pass


def spied(model: Any, actor: list[str]) -> list[dict[str, th.Tensor]]:
    """The gradients of some parameters at every optimiser step to come."""
    found: list[dict[str, th.Tensor]] = []
    parameters = dict(model.policy.named_parameters())

    def spy(*_: Any) -> None:
        found.append({name: parameters[name].grad.clone() for name in actor})

    model.policy.optimizer.register_step_pre_hook(spy)
    return found


@pytest.mark.parametrize("policy_kwargs", [SEPARATE, SHARED, ACTOR_ONLY])
def test_sum_has_the_gradient_of_recurrent_ppo_on_the_summed_advantages(policy_kwargs: Any) -> None:
    """At every minibatch of two epochs, with padding, at ratios that have left the clip range."""
    common: dict[str, Any] = {
        **SMALL,
        "learning_rate": 0.3,
        "clip_range": 0.05,
        "max_grad_norm": 1e9,
        "policy_kwargs": {**policy_kwargs, "optimizer_class": th.optim.SGD},
    }
    theirs = RecurrentPPO("MlpLstmPolicy", envs(None), **common)
    given = {"resolver": "sum", "advantage_scope": "minibatch", "kappa_max": 1e9}
    ours = Idle("MlpLstmPolicy", envs(), **given, **common)
    mine = ours.policy.state_dict()
    theirs.policy.load_state_dict(
        {key: value for key, value in mine.items() if "value_net" not in key}, strict=False
    )
    theirs.learn(0)
    ours.learn(72)
    for name in ("observations", "actions", "log_probs", "episode_starts"):
        setattr(theirs.rollout_buffer, name, getattr(ours.rollout_buffer, name).copy())
    for name in ("hidden_states_pi", "cell_states_pi", "hidden_states_vf", "cell_states_vf"):
        setattr(theirs.rollout_buffer, name, getattr(ours.rollout_buffer, name).copy())
    theirs.rollout_buffer.advantages = ours.rollout_buffer.advantages.sum(-1)
    theirs.rollout_buffer.returns = ours.rollout_buffer.returns.sum(-1)
    theirs.rollout_buffer.full = True
    actor = [
        name
        for name, _ in ours.policy.named_parameters()
        if name.startswith(("lstm_actor", "action_net", "log_std", "mlp_extractor.policy_net"))
    ]
    gradients = [spied(model, actor) for model in (theirs, ours)]
    np.random.seed(3)
    theirs.train()
    np.random.seed(3)
    RecurrentGCRPPO.train(ours)
    assert len(gradients[0]) == len(gradients[1]) == 8
    for expected, found in zip(*gradients, strict=True):
        for name in actor:
            th.testing.assert_close(found[name], expected[name], rtol=2e-4, atol=2e-6)
    assert ours.logger.name_to_value["train/clip_fraction"] > 0.2


class Tape(BaseCallback):
    """What the env paid, and what it showed last where a time limit ended an episode."""

    def __init__(self) -> None:
        super().__init__()
        self.paid: list[Any] = []
        self.terminal: list[dict[int, Any]] = []

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        self.paid.append(self.locals["reward_components"].copy())
        self.terminal.append(
            {
                i: info["terminal_observation"]
                for i, info in enumerate(infos)
                if self.locals["dones"][i]
            }
        )
        return True


@pytest.mark.parametrize("policy_kwargs", [SEPARATE, SHARED, ACTOR_ONLY])
def test_a_time_limit_is_bootstrapped_with_the_memory_of_its_episode(policy_kwargs: Any) -> None:
    """The critic is run over whole episodes from empty states, terminal observation included."""
    env = make_vec_env(lambda: Env(limit=7, p_end=0.0), 3, seed=0)
    model = Idle("MlpLstmPolicy", env, **SMALL, policy_kwargs=policy_kwargs, gamma=0.9)
    tape = Tape()
    model.learn(72, callback=tape)
    buffer, policy = model.rollout_buffer, model.policy
    n_checked = 0
    for t, index in ((t, i) for t, row in enumerate(tape.terminal) for i in row):
        seen = [*buffer.observations[t - 6 : t + 1, index], tape.terminal[t][index]]
        empty = th.zeros(1, 1, 8)
        with th.no_grad():
            values = policy.predict_values(
                th.tensor(np.array(seen)), (empty, empty), th.zeros(len(seen))
            )
        bonus = buffer.rewards[t, index] - tape.paid[t][index]
        np.testing.assert_allclose(bonus, 0.9 * values[-1].numpy(), rtol=1e-4, atol=1e-5)
        n_checked += 1
    assert n_checked == 9


def test_the_values_of_a_rollout_are_those_of_its_episodes() -> None:
    model = Idle("MlpLstmPolicy", envs(), **SMALL, policy_kwargs=SEPARATE)
    model.learn(144)  # the second rollout begins inside of episodes
    buffer = model.rollout_buffer
    assert buffer.values.shape == (24, 3, 3)
    state = tuple(th.tensor(array[0]) for array in (buffer.hidden_states_vf, buffer.cell_states_vf))
    with th.no_grad():
        for index in range(3):
            values = model.policy.predict_values(
                th.tensor(buffer.observations[:, index]),
                tuple(part[:, index : index + 1] for part in state),
                th.tensor(buffer.episode_starts[:, index]),
            )
            np.testing.assert_allclose(
                buffer.values[:, index], values.numpy(), rtol=1e-4, atol=1e-5
            )


@pytest.mark.parametrize("observation", list(POLICIES))
def test_every_resolver_and_policy_learns(observation: str) -> None:
    options: list[dict[str, Any]] = [
        {"resolver": "guaranteed", "ent_coef": 0.01},
        {"resolver": "levels", "desired_kl": 0.01, "gramian_samples": 6},
        {"resolver": "gcr", "use_sde": True, "sde_sample_freq": 4, "target_kl": 0.01},
        {"surrogate_clipping": "component", "clip_range_vf": 0.2, "batch_size": None},
    ]
    for given in options[:1] if observation == "Image" else options:
        model = make(observation=observation, **given)
        before = numbers(model).clone()
        model.learn(144)
        assert th.isfinite(numbers(model)).all()
        assert not th.equal(numbers(model), before)
        logged = model.logger.name_to_value
        assert {"gcr/conflicts", "train/value_loss", "train/explained_variance"} <= set(logged)
        assert {f"gcr/weight/{name}" for name in SPEC.names} <= set(logged)


def test_binary_actions_are_learned_though_recurrent_ppo_cannot() -> None:
    env = envs(action="MultiBinary")
    model = RecurrentGCRPPO("MlpLstmPolicy", env, policy_kwargs=SEPARATE, **SMALL).learn(72)
    assert th.isfinite(numbers(model)).all()


def test_training_is_repeatable_with_a_subset() -> None:
    first, second = (make(gramian_samples=5).learn(144) for _ in range(2))
    assert th.equal(numbers(first), numbers(second))


@pytest.mark.parametrize("weights_only", [False, True])
def test_a_saved_model_goes_on_as_if_nothing_had_been(tmp_path: Path, weights_only: bool) -> None:
    model = make(policy_kwargs=SHARED).learn(72)
    model.save(tmp_path / "model.zip")
    loaded = RecurrentGCRPPO.load(
        tmp_path / "model.zip", env=envs(), device="cpu", weights_only=weights_only
    )
    assert th.equal(numbers(loaded), numbers(model))
    assert loaded.reward_spec == SPEC
    assert loaded.policy.shared_lstm
    assert loaded.num_timesteps == 72
    for each in (model, loaded):
        each.set_env(envs())
        each.set_random_seed(1)
        each.learn(72, reset_num_timesteps=False)
    assert th.equal(numbers(loaded), numbers(model))


def test_the_file_of_a_recurrent_ppo_is_loaded(tmp_path: Path) -> None:
    theirs = RecurrentPPO("MlpLstmPolicy", envs(None), policy_kwargs=SEPARATE, **SMALL).learn(72)
    theirs.save(tmp_path / "theirs.zip")
    ours = RecurrentGCRPPO.load(tmp_path / "theirs.zip", env=envs(None), device="cpu")
    assert th.equal(numbers(ours), numbers(theirs))
    warm = RecurrentGCRPPO.warm_start(tmp_path / "theirs.zip", envs(), device="cpu")
    assert warm.n_components == 3
    assert th.equal(warm.policy.lstm_actor.weight_ih_l0, theirs.policy.lstm_actor.weight_ih_l0)
    assert th.equal(warm.policy.lstm_critic.weight_ih_l0, theirs.policy.lstm_critic.weight_ih_l0)
    assert "actor and critic kept; value heads kept: none" in str(warm.warm_start_report)


def test_a_warm_start_keeps_heads_and_forgets_a_critic_of_another_kind(tmp_path: Path) -> None:
    model = make().learn(72)
    model.save(tmp_path / "model.zip")
    other = RewardSpec(("save", "new"), (1, 0))
    warm = RecurrentGCRPPO.warm_start(tmp_path / "model.zip", envs(other), device="cpu")
    old, new = model.policy.value_net.weight, warm.policy.value_net.weight
    assert th.equal(new[0], old[2])
    without = RecurrentGCRPPO.warm_start(
        tmp_path / "model.zip", envs(), device="cpu", policy_kwargs=ACTOR_ONLY
    )
    assert "actor kept, critic new (its layers differ)" in str(without.warm_start_report)


def test_a_policy_comes_back_as_it_was(tmp_path: Path) -> None:
    policy = make(policy_kwargs={**SHARED, "n_lstm_layers": 2}).policy
    policy.save(str(tmp_path / "policy.pth"))
    loaded = MlpLstmPolicy.load(str(tmp_path / "policy.pth"), device="cpu")
    for name, tensor in policy.state_dict().items():
        assert th.equal(loaded.state_dict()[name], tensor)
    assert loaded.shared_lstm
    unpickled = pickle.loads(pickle.dumps(policy))
    for name, tensor in policy.state_dict().items():
        assert th.equal(unpickled.state_dict()[name], tensor)


def test_components_are_evaluated_with_memory() -> None:
    model = make()
    found = evaluate_components(model, envs(), n_eval_episodes=6)
    assert set(found.component_means) == set(SPEC.names)  # type: ignore[union-attr]
    assert sum(found.component_means.values()) == pytest.approx(found.mean_reward)  # type: ignore[union-attr]


CHOICES = (
    "Parameter `policy` must be one of ['CnnLstmPolicy', 'MlpLstmPolicy', 'MultiInputLstmPolicy'] "
    "or a subclass of MultiHeadRecurrentActorCriticPolicy, found {}."
)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (
            "MlpPolicy",
            CHOICES.format("'MlpPolicy'") + " A policy without memory needs `sb3_gcr.GCRPPO`.",
        ),
        (
            ActorCriticPolicy,
            CHOICES.format("'ActorCriticPolicy'")
            + " A policy without memory needs `sb3_gcr.GCRPPO`.",
        ),
        (
            MaskableActorCriticPolicy,
            CHOICES.format("'MaskableActorCriticPolicy'")
            + " A maskable policy needs sb3-contrib's MaskablePPO, which has one objective.",
        ),
        (
            RecurrentPPO.policy_aliases["MlpLstmPolicy"],
            CHOICES.format("'RecurrentActorCriticPolicy'"),
        ),
    ],
)
def test_a_policy_of_another_kind_is_refused(policy: Any, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        RecurrentGCRPPO(policy, envs(), **SMALL)


def test_gcrppo_names_the_class_for_an_lstm_and_for_masks() -> None:
    choices = (
        "Parameter `policy` must be one of ['CnnPolicy', 'MlpPolicy', 'MultiInputPolicy'] or a "
        "subclass of MultiHeadActorCriticPolicy, found {}."
    )
    messages = {
        MlpLstmPolicy: choices.format("'MultiHeadRecurrentActorCriticPolicy'")
        + " A policy with an LSTM needs `sb3_gcr.recurrent.RecurrentGCRPPO`.",
        MaskableActorCriticPolicy: choices.format("'MaskableActorCriticPolicy'")
        + " A maskable policy needs sb3-contrib's MaskablePPO, which has one objective.",
    }
    for policy, message in messages.items():
        with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
            GCRPPO(policy, envs())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"gramian_method": "one_backward"},
            "Parameter `gramian_method` must be 'auto' or 'passes' for a recurrent policy, found "
            "'one_backward': the steps of a sequence share their past, and one backward pass does "
            "not tell them apart.",
        ),
        (
            {"gramian_samples": 0},
            "Parameter `gramian_samples` must be an integer ≥ 1 or None, found 0.",
        ),
        ({"batch_size": 1}, "Parameter `batch_size` must be an integer ≥ 2, found 1."),
    ],
)
def test_bad_arguments(given: Any, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        make(**given)


def test_without_sb3_contrib_the_error_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    monkeypatch.delitem(sys.modules, "sb3_gcr.recurrent")
    message = "sb3_gcr.recurrent needs sb3-contrib: pip install 'sb3_gcr[recurrent]' ("
    with pytest.raises(ImportError, match=f"^{re.escape(message)}"):
        importlib.import_module("sb3_gcr.recurrent")


class Recall(gym.Env[Any, Any]):
    """Shows a sign at the start and nothing after; a task pays at the end for having remembered it,
    a regulariser charges for every action.
    """

    observation_space = spaces.Box(-1, 1, (1,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)
    reward_spec = RewardSpec(("recall", "effort"), (0, 1))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.sign = float(self.np_random.choice([-1.0, 1.0]))
        self.t = 0
        return np.array([self.sign], np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.t += 1
        done = self.t == 4
        components = np.array([done * self.sign * action[0], -0.1 * action[0] ** 2])
        nothing = np.zeros(1, np.float32)
        return nothing, float(components.sum()), done, False, {"reward_components": components}


def test_what_needs_memory_is_learned_with_it_alone() -> None:
    returns = {}
    for algorithm, policy, kwargs in (
        (RecurrentGCRPPO, "MlpLstmPolicy", {"lstm_hidden_size": 16, "net_arch": [16]}),
        (GCRPPO, "MlpPolicy", {}),
    ):
        model = algorithm(
            policy,
            make_vec_env(Recall, 8, seed=0),
            n_steps=64,
            batch_size=128,
            n_epochs=6,
            learning_rate=3e-3,
            seed=0,
            device="cpu",
            policy_kwargs=kwargs,
        )
        model.learn(12_288)
        found: Any = evaluate_components(model, make_vec_env(Recall, 8, seed=1), 40)
        returns[algorithm] = found.component_means["recall"]
    assert returns[RecurrentGCRPPO] > 0.8  # of 1 with memory
    assert abs(returns[GCRPPO]) < 0.4  # of 0 without

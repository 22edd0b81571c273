"""GCRPPO as an SB3 algorithm: reductions, every kind of env and policy, logging, errors."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CheckpointCallback,
    EvalCallback,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecNormalize
from torch import nn

from sb3_gcr import (
    GCRPPO,
    RESOLVERS,
    RewardDecomposition,
    RewardSpec,
    VectorRolloutBuffer,
    evaluate_components,
)
from sb3_gcr.schedules import adapt_learning_rate
from tests.envs import SPEC, BatchedEnv, Env, Late, Terms

SMALL: dict[str, Any] = {"n_steps": 32, "batch_size": 16, "n_epochs": 2, "seed": 0, "device": "cpu"}


def exactly(message: str) -> str:
    return f"^{re.escape(message)}$"


def parameters(model: Any) -> Any:
    return th.cat([parameter.detach().flatten() for parameter in model.policy.parameters()])


def learned(model: Any, timesteps: int = 128) -> Any:
    before = parameters(model).clone()
    model.learn(timesteps)
    after = parameters(model)
    assert th.isfinite(after).all()
    assert not th.equal(before, after)
    return model


# ------------------------------------------------------------------ reductions


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"clip_range_vf": 0.1, "ent_coef": 0.01, "target_kl": 0.01},
        {"use_sde": True, "sde_sample_freq": 4},
        {
            "policy_kwargs": {"share_features_extractor": False, "net_arch": [8]},
            "normalize_advantage": False,
        },
        {"batch_size": 13},
    ],
)
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_one_objective_is_sb3s_ppo_bit_for_bit(kwargs: Any) -> None:
    for spec in (None, RewardSpec(("only",), (0,))):
        models = []
        for algorithm in (PPO, GCRPPO):
            env = make_vec_env(
                lambda spec=spec: Env(spec or RewardSpec(("only",), (0,))), n_envs=2, seed=0
            )
            models.append(algorithm("MlpPolicy", env, **{**SMALL, **kwargs}).learn(256))
        assert th.equal(parameters(models[0]), parameters(models[1]))
        assert models[0].predict(np.ones(4), deterministic=True)[0].tolist() == (
            models[1].predict(np.ones(4), deterministic=True)[0].tolist()
        )


@pytest.mark.parametrize("method", ["one_backward", "passes"])
def test_sum_with_minibatch_scope_takes_ppos_first_step(method: str) -> None:
    """The first minibatch's actor gradient is PPO's on the summed reward, if the critics agree: V =
    Σ V^(k).
    """
    gradients = []
    for algorithm, kwargs in (
        (PPO, {}),
        (GCRPPO, {"resolver": "sum", "advantage_scope": "minibatch", "gramian_method": method}),
    ):
        env = DummyVecEnv([Env])
        model = algorithm(
            "MlpPolicy",
            env,
            n_steps=32,
            batch_size=32,
            n_epochs=1,
            seed=0,
            max_grad_norm=1e9,
            **kwargs,
        )
        with th.no_grad():
            model.policy.value_net.weight.zero_()
            model.policy.value_net.bias.zero_()
        th.manual_seed(0)  # the wider head drew more numbers
        model.learn(32)
        actor = [
            p.grad.flatten() for name, p in model.policy.named_parameters() if "value" not in name
        ]
        gradients.append(th.cat(actor))
    th.testing.assert_close(gradients[1], gradients[0], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    "kwargs", [{}, {"clip_range_vf": 0.2, "ent_coef": 0.02}, {"target_kl": 0.02}]
)
def test_all_ways_to_the_gramian_train_alike(kwargs: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """One backward pass in NumPy and in PyTorch, and K of them."""
    models = []
    for method, limit in (("passes", 0), ("one_backward", 2**25), ("one_backward", 0)):
        for name in ("SMALL", "SMALL_FOR_THREADS"):
            monkeypatch.setattr(f"sb3_gcr.gradients.memory.{name}", limit)
        model = GCRPPO(
            "MlpPolicy", make_vec_env(Env, 2, seed=0), gramian_method=method, **SMALL, **kwargs
        ).learn(128)
        models.append(model)
    for model in models[1:]:
        th.testing.assert_close(parameters(models[0]), parameters(model), rtol=1e-3, atol=1e-5)


def test_general_path_with_one_objective_is_ppo_to_rounding() -> None:
    """``desired_kl`` makes our own loop run with K = 1; with a target that the KL never leaves it
    takes PPO's steps.
    """
    models = []
    for algorithm, kwargs in ((PPO, {}), (GCRPPO, {"desired_kl": 1e-3})):
        env = make_vec_env(lambda: Env(None), n_envs=2, seed=0)
        models.append(
            algorithm(
                "MlpPolicy", env, n_steps=32, batch_size=64, n_epochs=1, seed=0, **kwargs
            ).learn(64)
        )
    th.testing.assert_close(parameters(models[0]), parameters(models[1]), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("method", ["one_backward", "passes"])
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_logged_figures_are_ppos(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Our own loop with one component, uneven minibatches and clipping logs what SB3's PPO logs."""
    monkeypatch.setattr(GCRPPO, "_is_scalar_ppo", False)
    settings: dict[str, Any] = {
        "n_steps": 32,
        "batch_size": 24,
        "n_epochs": 3,
        "seed": 0,
        "learning_rate": 0.01,
    }
    logs = []
    for algorithm, kwargs in ((PPO, {}), (GCRPPO, {"gramian_method": method})):
        env = make_vec_env(lambda: Env(None), n_envs=2, seed=0)
        model = algorithm(
            "MlpPolicy", env, ent_coef=0.01, clip_range_vf=0.05, **settings, **kwargs
        ).learn(64)
        logs.append(model.logger.name_to_value)
    keys = [key for key in logs[0] if key.startswith("train/")]
    assert logs[0]["train/clip_fraction"] > 0
    assert {
        "train/approx_kl",
        "train/loss",
        "train/value_loss",
        "train/policy_gradient_loss",
        "train/entropy_loss",
    } <= {*keys}
    assert {key: logs[1][key] for key in keys} == pytest.approx(
        {key: logs[0][key] for key in keys}, rel=1e-3, abs=1e-5
    )


# ------------------------------------------------- envs, policies, action spaces


@pytest.mark.parametrize("action", ["Box", "Discrete", "MultiDiscrete", "MultiBinary"])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_action_spaces(action: str, n_envs: int) -> None:
    model = learned(
        GCRPPO(
            "MlpPolicy", make_vec_env(lambda: Env(action=action), n_envs), ent_coef=0.01, **SMALL
        )
    )
    assert model.predict(np.zeros(4, np.float32))[0].shape == model.action_space.shape


@pytest.mark.parametrize(
    "observation", ["Discrete", "MultiDiscrete", "Image", "ImageChannelsLast", "Dict", "DictImage"]
)
@pytest.mark.parametrize("share", [True, False])
def test_observation_spaces(observation: str, share: bool) -> None:
    policy = {"Image": "CnnPolicy", "ImageChannelsLast": "CnnPolicy"}.get(observation, "MlpPolicy")
    policy = "MultiInputPolicy" if observation.startswith("Dict") else policy
    env = make_vec_env(lambda: Env(observation=observation), 2)
    kwargs = {"share_features_extractor": share}
    model = learned(GCRPPO(policy, env, policy_kwargs=kwargs, **SMALL), 64)
    values = model.policy.predict_values(model.policy.obs_to_tensor(model._last_obs)[0])
    assert values.shape == (2, 3)


@pytest.mark.parametrize("sde_sample_freq", [-1, 4])
def test_gsde(sde_sample_freq: int) -> None:
    model = GCRPPO(
        "MlpPolicy", make_vec_env(Env, 2), use_sde=True, sde_sample_freq=sde_sample_freq, **SMALL
    )
    learned(model)
    squashed = {"squash_output": True}
    learned(
        GCRPPO(
            "MlpPolicy",
            make_vec_env(Env, 2),
            use_sde=True,
            ent_coef=0.01,
            policy_kwargs=squashed,
            **SMALL,
        )
    )


class Noisy(BaseFeaturesExtractor):
    def __init__(self, observation_space: Any):
        super().__init__(observation_space, 8)
        self.net = nn.Sequential(nn.Linear(4, 8), nn.BatchNorm1d(8), nn.Dropout(0.2))

    def forward(self, x: th.Tensor) -> th.Tensor:
        return self.net(x)  # type: ignore[no-any-return]


@pytest.mark.parametrize("share", [True, False])
def test_batch_norm_and_dropout_train_and_predict_in_their_modes(share: bool) -> None:
    kwargs = {"features_extractor_class": Noisy, "share_features_extractor": share}
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 2), policy_kwargs=kwargs, **SMALL)
    norm = model.policy.pi_features_extractor.net[1]
    statistics = norm.running_mean.clone()
    learned(model)
    assert not th.equal(norm.running_mean, statistics)
    after = norm.running_mean.clone()
    first, second = (model.predict(np.ones(4), deterministic=True)[0] for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert th.equal(norm.running_mean, after)


@pytest.mark.parametrize("batch_size", [31, 63, 64, 100])
@pytest.mark.parametrize("scope", ["rollout", "minibatch"])
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_minibatches_that_do_not_divide_the_rollout(batch_size: int, scope: str) -> None:
    """64 samples: a last minibatch of 2, of 1, none, and a minibatch larger than the rollout."""
    model = GCRPPO(
        "MlpPolicy",
        make_vec_env(Env, 2),
        n_steps=32,
        batch_size=batch_size,
        advantage_scope=scope,
        n_epochs=2,
    )
    learned(model)


@pytest.mark.parametrize("norm_reward", [True, False])
def test_vec_normalize_frame_stack_and_infos_as_tuple(norm_reward: bool) -> None:
    env = VecFrameStack(VecNormalize(make_vec_env(Env, 2), norm_reward=norm_reward), 2)
    learned(GCRPPO("MlpPolicy", env, **SMALL))


def test_subproc_vec_env() -> None:
    env = make_vec_env(Env, 2, seed=0, vec_env_cls=SubprocVecEnv)
    serial = make_vec_env(Env, 2, seed=0)
    models = [learned(GCRPPO("MlpPolicy", e, **SMALL)) for e in (env, serial)]
    assert th.equal(parameters(models[0]), parameters(models[1]))
    env.close()


def test_batched_env_without_infos() -> None:
    env = BatchedEnv()
    model = learned(GCRPPO("MlpPolicy", env, **SMALL))
    assert len(model.ep_component_buffer) > 0
    plain = BatchedEnv()
    plain.reward_spec = None  # type: ignore[assignment]
    learned(GCRPPO("MlpPolicy", plain, desired_kl=0.01, **SMALL))


def test_every_resolver_and_a_users_own() -> None:
    def mine(gramian: Any, levels: Any, rng: Any, *, factor: float = 1.0) -> Any:
        assert gramian.shape == (3, 3)
        assert gramian.dtype == np.float64
        assert levels.tolist() == [0, 0, 1]
        assert isinstance(rng, np.random.Generator)
        return factor * np.ones(3)

    for resolver in RESOLVERS:
        learned(GCRPPO("MlpPolicy", make_vec_env(Env, 2), resolver=resolver, **SMALL))
    model = learned(
        GCRPPO(
            "MlpPolicy",
            make_vec_env(Env, 2),
            resolver=mine,
            resolver_kwargs={"factor": 2.0},
            **SMALL,
        )
    )
    assert model.logger.name_to_value["gcr/weight/go"] == 2


def test_the_signature_begins_with_ppos() -> None:
    theirs = list(inspect.signature(PPO.__init__).parameters.values())
    ours = list(inspect.signature(GCRPPO.__init__).parameters.values())
    assert [(p.name, p.default) for p in ours[: len(theirs)]] == [
        (p.name, p.default) for p in theirs
    ]
    assert all(p.default is not inspect.Parameter.empty for p in ours[len(theirs) :])


@pytest.mark.parametrize(
    ("kwargs", "scale"),
    [
        ({"normalize_advantage": False}, "none"),
        ({"advantage_scope": "minibatch"}, "minibatch"),
        ({}, "rollout"),
    ],
)
def test_scope_of_the_normalisation(kwargs: Any, scale: str) -> None:
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 2, seed=0), **SMALL, **kwargs).learn(64)
    total = model.rollout_buffer.advantages.sum(-1)
    assert bool(abs(total.std(ddof=1) - 1) < 1e-4) is (scale == "rollout")
    kappa = model.logger.name_to_value["gcr/kappa"]
    assert bool(kappa == 1) is (scale == "none")
    if scale == "minibatch":
        assert kappa == pytest.approx(1 / total.std(ddof=1), rel=0.3)


def test_seed_decides_everything() -> None:
    def train(seed: int) -> Any:
        model = GCRPPO("MlpPolicy", make_vec_env(Env, 2, seed=seed), **{**SMALL, "seed": seed})
        return parameters(model.learn(128))

    assert th.equal(train(1), train(1))
    assert not th.equal(train(1), train(2))


@pytest.mark.parametrize("method", ["one_backward", "passes"])
@pytest.mark.parametrize("scope", ["rollout", "minibatch"])
@pytest.mark.parametrize("resolver", ["gcr", "guaranteed", "levels", "gcr_authors"])
def test_a_term_that_never_pays_is_harmless(method: str, scope: str, resolver: str) -> None:
    """It has no advantage, no gradient and weight 1, until it pays; a file remembers."""
    env = make_vec_env(Late, 2, seed=0)
    kwargs: dict[str, Any] = {"gramian_method": method, "advantage_scope": scope}
    model = GCRPPO("MlpPolicy", env, resolver=resolver, **kwargs, **SMALL).learn(256)
    logged = model.logger.name_to_value
    assert logged["gcr/weight/late"] == 1
    assert logged["gcr/grad_norm/late"] == 0
    assert logged["gcr/in_conflict/late"] == 0
    assert not model.rollout_buffer.advantages[..., 2].any()
    assert model.rollout_buffer.advantages[..., :2].any()


def test_a_term_joins_when_it_first_pays_and_stays(tmp_path: Path) -> None:
    env = make_vec_env(lambda: Late(33), 1, seed=0)
    model = GCRPPO("MlpPolicy", env, **SMALL).learn(32)
    assert model.has_paid.tolist() == [True, True, False]
    model.learn(32, reset_num_timesteps=False)
    assert model.has_paid.tolist() == [True, True, True]
    assert model.rollout_buffer.advantages[..., 2].all()
    model.save(tmp_path / "model")
    silent = make_vec_env(Late, 1, seed=0)
    for weights_only in (False, True):
        loaded = GCRPPO.load(tmp_path / "model", env=silent, weights_only=weights_only)
        assert loaded.has_paid.tolist() == [True, True, True]
    loaded.learn(32, reset_num_timesteps=False)
    assert loaded.rollout_buffer.advantages[..., 2].any()


# ------------------------------------------------------------ rollout contents


class Recorder(BaseCallback):
    """Keeps what a callback sees."""

    def __init__(self) -> None:
        super().__init__()
        self.steps: list[dict[str, Any]] = []

    def _on_step(self) -> bool:
        self.steps.append(
            {
                key: self.locals[key]
                for key in ("rewards", "values", "dones", "infos", "reward_components")
            }
        )
        return True


def test_callbacks_see_scalar_rewards_and_vector_values() -> None:
    recorder = Recorder()
    GCRPPO("MlpPolicy", make_vec_env(Env, 2), **SMALL).learn(64, callback=recorder)
    assert len(recorder.steps) == 32
    for step in recorder.steps:
        assert step["rewards"].shape == (2,)
        assert step["values"].shape == (2, 3)
        np.testing.assert_allclose(
            step["reward_components"].sum(1), step["rewards"], rtol=1e-5, atol=1e-5
        )


def test_time_limits_bootstrap_every_head_in_one_forward_pass() -> None:
    """All episodes end by the time limit at the same step; the stored components carry γ V^(k) of
    the terminal observation.
    """
    env = make_vec_env(lambda: Env(limit=8, p_end=0.0), 3, seed=0)
    model = GCRPPO("MlpPolicy", env, gamma=0.9, n_steps=8, batch_size=8, n_epochs=1, seed=0)
    calls: list[int] = []
    original = model.policy.predict_values

    def predict_values(obs: th.Tensor) -> th.Tensor:
        calls.append(len(obs))
        return original(obs)

    model.policy.predict_values = predict_values
    recorder = Recorder()
    _, callback = model._setup_learn(24, recorder)
    model.collect_rollouts(env, callback, model.rollout_buffer, 8)
    assert calls == [3, 3]  # once for the three truncated envs, once for the last step
    last = recorder.steps[-1]
    assert last["dones"].all()
    assert all(info["TimeLimit.truncated"] for info in last["infos"]) is True
    terminal = np.stack([info["terminal_observation"] for info in last["infos"]])
    with th.no_grad():
        values = original(th.as_tensor(terminal)).numpy()
    np.testing.assert_allclose(
        model.rollout_buffer.rewards[7], last["reward_components"] + 0.9 * values, rtol=1e-5
    )
    np.testing.assert_allclose(
        model.rollout_buffer.rewards[3], recorder.steps[3]["reward_components"], rtol=1e-6
    )


def test_rollout_matches_sb3s_on_the_summed_reward() -> None:
    """Same actions, observations and log-probabilities as PPO; the components sum to its
    rewards.
    """
    buffers = []
    for algorithm in (PPO, GCRPPO):
        env = make_vec_env(lambda: Env(p_end=0.2, limit=1000), 2, seed=0)
        model = algorithm("MlpPolicy", env, **SMALL)
        with th.no_grad():  # the wider head drew other numbers after the same actor
            model.policy.value_net.weight.zero_()
        _, callback = model._setup_learn(64)
        th.manual_seed(0)
        model.collect_rollouts(env, callback, model.rollout_buffer, 32)
        buffers.append(model.rollout_buffer)
    for name in ("observations", "actions", "log_probs", "episode_starts"):
        np.testing.assert_array_equal(getattr(buffers[0], name), getattr(buffers[1], name))
    for name in ("rewards", "advantages", "returns"):
        assert getattr(buffers[1], name).shape == (32, 2, 3)
        np.testing.assert_allclose(
            getattr(buffers[1], name).sum(-1), getattr(buffers[0], name), rtol=1e-4, atol=1e-4
        )


# ------------------------------------------------------- SB3's tools around it


def test_callbacks_evaluation_and_checkpoints(tmp_path: Path) -> None:
    eval_env = make_vec_env(Env, 1)
    callbacks = [
        EvalCallback(
            eval_env, eval_freq=32, n_eval_episodes=2, best_model_save_path=str(tmp_path), verbose=0
        ),
        CheckpointCallback(32, str(tmp_path / "checkpoints")),
    ]
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL)
    model.learn(64, callback=callbacks, progress_bar=True)
    mean, _ = evaluate_policy(GCRPPO.load(tmp_path / "best_model"), eval_env, 3)
    assert np.isfinite(mean)
    assert len(list((tmp_path / "checkpoints").glob("*.zip"))) == 2


def test_a_callback_can_stop_training() -> None:
    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            return self.n_calls < 5

    model = GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL).learn(1000, callback=Stop())
    assert model.num_timesteps == 5


def test_component_returns_after_a_callback_stopped_at_the_end_of_an_episode() -> None:
    model = GCRPPO("MlpPolicy", make_vec_env(lambda: Env(limit=8, p_end=0.0), 1), **SMALL)
    model.learn(64, callback=StopTrainingOnMaxEpisodes(1))
    model.learn(64, reset_num_timesteps=False)
    returns = [episode["r"] for episode in model.ep_info_buffer]
    np.testing.assert_allclose(
        np.sum(model.ep_component_buffer, axis=1)[-len(returns) :], returns, rtol=1e-4, atol=1e-4
    )


@pytest.mark.parametrize("action", ["Box", "Discrete"])
def test_a_frozen_actor_lets_the_critic_warm_up(action: str) -> None:
    model = GCRPPO("MlpPolicy", make_vec_env(lambda: Env(action=action), 1), **SMALL)
    actor = [p for name, p in model.policy.named_parameters() if "value" not in name]
    for parameter in actor:
        parameter.requires_grad_(False)
    before = [parameter.clone() for parameter in actor]
    learned(model)
    assert all(th.equal(old, new) for old, new in zip(before, actor, strict=True))


def test_logged_keys(tmp_path: Path) -> None:
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 2), clip_range_vf=0.5, **SMALL)
    model.set_logger(configure(str(tmp_path), ["csv", "tensorboard", "log"]))
    model.learn(192)
    model.logger.close()
    progress = pd.read_csv(tmp_path / "progress.csv")
    names = SPEC.names
    ours = {"gcr/conflicts", "gcr/conflict_rate", "gcr/kappa", "gcr/brake", "gcr/one_backward"} | {
        f"{key}/{name}"
        for key in (
            "gcr/weight",
            "gcr/grad_norm",
            "gcr/in_conflict",
            "rollout/ep_rew",
            "gcr/value_loss",
            "gcr/explained_variance",
        )
        for name in names
    }
    ppos = PPO("MlpPolicy", make_vec_env(lambda: Env(None), 2), clip_range_vf=0.5, **SMALL)
    ppos.set_logger(configure(str(tmp_path / "ppo"), ["csv"]))
    ppos.learn(192)
    ppos.logger.close()
    theirs = set(pd.read_csv(tmp_path / "ppo" / "progress.csv").columns)
    assert set(progress.columns) == ours | theirs
    last = progress.iloc[-1]
    assert last["train/value_loss"] == pytest.approx(
        sum(last[f"gcr/value_loss/{name}"] for name in names), rel=1e-5
    )
    assert last["rollout/ep_rew_mean"] == pytest.approx(
        sum(last[f"rollout/ep_rew/{name}"] for name in names), rel=1e-4
    )
    assert 0 <= last["gcr/conflict_rate"] <= 1
    cosines = pd.read_csv(tmp_path / "cosines.csv")
    assert list(cosines.columns) == [
        "time/total_timesteps",
        "go | stay",
        "go | save",
        "stay | save",
    ]
    assert cosines["time/total_timesteps"].tolist() == [64, 128, 192]
    assert (cosines.iloc[:, 1:].abs() <= 1).all(axis=None)
    text = (tmp_path / "log.txt").read_text()
    assert "| component | level       | return |" in text
    assert "gcr/weight" not in text
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert "gcr/weight/save" in events.Tags()["scalars"]
    assert events.Tags()["images"] == ["gcr/cosines"]


def test_statistics_are_means_over_all_minibatches() -> None:
    """A resolver that returns 1, 2, 3, … makes the mean of the weights known."""
    calls = iter(range(1, 100))
    model = GCRPPO(
        "MlpPolicy",
        make_vec_env(Env, 1),
        resolver=lambda g, levels, rng: np.full(3, next(calls)),
        **SMALL,
    )
    model.learn(32)
    # one call when learning starts, then 2 epochs of 2 minibatches: 2, 3, 4, 5
    assert model.logger.name_to_value["gcr/weight/go"] == 3.5


def test_names_that_look_alike_do_not_break_the_table() -> None:
    spec = RewardSpec(
        tuple(f"a_very_long_name_that_is_cut_in_the_table_{i}" for i in range(3)), (0, 0, 1)
    )
    GCRPPO("MlpPolicy", make_vec_env(lambda: Env(spec), 1), verbose=1, **SMALL).learn(64)


def test_evaluate_components() -> None:
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL)
    env = make_vec_env(Env, 3, seed=1)
    result = evaluate_components(model, env, 7)
    assert list(result.component_means) == list(SPEC.names)
    assert sum(result.component_means.values()) == pytest.approx(result.mean_reward, rel=1e-5)
    rewards, lengths, components = evaluate_components(model, env, 7, return_episode_rewards=True)
    np.testing.assert_allclose(
        np.sum(list(components.values()), axis=0), rewards, rtol=1e-4, atol=1e-4
    )
    assert len(lengths) == 7
    batched = evaluate_components(model, BatchedEnvWithInfos(), 3, warn=False)
    assert np.isfinite(list(batched.component_means.values())).all()
    message = (
        "Parameter `env` must report reward components, found none. Wrap it with "
        "`RewardDecomposition`."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        evaluate_components(model, make_vec_env(lambda: Env(None), 1), 1)


class BatchedEnvWithInfos(BatchedEnv):
    def __init__(self) -> None:
        super().__init__()
        self.infos = [{} for _ in range(4)]


# -------------------------------------------------------------- adaptive rate


def test_adaptive_learning_rate_rule() -> None:
    assert adapt_learning_rate(1e-3, 0.021, 0.01) == pytest.approx(1e-3 / 1.5)
    assert adapt_learning_rate(1e-3, 0.004, 0.01) == pytest.approx(1.5e-3)
    assert adapt_learning_rate(1e-3, 0.01, 0.01) == 1e-3
    assert adapt_learning_rate(1.2e-5, 1.0, 0.01) == 1e-5
    assert adapt_learning_rate(9e-3, 0.0, 0.01) == 1e-2


def test_adaptive_learning_rate_takes_over_after_the_first_minibatch() -> None:
    model = GCRPPO(
        "MlpPolicy",
        make_vec_env(Env, 1),
        desired_kl=1e6,
        learning_rate=1e-4,
        n_steps=32,
        batch_size=32,
        n_epochs=1,
    )
    model.learn(32)
    assert model.policy.optimizer.param_groups[0]["lr"] == 1e-4
    model = GCRPPO(
        "MlpPolicy",
        make_vec_env(Env, 1),
        desired_kl=1e6,
        learning_rate=1e-4,
        n_steps=32,
        batch_size=8,
        n_epochs=1,
    )
    model.learn(32)
    assert model.policy.optimizer.param_groups[0]["lr"] == pytest.approx(1e-4 * 1.5**3)
    model.learn(32, reset_num_timesteps=False)
    assert model.policy.optimizer.param_groups[0]["lr"] == pytest.approx(1e-4 * 1.5**6)
    assert model.logger.name_to_value["train/learning_rate"] == pytest.approx(1e-4 * 1.5**6)


# ----------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        (
            {"resolver": "pcgrad"},
            ValueError,
            "Parameter `resolver` must be one of ['gcr', 'gcr_authors', 'guaranteed', "
            "'levels', 'no_priority', 'sum'] or a callable "
            "(gramian, levels, rng) -> weights, found 'pcgrad'.",
        ),
        (
            {"resolver": 3},
            TypeError,
            "Parameter `resolver` must be one of ['gcr', 'gcr_authors', 'guaranteed', "
            "'levels', 'no_priority', 'sum'] or a callable "
            "(gramian, levels, rng) -> weights, found 3.",
        ),
        (
            {"resolver_kwargs": {"colour": 1}},
            TypeError,
            "Parameter `resolver_kwargs` must fit the resolver's signature (gramian, levels, rng, "
            "...), "
            "found {'colour': 1}: got an unexpected keyword argument 'colour'.",
        ),
        (
            {"advantage_scope": "batch"},
            ValueError,
            "Parameter `advantage_scope` must be 'rollout', 'minibatch' or None, found 'batch'.",
        ),
        ({"kappa_max": 0}, ValueError, "Parameter `kappa_max` must be a number > 0, found 0."),
        (
            {"desired_kl": -1.0},
            ValueError,
            "Parameter `desired_kl` must be a number > 0 or None, found -1.0.",
        ),
        (
            {"gramian_method": "two"},
            ValueError,
            "Parameter `gramian_method` must be 'auto', 'one_backward' or 'passes', found 'two'.",
        ),
        *(
            (
                {"gramian_samples": samples},
                ValueError,
                f"Parameter `gramian_samples` must be an integer ≥ 1 or None, found {samples}.",
            )
            for samples in (0, 512.0)
        ),
        (
            {"rollout_buffer_class": __import__("stable_baselines3").common.buffers.RolloutBuffer},
            ValueError,
            "Parameter `rollout_buffer_class` must be a subclass of VectorRolloutBuffer for more "
            "than one reward component, "
            "found RolloutBuffer.",
        ),
    ],
)
def test_bad_arguments(kwargs: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=exactly(message)):
        GCRPPO("MlpPolicy", make_vec_env(Env, 1), **kwargs)


def test_wrong_policy_classes() -> None:
    from stable_baselines3.common.policies import ActorCriticPolicy

    choices = (
        "Parameter `policy` must be one of ['CnnPolicy', 'MlpPolicy', 'MultiInputPolicy'] or a "
        "subclass of MultiHeadActorCriticPolicy, found {}."
    )
    with_lstm = " A policy with an LSTM needs `sb3_gcr.recurrent.RecurrentGCRPPO`."
    with pytest.raises(ValueError, match=exactly(choices.format("'MlpLstmPolicy'") + with_lstm)):
        GCRPPO("MlpLstmPolicy", make_vec_env(Env, 1))
    with pytest.raises(ValueError, match=exactly(choices.format("'ActorCriticPolicy'"))):
        GCRPPO(ActorCriticPolicy, make_vec_env(Env, 1))
    recurrent = type(
        "RecurrentActorCriticPolicy",
        (ActorCriticPolicy,),
        {"__module__": "sb3_contrib.common.recurrent.policies"},
    )
    with pytest.raises(
        ValueError, match=exactly(choices.format("'RecurrentActorCriticPolicy'") + with_lstm)
    ):
        GCRPPO(recurrent, make_vec_env(lambda: Env(None), 1))
    learned(GCRPPO(ActorCriticPolicy, make_vec_env(lambda: Env(None), 1), **SMALL))


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (np.ones(2), "Parameter `resolver` must return weights of shape (3,), found shape (2,)."),
        (
            np.ones((3, 1)),
            "Parameter `resolver` must return weights of shape (3,), found shape (3, 1).",
        ),
        (
            np.full(3, np.nan),
            "Parameter `resolver` must return finite weights, found [nan nan nan].",
        ),
    ],
)
def test_wrong_weights_fail_before_the_first_rollout(weights: Any, message: str) -> None:
    model = GCRPPO(
        "MlpPolicy", make_vec_env(Env, 1), resolver=lambda gramian, levels, rng: weights, **SMALL
    )
    with pytest.raises(ValueError, match=exactly(message)):
        model.learn(64)
    assert model.num_timesteps == 0


def test_one_backward_cannot_be_forced_on_a_network_that_does_not_fit() -> None:
    model = GCRPPO(
        "MlpPolicy", make_vec_env(Env, 1), use_sde=True, gramian_method="one_backward", **SMALL
    )
    message = (
        "Parameter `gramian_method` must be 'auto' or 'passes' for this policy, found "
        "'one_backward', which needs an "
        "actor and a critic of linear layers and common activations, a flat features extractor and "
        "no gSDE."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        model.learn(32)


class Failing(gym.Wrapper[Any, Any, Any, Any]):
    """Spoils the info of one step."""

    def __init__(self, env: gym.Env[Any, Any], step: int, spoil: Any):
        super().__init__(env)
        self.at, self.spoil, self.count = step, spoil, 0

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.count += 1
        if self.count == self.at:
            self.spoil(info)
        return observation, reward, terminated, truncated, info


FAULTS = {
    "missing": (
        lambda info: info.pop("b"),
        "Reward component 'b' is missing: parameter `components` must name keys of `info`, found "
        "only ['a'].",
    ),
    "nan": (
        lambda info: info.update(a=np.nan),
        "Reward component 'a' must be finite, found nan (a=nan, b=2).",
    ),
    "infinite": (
        lambda info: info.update(b=np.inf),
        "Reward component 'b' must be finite, found inf (a=1, b=inf).",
    ),
    "sum": (
        lambda info: info.update(b=5.0),
        "The reward components must sum to the reward 3, found 6 (a=1, b=5). Name the missing "
        "terms, or collect the rest in "
        'a component of its own with `RewardDecomposition(residual="name")`.',
    ),
}


def broken_env(fault: str, step: int) -> gym.Env[Any, Any]:
    return RewardDecomposition(
        Failing(Terms([{"a": 1.0, "b": 2.0}], [3.0]), step, FAULTS[fault][0]), {"a": 0, "b": 1}
    )


@pytest.mark.parametrize("fault", list(FAULTS))
@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_faults_in_the_middle_of_a_run_name_env_and_timestep(
    fault: str, vec_env_cls: Any, tmp_path: Path
) -> None:
    env = vec_env_cls([lambda: broken_env(fault, 10**9), lambda: broken_env(fault, 40)])
    model = GCRPPO("MlpPolicy", env, **SMALL)
    checkpoint = CheckpointCallback(16, str(tmp_path))
    with pytest.raises(
        ValueError, match=exactly(f"Env index 1 at timestep 80: {FAULTS[fault][1]}")
    ):
        model.learn(256, callback=checkpoint)
    env.close()
    saved = GCRPPO.load(max(tmp_path.glob("*.zip"), key=lambda path: path.stat().st_mtime))
    assert th.isfinite(parameters(saved)).all()


def test_an_env_that_forgets_its_components() -> None:
    env = Env(p_end=0.0)
    inner = env.step
    env.step = lambda action: (*inner(action)[:4], {"other": 1})  # type: ignore[method-assign]
    message = (
        'Env index 0 at timestep 1: `info["reward_components"]` must be an array of shape (3,), '
        "found keys ['TimeLimit.truncated', 'other']."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        GCRPPO("MlpPolicy", DummyVecEnv([lambda: env]), **SMALL).learn(32)


@pytest.mark.parametrize("method", ["one_backward", "passes"])
def test_nan_in_training_raises_before_it_reaches_the_weights(method: str) -> None:
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 1), gramian_method=method, **SMALL)
    model.learn(32)
    before = parameters(model).clone()
    model.rollout_buffer._tensors["returns"][:, 1] = np.nan
    message = (
        "The value loss must be finite, found nan in the update at timestep 32. The weights are "
        "those of the last good step; "
        "a smaller `learning_rate`, or scaled returns (VecNormalize), may help."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        model.train()
    assert th.equal(parameters(model), before)
    model.rollout_buffer._tensors["returns"][:, 1] = 1e30
    message = message.replace("nan", "inf")
    with pytest.raises(ValueError, match=exactly(message)):
        model.train()
    assert th.equal(parameters(model), before)


@pytest.mark.parametrize("spec", [SPEC, None])
def test_nan_observations_raise_before_the_update(spec: Any) -> None:
    env = Env(spec)
    model = GCRPPO("MlpPolicy", DummyVecEnv([lambda: env]), **SMALL)
    model.learn(32)
    before = parameters(model).clone()
    model.rollout_buffer.advantages[3] = np.nan
    message = (
        "The rollout's `advantages` must be finite, found NaN or infinity before the update at "
        "timestep 32. The policy is as "
        "it was; check rewards and observations, e.g. with VecCheckNan."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        model.train()
    assert th.equal(parameters(model), before)


def test_env_ids_of_the_table_are_taken_apart_and_others_are_not() -> None:
    model = GCRPPO("MlpPolicy", "Humanoid-v5", **SMALL)
    assert str(model.reward_spec) == (
        "reward_forward (task), reward_survive (task), reward_ctrl (regulariser), reward_contact "
        "(regulariser)"
    )
    learned(model, 32)
    assert isinstance(model.rollout_buffer, VectorRolloutBuffer)
    assert GCRPPO("MlpPolicy", "Pendulum-v1").n_components == 1


def test_an_undecomposed_env_of_the_table_warns_with_the_line_to_add() -> None:
    message = (
        "'HalfCheetah-v5' reports the terms of its reward, but nothing collects them, so GCRPPO "
        "trains one objective. "
        "Add the line `env = RewardDecomposition(env)`, or `make_vec_env(..., "
        "wrapper_class=RewardDecomposition)`."
    )
    with pytest.warns(UserWarning, match=exactly(message)):
        model = GCRPPO("MlpPolicy", gym.make("HalfCheetah-v5"))
    assert model.n_components == 1
    env = make_vec_env("HalfCheetah-v5", wrapper_class=RewardDecomposition)
    assert GCRPPO("MlpPolicy", env).n_components == 2


def test_verbose_says_what_runs(capsys: pytest.CaptureFixture[str]) -> None:
    GCRPPO("MlpPolicy", make_vec_env(lambda: Env(None), 1), verbose=1, **SMALL).learn(32)
    assert (
        "One reward component: training is SB3's PPO with one objective." in capsys.readouterr().out
    )
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), verbose=1, **SMALL).learn(32)
    out = capsys.readouterr().out
    assert "3 reward components: go (task), stay (task), save (regulariser)" in out
    assert "| go        | task        |" in out
    assert "Gradients of the components: one backward pass in NumPy" in out
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), verbose=1, use_sde=True, **SMALL).learn(32)
    assert "Gradients of the components: K backward passes in PyTorch" in capsys.readouterr().out

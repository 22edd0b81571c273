"""Everything around the update: envs, policies, rollouts with K components, SB3's tools."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
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
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecNormalize
from torch import nn

from sb3_gcr import GCRPPO, RewardDecomposition
from tests.envs import BatchedEnv, Env, Terms
from tests.training import SMALL, exactly, learned, parameters


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
    values = model.policy.predict_values(model.policy.obs_to_tensor(model.env.reset())[0])
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


class Recorder(BaseCallback):
    """Keeps what a callback sees, and the first rollout before the update."""

    def __init__(self) -> None:
        super().__init__()
        self.steps: list[dict[str, Any]] = []
        self.rollout: dict[str, Any] = {}

    def _on_step(self) -> bool:
        names = ("rewards", "values", "dones", "infos", "reward_components")
        self.steps.append({key: self.locals[key] for key in names if key in self.locals})
        return True

    def _on_rollout_end(self) -> None:
        if not self.rollout:
            arrays = vars(self.model.rollout_buffer).items()
            self.rollout = {k: v.copy() for k, v in arrays if isinstance(v, np.ndarray)}


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
    calls: list[tuple[int, Any]] = []
    original = model.policy.predict_values

    def predict_values(obs: th.Tensor) -> th.Tensor:
        values = original(obs)
        calls.append((len(obs), values.numpy()))
        return values

    model.policy.predict_values = predict_values
    recorder = Recorder()
    model.learn(24, callback=recorder)
    # once for the three truncated envs, once for the last step
    assert [n_observations for n_observations, _ in calls] == [3, 3]
    last = recorder.steps[-1]
    assert last["dones"].all()
    assert all(info["TimeLimit.truncated"] for info in last["infos"]) is True
    terminal = np.stack([info["terminal_observation"] for info in last["infos"]])
    assert terminal.shape == (3, 4)
    np.testing.assert_allclose(
        recorder.rollout["rewards"][7], last["reward_components"] + 0.9 * calls[0][1], rtol=1e-5
    )
    np.testing.assert_allclose(
        recorder.rollout["rewards"][3], recorder.steps[3]["reward_components"], rtol=1e-6
    )


def test_rollout_matches_sb3s_on_the_summed_reward() -> None:
    """Same actions, observations and log-probabilities as PPO; the components sum to its
    rewards.
    """
    rollouts = []
    for algorithm in (PPO, GCRPPO):
        env = make_vec_env(lambda: Env(p_end=0.2, limit=1000), 2, seed=0)
        model = algorithm("MlpPolicy", env, **SMALL)
        with th.no_grad():  # the wider head drew other numbers after the same actor
            model.policy.value_net.weight.zero_()
        th.manual_seed(0)
        recorder = Recorder()
        model.learn(64, callback=recorder)
        rollouts.append(recorder.rollout)
    for name in ("observations", "actions", "log_probs", "episode_starts"):
        np.testing.assert_array_equal(rollouts[0][name], rollouts[1][name])
    for name in ("rewards", "advantages", "returns"):
        assert rollouts[1][name].shape == (32, 2, 3)
        np.testing.assert_allclose(
            rollouts[1][name].sum(-1), rollouts[0][name], rtol=1e-4, atol=1e-4
        )


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


def test_wrong_policy_classes() -> None:
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
        lambda info: info.update(b=7.5),
        "The reward components must sum to the reward 3, found 8.5 (a=1, b=7.5). Name the missing "
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

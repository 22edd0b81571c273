"""The adapter on mjlab itself, on a CPU: `make test-mjlab` makes an environment for it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gcr import GCRPPO
from sb3_gcr.simulators import ManagerVecEnv

pytest.importorskip("mjlab")

import mjlab.tasks  # noqa: F401 (it registers them)
from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers.curriculum_manager import CurriculumTermCfg
from mjlab.managers.reward_manager import RewardTermCfg
from mjlab.managers.termination_manager import TerminationTermCfg
from mjlab.tasks.registry import load_env_cfg

PAGE = Path(__file__).parents[2] / "docs/simulators.md"
CARTPOLE = "Mjlab-Cartpole-Balance"
GO1 = "Mjlab-Velocity-Flat-Unitree-Go1"
LEVELS = {"upright": "task", "centre": "task", "speed": "regulariser", "effort": "regulariser"}
LATER = 40  # steps until the curriculum doubles the weight of the effort


def hinge(env: ManagerBasedRlEnv) -> th.Tensor:
    return env.scene["cartpole"].data.joint_pos[:, 1]


def slider(env: ManagerBasedRlEnv) -> th.Tensor:
    return env.scene["cartpole"].data.joint_pos[:, 0]


def speed(env: ManagerBasedRlEnv) -> th.Tensor:
    return env.scene["cartpole"].data.joint_vel.square().sum(1)


def effort(env: ManagerBasedRlEnv) -> th.Tensor:
    return env.action_manager.action.square().sum(1)


def has_fallen(env: ManagerBasedRlEnv) -> th.Tensor:
    return hinge(env).abs() > 0.5


def raise_effort(env: ManagerBasedRlEnv, env_ids: th.Tensor) -> th.Tensor:
    weight = -0.2 if env.common_step_counter > LATER else -0.1
    env.reward_manager.get_term_cfg("effort").weight = weight
    return th.tensor(weight)


def cartpole_settings(n_envs: int, episode_length_s: float = 2.5) -> Any:
    """mjlab's cartpole, paid for four terms of our own."""
    settings = load_env_cfg(CARTPOLE)
    settings.scene.num_envs = n_envs
    settings.seed = 1
    settings.episode_length_s = episode_length_s
    values: dict[str, tuple[Callable[..., th.Tensor], float]] = {
        "upright": (lambda env: hinge(env).cos(), 2.0),
        "centre": (lambda env: -slider(env).abs(), 1.0),
        "speed": (speed, -0.01),
        "effort": (effort, -0.1),
    }
    settings.rewards = {
        name: RewardTermCfg(func=func, weight=weight) for name, (func, weight) in values.items()
    }
    settings.terminations["fallen"] = TerminationTermCfg(func=has_fallen)
    settings.curriculum = {"effort": CurriculumTermCfg(func=raise_effort)}
    return settings


def make(settings: Any, **kwargs: Any) -> ManagerVecEnv:
    return ManagerVecEnv(ManagerBasedRlEnv(settings, device="cpu"), **kwargs)


@pytest.fixture
def cartpole() -> Iterator[ManagerVecEnv]:
    env = make(cartpole_settings(8, episode_length_s=0.5), components=LEVELS)
    yield env
    env.close()


def test_components_ends_and_observations(cartpole: ManagerVecEnv) -> None:
    """Ten steps an episode; the terminal observation is not the one of the new start."""
    env = cartpole
    assert env.terminal_source == "step"
    assert isinstance(env.observation_space, spaces.Dict)  # actor and critic
    assert env.action_space == spaces.Box(-100.0, 100.0, (1,), np.float32)
    env.reset()
    n_truncated = 0
    for action in np.random.default_rng(0).normal(size=(2 * LATER, 8, 1)).astype(np.float32):
        observations, rewards, dones, infos = env.step(action)
        np.testing.assert_allclose(env.reward_components.sum(1), rewards, rtol=1e-5, atol=1e-7)
        assert env.observation_space["actor"].contains(observations["actor"][0])
        for index in np.flatnonzero(dones):
            info = infos[index]
            n_truncated += info["TimeLimit.truncated"]
            assert info["episode"]["l"] <= 10
            terminal = info["terminal_observation"]["actor"]
            assert (terminal != observations["actor"][index]).any()
    assert n_truncated >= 8
    weights = env.get_attr("reward_manager")[0].get_term_cfg("effort").weight
    assert weights == -0.2
    expected = -0.2 * action[:, 0] ** 2 * env.get_attr("step_dt")[0]
    np.testing.assert_allclose(env.reward_components[:, 3], expected, rtol=1e-5)


def test_terminal_observation_is_that_of_an_env_that_goes_on() -> None:
    """The same actions and seed, once with a time limit of five steps and once without one."""
    actions = np.random.default_rng(0).normal(size=(5, 4, 1)).astype(np.float32)
    last: list[Any] = []
    for length in (0.25, 50.0):
        env = make(cartpole_settings(4, length), components=LEVELS)
        env.seed(3)
        env.reset()
        for action in actions:
            observations, _, dones, infos = env.step(action)
        last.append(
            [info["terminal_observation"] for info in infos] if all(dones) else observations
        )
        env.close()
    ended, running = last
    for index, terminal in enumerate(ended):
        np.testing.assert_allclose(terminal["critic"], running["critic"][index], atol=1e-5)


def test_seeds_repeat_an_episode(cartpole: ManagerVecEnv) -> None:
    runs = []
    for _ in range(2):
        cartpole.seed(7)
        start = cartpole.reset()["critic"]
        rewards = [cartpole.step(np.ones((8, 1), np.float32))[1] for _ in range(3)]
        runs.append((start, np.array(rewards)))
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    np.testing.assert_allclose(runs[0][1], runs[1][1], rtol=1e-5)
    assert (cartpole.reset()["critic"] != runs[0][0]).any()


def test_gcrppo_learns_cartpole() -> None:
    """Far more than a policy that falls: 2.5 s upright pay 2 · 2.5 = 5 at most."""
    env = VecNormalize(make(cartpole_settings(64), components=LEVELS), norm_reward=False)
    model = GCRPPO(
        "MultiInputPolicy", env, n_steps=32, batch_size=512, seed=0, device="cpu", gamma=0.97
    )
    model.learn(2_048)
    first = np.mean([episode["r"] for episode in model.ep_info_buffer])
    model.learn(49_152, reset_num_timesteps=False)
    last = np.mean([episode["r"] for episode in model.ep_info_buffer])
    env.close()
    assert math.isfinite(first)
    assert last > first + 1.0
    assert last > 3.5


def test_with_one_term_it_is_ppo() -> None:
    policies = []
    for algorithm in (PPO, GCRPPO):
        settings = cartpole_settings(8, 0.5)
        settings.rewards = {"upright": settings.rewards["upright"]}
        settings.curriculum = {}
        env = make(settings, components={"upright": "task"})
        model = algorithm(
            "MultiInputPolicy", env, n_steps=16, batch_size=64, n_epochs=2, seed=3, device="cpu"
        )
        model.learn(256)
        policies.append(th.nn.utils.parameters_to_vector(model.policy.parameters()).detach())
        env.close()
    assert th.equal(*policies)


def test_go1_steps_with_guessed_levels() -> None:
    settings = load_env_cfg(GO1)
    settings.scene.num_envs = 4
    with pytest.warns(UserWarning, match="are a guess from their names"):
        env = make(settings)
    names = env.reward_spec.names
    assert names == tuple(settings.rewards)
    levels = env.reward_spec.to_dict()
    assert levels["track_linear_velocity"] == levels["track_angular_velocity"] == 0
    assert levels["action_rate_l2"] == 1
    env.reset()
    total = np.zeros(len(names))
    for action in np.random.default_rng(0).normal(size=(30, 4, 12)).astype(np.float32):
        _, rewards, _, _ = env.step(action)
        np.testing.assert_allclose(env.reward_components.sum(1), rewards, rtol=1e-4, atol=1e-6)
        total += np.abs(env.reward_components).sum(0)
    assert (total > 0).sum() > 5
    env.close()


def test_the_script_of_the_docs_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With fewer envs and two updates."""
    script = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.S | re.M)[0]
    for old, new in {"num_envs = 64": "num_envs = 16", "1_000_000": "768"}.items():
        assert old in script
        script = script.replace(old, new)
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, Any] = {}
    exec(compile(script, PAGE.name, "exec"), namespace)
    assert namespace["model"].num_timesteps == 768
    assert (tmp_path / "go1.zip").exists()
    namespace["model"].logger.close()

"""Pictures: of one robot, of a chosen one among many, and the sentence where OpenGL is missing."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

pytest.importorskip("mujoco.batch")

PICTURES = """
import gymnasium as gym, numpy as np
from stable_baselines3.common.env_util import make_vec_env
from sb3_gcr.envs import BatchedVecEnv
env = gym.make("sb3_gcr/ThrowingMO-v0", render_mode="rgb_array", width=320, height=240)
env.reset(seed=0)
picture = env.render().astype(int)
red, green, blue = picture.transpose(2, 0, 1)
many = make_vec_env("sb3_gcr/HumanoidRun-v0", 3, seed=0, vec_env_cls=BatchedVecEnv)
many.reset()
actions = np.random.default_rng(0).uniform(-1, 1, (10, 3, 17))
for action in actions:
    many.step(action)
first = many.render()
many.render_index = 2
third = many.render()
many.engine.rows.qpos[:, 0] += 40
many.step(actions[0])
far = many.render().astype(int)
skin = lambda picture: ((picture[..., 0] - picture[..., 2]) > 40).sum()
env.close(); many.close()
print(picture.shape, first.shape, (first != third).mean() > 0.001)
print(skin(far) > 0.5 * skin(third.astype(int)) > 100)
ball = (red > 120) & (green < 60) & (blue < 60)
target = (red > 150) & (green > 70) & (red - blue > 90)
print(ball.sum() > 5, target.sum() > 3)
"""
NO_CONTEXT = """
import gymnasium as gym, sb3_gcr
env = gym.make("sb3_gcr/HumanoidRun-v0", render_mode="rgb_array")
env.reset()
try:
    env.render()
except RuntimeError as error:
    print(error)
"""


def run(code: str, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {
        key: value
        for key, value in os.environ.items()
        if key not in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")
    }
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={**environment, "OMP_NUM_THREADS": "1", **variables},
    )


def test_target_ball_and_chosen_robot_can_be_seen_and_followed() -> None:
    result = run(PICTURES, MUJOCO_GL="egl")
    if result.returncode:
        pytest.skip(f"no EGL here: {result.stderr.splitlines()[-1]}")
    assert result.stdout.splitlines() == ["(240, 320, 3) (480, 640, 3) True", "True", "True True"]


def test_missing_opengl_is_told_in_one_sentence() -> None:
    result = run(NO_CONTEXT)
    if result.returncode == 0 and not result.stdout:
        pytest.skip("OpenGL works here without being asked for")
    assert result.stdout.startswith(
        "No picture could be rendered: MuJoCo found no OpenGL context. Without a screen, set the"
    )

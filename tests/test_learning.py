"""It learns: a task and a regulariser that fight over one of two actions, where each resolver's
optimum is known.
"""

from __future__ import annotations

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

from sb3_gcr import GCRPPO
from tests.envs import Valley


@pytest.mark.parametrize(
    ("resolver", "low", "high"),
    [
        ("sum", 0.1, 0.3),  # minimum of (x - 1)² + 4 x² at 0.2
        ("gcr", 0.8, 1.1),  # what the regulariser asks for against the task is projected away
        ("gcr_authors", 0.8, 1.1),
        ("guaranteed", 0.8, 1.1),
        ("no_priority", -0.1, 1.1),  # at rest wherever the two gradients are opposed
    ],
)
def test_each_resolver_finds_its_optimum(resolver: str, low: float, high: float) -> None:
    kwargs = {"net_arch": [], "log_std_init": -1.0}
    env = make_vec_env(Valley, 8, seed=1)
    model = GCRPPO(
        "MlpPolicy",
        env,
        0.01,
        n_steps=64,
        batch_size=512,
        resolver=resolver,
        seed=1,
        policy_kwargs=kwargs,
    )
    # Both want less noise, and that agreement would hide their conflict over x close to the
    # optimum.
    model.policy.log_std.requires_grad_(False)
    model.learn(16_000)
    x, y = model.predict(np.zeros(1), deterministic=True)[0]
    assert low <= x <= high
    assert y == pytest.approx(0.5, abs=0.1)  # nobody objects to what the regulariser wants here

"""An env with other spaces is refused, and told what differs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3.common.env_util import make_vec_env

from sb3_gcr import GCRPPO
from tests.envs import Env

SMALL: dict[str, Any] = {"n_steps": 32, "batch_size": 16, "n_epochs": 2, "seed": 0, "device": "cpu"}


def exactly(message: str) -> str:
    return f"^{re.escape(message)}$"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "model.zip"


@pytest.mark.parametrize(
    ("observation", "action", "differences"),
    [
        (
            "Discrete",
            "Box",
            "observation_space.type is 'Dict' in the file and 'Discrete' in the env",
        ),
        (
            "DictImage",
            "Box",
            "observation_space.spaces.b is {'n': 4, 'start': 0, 'type': 'Discrete'} in the file "
            "and 'missing' in the env; "
            "observation_space.spaces.i is 'missing' in the file and "
            "{'dtype': 'uint8', 'high': 255.0, 'low': 0.0, 'shape': [1, 36, 36], ...} in the env",
        ),
        (
            "Dict",
            "MultiBinary",
            "action_space.type is 'Box' in the file and 'MultiBinary' in the env",
        ),
        (
            "Box",
            "Discrete",
            "observation_space.type is 'Dict' in the file and 'Box' in the env; "
            "action_space.type is 'Box' in the file and 'Discrete' in the env",
        ),
    ],
)
def test_other_spaces_are_refused_with_what_differs(
    path: Path, observation: str, action: str, differences: str
) -> None:
    GCRPPO("MultiInputPolicy", make_vec_env(lambda: Env(observation="Dict"), 1), **SMALL).save(path)
    env = make_vec_env(lambda: Env(observation=observation, action=action), 1)
    message = (
        f"Parameter `env` must have the spaces of the saved model, found others: {differences}."
    )
    for weights_only in (False, True):
        with pytest.raises(ValueError, match=exactly(message)):
            GCRPPO.warm_start(path, env, weights_only=weights_only)


def test_other_sizes_and_bounds_are_named(path: Path) -> None:
    GCRPPO("MlpPolicy", "Reacher-v5", **SMALL).save(path)
    message = (
        "Parameter `env` must have the spaces of the saved model, found others: "
        "observation_space.shape is [10] in the file "
        "and [23] in the env; action_space.shape is [2] in the file and [7] in the env; "
        "action_space.low is -1.0 in the file "
        "and -2.0 in the env; action_space.high is 1.0 in the file and 2.0 in the env."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        GCRPPO.warm_start(path, "Pusher-v5")

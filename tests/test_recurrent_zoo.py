"""rl-zoo3 with RecurrentGCRPPO: ``gcrppo_lstm``."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import yaml

# Importing rl_zoo3 here would change Gymnasium for the tests of other files.
if importlib.util.find_spec("rl_zoo3") is None:
    pytest.skip("needs rl_zoo3", allow_module_level=True)

from sb3_gcr.recurrent import RecurrentGCRPPO
from sb3_gcr.zoo import commands
from sb3_gcr.zoo.hyperparameters import hyperparameter_file

pytestmark = pytest.mark.filterwarnings("ignore:Argument ``multivariate`` is an experimental")
ENTRIES = yaml.safe_load((files("sb3_gcr.hyperparams") / "gcrppo_lstm.yml").read_text())


@pytest.fixture(autouse=True, scope="module")
def _gymnasium_as_it_was() -> Iterator[None]:
    """rl_zoo3 puts a TimeLimit of its own in Gymnasium's place."""
    with pytest.MonkeyPatch.context() as restored:
        for owner in (gym.wrappers, gym.wrappers.common):
            restored.setattr(owner, "TimeLimit", owner.TimeLimit)
        yield


@pytest.mark.parametrize("env_id", list(ENTRIES))
def test_every_entry_makes_a_model_and_leaves_no_rest(env_id: str) -> None:
    commands.register()
    manager = importlib.import_module("sb3_gcr.zoo.managers").ZooManager(
        argparse.Namespace(), "gcrppo_lstm", env_id, "logs", eval_freq=-1, verbose=0, device="cpu"
    )
    model: Any = manager.setup_experiment()[0]  # type: ignore[index]
    assert type(model) is RecurrentGCRPPO
    assert model.n_components >= 2
    assert model.n_steps * model.n_envs % model.batch_size == 0
    model.env.close()


def test_an_env_without_an_entry_has_rl_zoo3s_settings_of_recurrent_ppo() -> None:
    commands.register()
    manager = importlib.import_module("sb3_gcr.zoo.managers").ZooManager(
        argparse.Namespace(), "gcrppo_lstm", "Acrobot-v1", "logs"
    )
    assert Path(manager.config).name == "ppo_lstm.yml"
    assert hyperparameter_file("gcrppo_lstm", "Hopper-v5")


def test_train_writes_a_model_that_loads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    options = ["--verbose", "0", "--seed", "0", "--device", "cpu", "-n", "64", "--eval-freq", "-1"]
    small = ["-params", "n_steps:32", "batch_size:32", "n_epochs:1", "policy_kwargs:None"]
    commands.main(["train", "--algo", "gcrppo_lstm", "--env", "Hopper-v5", *options, *small])
    path = tmp_path / "logs/gcrppo_lstm/Hopper-v5_1/Hopper-v5.zip"
    model = RecurrentGCRPPO.load(path, device="cpu")
    assert model.reward_spec.names == ("reward_forward", "reward_survive", "reward_ctrl")

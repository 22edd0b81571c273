"""``sb3-gcr-zoo conflicts``, from a tiny training to its table and picture."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import pandas as pd
import pytest

from sb3_gcr.zoo import main
from sb3_gcr.zoo.conflicts import _with_decomposition

if importlib.util.find_spec("rl_zoo3") is None:
    pytest.skip("needs rl_zoo3", allow_module_level=True)
SMALL = ["--seed", "0", "-params", "n_steps:64", "batch_size:32", "n_epochs:1", "n_envs:2"]


@pytest.fixture(autouse=True, scope="module")
def _gymnasium_as_it_was() -> Iterator[None]:
    """rl_zoo3 puts a TimeLimit of its own in Gymnasium's place."""
    with pytest.MonkeyPatch.context() as restored:
        for owner in (gym.wrappers, gym.wrappers.common):
            restored.setattr(owner, "TimeLimit", owner.TimeLimit)
        yield


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("algo", ["gcrppo", "ppo"])
def test_an_agent_is_measured(algo: str, capsys: pytest.CaptureFixture[str]) -> None:
    agent = ["--algo", algo, "--env", "Hopper-v5"]
    main(["train", *agent, "-n", "128", "--verbose", "0", *SMALL])
    capsys.readouterr()
    main(["conflicts", *agent, "--n-rollouts", "3", "-f", "logs"])
    captured = capsys.readouterr()
    folder = Path(f"logs/{algo}/Hopper-v5_1")
    table = pd.read_csv(folder / "measured_conflicts.csv")
    assert set(table["first"]) == {"reward_forward", "reward_ctrl", "reward_survive"}
    assert len(table) == 6
    assert (folder / "measured_conflicts.png").exists()
    assert "reward_forward" in captured.out
    assert captured.out.endswith("measured_conflicts.png\n")
    assert "3/3" in captured.err  # the progress bar


def test_what_is_missing_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["conflicts", "--env", "Hopper-v5", "-f", "nowhere"])
    assert "folder was not found" in capsys.readouterr().err


def test_a_reward_is_taken_apart_once() -> None:
    ours = "sb3_gcr.RewardDecomposition"
    assert _with_decomposition(None) == [ours]
    assert _with_decomposition("a.Wrapper") == ["a.Wrapper", ours]
    assert _with_decomposition(["a.Wrapper", {ours: {}}]) == ["a.Wrapper", {ours: {}}]

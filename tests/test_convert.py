"""The example that converts a script: both halves run, and are the same env."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from examples.convert import after, before


def test_both_scripts_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With one subprocess each: whole, from the first step to the evaluation of the loaded file."""
    for script in (before, after):
        folder = tmp_path / script.__name__
        script.main(["--timesteps", "256", "--n-envs", "1", "--folder", str(folder)])
        assert (folder / "model.zip").exists()
    printed = capsys.readouterr().out
    assert printed.count("return ") == 2
    assert all(f"'{name}'" in printed for name in after.LEVELS)


def test_the_reward_stays_what_it_was() -> None:
    rng = np.random.default_rng(0)
    old, new = before.Rover(), after.rover()
    old.reset(seed=0)
    new.reset(seed=0)
    for _ in range(200):
        action = rng.uniform(-1, 1, 2).astype(np.float32)
        observation, reward, terminated, truncated, _ = old.step(action)
        new_observation, new_reward, *ends, info = new.step(action)
        assert np.array_equal(observation, new_observation)
        assert [terminated, truncated] == ends
        assert new_reward == pytest.approx(reward, abs=1e-12)
        assert info["reward_components"].shape == (6,)
        assert "reward_components_error" not in info
        if terminated or truncated:
            old.reset(seed=1)
            new.reset(seed=1)

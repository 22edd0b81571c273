"""Saving is crash-safe: files are the old ones or the new ones, and a training that is killed goes
on from the last.
"""

from __future__ import annotations

import io
import json
import multiprocessing
import os
import re
import signal
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gcr import GCRPPO, latest_checkpoint
from sb3_gcr.saving import checkpoints
from tests.envs import Env

ROOT = Path(__file__).parents[1]
SMALL: dict[str, Any] = {"n_steps": 32, "batch_size": 16, "n_epochs": 2, "seed": 0, "device": "cpu"}
BIG = {"net_arch": [512, 512], "ortho_init": False}
N_KILLS = 24


def exactly(message: str) -> str:
    return f"^{re.escape(message)}$"


def parameters(model: Any) -> Any:
    return th.cat([parameter.detach().flatten() for parameter in model.policy.parameters()])


def normalized(observation: str = "Box", **kwargs: Any) -> VecNormalize:
    return VecNormalize(make_vec_env(lambda: Env(observation=observation), 2, seed=0), **kwargs)


def statistics(env: VecNormalize) -> Any:
    observations = getattr(env, "obs_rms", {})
    moments = (
        [*observations.values(), env.ret_rms]
        if isinstance(observations, dict)
        else [observations, env.ret_rms]
    )
    return np.concatenate([np.append(np.ravel((m.mean, m.var)), m.count) for m in moments])


# === Killed at random moments ===


class SaveLast(BaseCallback):
    """Overwrites one file at every step, and marks the model with the state of its env."""

    def __init__(self, path: Path):
        super().__init__()
        self.path = path

    def _on_step(self) -> bool:
        self.model.mark = statistics(self.training_env).tolist()  # type: ignore[attr-defined, arg-type]
        self.model.save(self.path)
        return True


def train_until_killed(folder: Path) -> None:
    """A training that checkpoints at every step, two ways; almost all of its time goes into
    writing.
    """
    env = normalized()
    checkpoint = latest_checkpoint(folder)
    if checkpoint is None:
        model = GCRPPO("MlpPolicy", env, n_steps=8, batch_size=16, n_epochs=1, policy_kwargs=BIG)
    else:
        model = GCRPPO.load(checkpoint, env=env)
    (folder / "started").touch()
    callbacks: list[BaseCallback] = [SaveLast(folder / "last"), CheckpointCallback(1, str(folder))]
    model.learn(10**9, callbacks, reset_num_timesteps=False)


def time_of_saving(path: Path) -> float:
    """Seconds for a file of the training above, on this machine at this moment."""
    model = GCRPPO("MlpPolicy", normalized(), n_steps=8, batch_size=16, policy_kwargs=BIG)
    model.learn(16)
    start = time.perf_counter()
    model.save(path)
    return time.perf_counter() - start


@pytest.mark.skipif(os.name != "posix", reason="needs fork")
def test_a_training_killed_at_any_moment_goes_on(tmp_path: Path) -> None:
    context = multiprocessing.get_context(
        "forkserver"
    )  # imports once; its children start in milliseconds
    context.set_forkserver_preload(["torch._dynamo", "sb3_gcr", __name__])
    rng = np.random.default_rng()
    pause = 8 * time_of_saving(tmp_path / "first.zip")
    steps, n_interrupted = 0, 0
    for _ in range(N_KILLS):
        process = context.Process(target=train_until_killed, args=(tmp_path,), daemon=True)
        process.start()
        while not (tmp_path / "started").exists():
            assert process.is_alive()
            time.sleep(0.002)
        while not (tmp_path / "last.zip").exists():  # the first training has made one
            time.sleep(0.002)
        time.sleep(rng.uniform(0, pause))
        process.kill()
        process.join()
        assert process.exitcode == -signal.SIGKILL
        (tmp_path / "started").unlink()
        leftovers = list(tmp_path.glob(".*.tmp"))
        n_interrupted += bool(leftovers)
        newest = latest_checkpoint(tmp_path)
        for path in filter(None, (tmp_path / "last.zip", newest)):
            env = normalized()
            model = GCRPPO.load(path, env=env, device="cpu")
            assert model.mark == statistics(env).tolist()  # type: ignore[attr-defined]
            assert model.num_timesteps >= steps
        if newest is not None:
            steps = model.num_timesteps
            assert newest.name == f"rl_model_{steps}_steps.zip"
            assert model.learn(16, reset_num_timesteps=False).num_timesteps == steps + 16
        for path in {*leftovers, *tmp_path.glob("rl_model_*")} - {newest}:
            path.unlink()
    assert steps > N_KILLS
    assert n_interrupted > 0  # some kills have struck while a file was being written


# === What a crash leaves, moment by moment ===


def test_an_error_while_saving_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk, or Ctrl-C."""
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL)
    model.save(tmp_path / "model")
    before = (tmp_path / "model.zip").read_bytes()
    th_save, error = th.save, KeyboardInterrupt

    def save_half(state: Any, file: Any) -> None:
        th_save(state, file)
        if "param_groups" in (state or {}):
            raise error

    monkeypatch.setattr(th, "save", save_half)
    for error in (KeyboardInterrupt, OSError):
        with pytest.raises(error):
            model.learn(32).save(tmp_path / "model")
        assert [path.name for path in tmp_path.iterdir()] == ["model.zip"]
        assert (tmp_path / "model.zip").read_bytes() == before


def test_the_file_is_on_the_disk_before_it_gets_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []
    for name in ("fsync", "replace"):
        function = getattr(os, name)

        def spy(*args: Any, name: str = name, function: Any = function) -> None:
            calls.append(name)
            function(*args)

        monkeypatch.setattr(checkpoints.os, name, spy)
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL).save(tmp_path / "model")
    assert calls[:2] == ["fsync", "replace"]  # the third makes the folder's new entry last


# === The file ===


def test_names_are_those_of_sb3(tmp_path: Path) -> None:
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL)
    (tmp_path / "folder.zip").mkdir()
    message = f"Path '{tmp_path / 'new'}' does not exist. Will create it."
    with pytest.warns(UserWarning, match=exactly(message)):
        model.save(tmp_path / "new" / "a")
    message = (
        f"Path '{tmp_path / 'folder.zip'}' is a folder. Will save instead to "
        f"{tmp_path / 'folder.zip'}_2"
    )
    with pytest.warns(UserWarning, match=exactly(message)):
        model.save(str(tmp_path / "folder"))
    model.save(tmp_path / "b.model")
    assert (tmp_path / "new" / "a.zip").is_file()
    assert (tmp_path / "folder.zip_2").is_file()
    assert (tmp_path / "b.model").is_file()
    (tmp_path / "link.zip").symlink_to(tmp_path / "b.model")
    inode = (tmp_path / "b.model").stat().st_ino
    model.save(tmp_path / "link")
    assert (tmp_path / "link.zip").is_symlink()
    assert (tmp_path / "b.model").stat().st_ino != inode


def test_streams_and_excluded_attributes(tmp_path: Path) -> None:
    model = GCRPPO("MlpPolicy", normalized(), **SMALL).learn(64)
    stream = io.BytesIO()
    model.save(stream, exclude=["ep_component_buffer"])
    with (tmp_path / "model.zip").open("wb") as file:
        model.save(file)
    for path in (stream, tmp_path / "model"):
        env = normalized()
        loaded = GCRPPO.load(path, env=env)
        assert th.equal(parameters(loaded), parameters(model))
        np.testing.assert_array_equal(statistics(env), statistics(model.get_env()))
        assert bool(loaded.ep_component_buffer) == (path is not stream)
    with pytest.raises(TypeError, match=r"^Path 3 parameter has invalid type"):
        model.save(3)


def test_sb3_reads_our_files_and_we_read_those_without_our_entry(tmp_path: Path) -> None:
    """The entry more is JSON for everyone; a file of an earlier version has none."""
    model = GCRPPO("MlpPolicy", normalized(), **SMALL).learn(64)
    model.save(tmp_path / "new")
    data, loaded, _ = load_from_zip_file(tmp_path / "new.zip")
    assert data is not None
    assert data["num_timesteps"] == 64
    assert set(loaded) == {"policy", "policy.optimizer"}
    with (
        zipfile.ZipFile(tmp_path / "new.zip") as new,
        zipfile.ZipFile(tmp_path / "old.zip", "w") as old,
    ):
        assert json.loads(new.read("sb3_gcr.json"))["components"] == {"go": 0, "stay": 0, "save": 1}
        for name in set(new.namelist()) - {"sb3_gcr.json"}:
            old.writestr(name, new.read(name))
    env = normalized()
    assert th.equal(parameters(GCRPPO.load(tmp_path / "old", env=env)), parameters(model))
    np.testing.assert_array_equal(statistics(env), statistics(normalized()))
    one = GCRPPO("MlpPolicy", make_vec_env(lambda: Env(None), 1), **SMALL).learn(32)
    one.save(tmp_path / "one")
    assert th.equal(parameters(PPO.load(tmp_path / "one")), parameters(one))


# === The newest checkpoint ===


def test_the_checkpoint_with_the_most_steps_is_found(tmp_path: Path) -> None:
    assert latest_checkpoint(tmp_path / "none") is None
    assert latest_checkpoint(tmp_path) is None
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL)
    model.learn(96, CheckpointCallback(32, str(tmp_path)))
    model.save(tmp_path / "other_1000_steps")
    assert latest_checkpoint(str(tmp_path)) == tmp_path / "rl_model_96_steps.zip"
    assert latest_checkpoint(tmp_path, "other") == tmp_path / "other_1000_steps.zip"
    whole = (tmp_path / "rl_model_96_steps.zip").read_bytes()
    for n_lost in (100, 2_000, 10_000, len(whole)):
        (tmp_path / f"rl_model_{1000 + n_lost}_steps.zip").write_bytes(whole[:-n_lost])
    (tmp_path / "rl_model_x_steps.zip").write_bytes(whole[:-100])
    (tmp_path / "rl_model_vecnormalize_200_steps.pkl").write_bytes(whole[:-100])
    assert latest_checkpoint(tmp_path) == tmp_path / "rl_model_96_steps.zip"


def test_the_lines_of_the_docs_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every Python block of docs/saving.md, in one namespace, with a smaller budget."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs/saving.md").read_text(), re.S)
    assert len(blocks) >= 4
    monkeypatch.chdir(tmp_path)
    code = "\n".join(blocks).replace("1_000_000", "2_000").replace("10_000", "500")
    exec(compile(code, "docs/saving.md", "exec"), {})

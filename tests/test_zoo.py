"""rl-zoo3's commands, end to end with tiny budgets, and a model from every entry of our YAML
files.
"""

from __future__ import annotations

import argparse
import csv
import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import yaml
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gcr import GCRPPO
from sb3_gcr.envs.tasks.catalogue import TASKS
from sb3_gcr.rewards.decomposition import GYMNASIUM_ENVS
from sb3_gcr.simulators.envpool import ENVPOOL_ENVS
from sb3_gcr.simulators.envpool_gym import pool_of
from sb3_gcr.zoo import commands as zoo
from sb3_gcr.zoo import hyperparameter_file, main

if (
    importlib.util.find_spec("rl_zoo3") is None
):  # importing it here would change Gymnasium for the tests of other files
    pytest.skip("needs rl_zoo3", allow_module_level=True)
HAS_TASKS = importlib.util.find_spec("mujoco.batch") is not None
if HAS_TASKS:
    importlib.import_module("sb3_gcr.envs.batched")  # before rl_zoo3, for the same reason
pytestmark = [
    pytest.mark.filterwarnings(f"ignore:{message}")
    for message in (
        "FigureCanvasAgg is non-interactive",  # its plots call plt.show()
        # and plt.legend() where no run has a whole window of episodes
        "No artists with labels found",
        # its sampler draws n_steps and batch_size apart from each other
        "You have specified a mini-batch size",
        "Argument ``multivariate`` is an experimental feature",  # of Optuna, which it uses
        # Optuna, at the start of a search that is already complete
        "`GridSampler` is re-evaluating",
    )
]

FILES = {
    algo: yaml.safe_load((files("sb3_gcr.hyperparams") / f"{algo}.yml").read_text())
    for algo in ("gcrppo", "ppo")
}
RUN = "sb3_gcr/HumanoidRun-v0"
#: One update of 64 steps in place of 512.
SMALL = ["--seed", "0", "-params", "n_steps:64", "batch_size:32", "n_epochs:1"]
needs_tasks = pytest.mark.skipif(not HAS_TASKS, reason="our tasks need MuJoCo 4.0")


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
    monkeypatch.setenv("MPLBACKEND", "agg")


def train(algo: str, env_id: str, *options: str) -> None:
    main(["train", "--algo", algo, "--env", env_id, "--verbose", "0", *options])


def test_files_have_every_env_and_differ_only_where_they_must() -> None:
    ours = {f"sb3_gcr/{name}-v0" for name in TASKS}
    ours |= {f"envpool/{env_id}" for env_id in ENVPOOL_ENVS}
    assert set(FILES["gcrppo"]) == set(FILES["ppo"]) == set(GYMNASIUM_ENVS) | ours
    for env_id, settings in FILES["gcrppo"].items():
        only_ours = {"env_wrapper", "desired_kl"} | (
            {"ent_coef"} if "Throwing" in env_id else set()
        )
        assert {key: value for key, value in settings.items() if key not in only_ours} == {
            key: value
            for key, value in FILES["ppo"][env_id].items()
            if key != "ent_coef" or "ent_coef" not in only_ours
        }
        assert settings.get("env_wrapper") == (
            None if env_id in ours else "sb3_gcr.RewardDecomposition"
        )
    assert hyperparameter_file("ppo", "Humanoid-v5")
    assert not hyperparameter_file("ppo", "CartPole-v1")
    assert not hyperparameter_file("sac", "Humanoid-v5")


@pytest.mark.parametrize(
    ("algo", "env_id"), [(algo, env_id) for algo, entries in FILES.items() for env_id in entries]
)
def test_every_entry_makes_a_model(algo: str, env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """And warns of nothing, such as a minibatch that does not divide the rollout."""
    if env_id not in gym.registry:
        pytest.skip("not registered yet")
    zoo.register()
    manager_class = importlib.import_module("sb3_gcr.zoo.managers").ZooManager
    if env_id.startswith("envpool/"):
        pytest.importorskip("envpool")
        monkeypatch.setattr(manager_class, "default_vec_env_cls", staticmethod(pool_of))
    if env_id.startswith("sb3_gcr/"):
        monkeypatch.setattr(
            manager_class,
            "default_vec_env_cls",
            pytest.importorskip("sb3_gcr.envs.batched").BatchedVecEnv,
        )
    manager = manager_class(
        argparse.Namespace(), algo, env_id, "logs", eval_freq=-1, verbose=0, device="cpu"
    )
    model, _ = manager.setup_experiment()  # type: ignore[misc]
    entry = FILES[algo][env_id]
    assert type(model) is {"gcrppo": GCRPPO, "ppo": PPO}[algo]
    assert isinstance(model.env, VecNormalize)
    assert model.env.num_envs == entry.get("n_envs", 1)
    assert isinstance(model, PPO)
    assert model.n_steps * model.n_envs % model.batch_size == 0
    if algo == "gcrppo":
        assert model.n_components == (
            1 if env_id == "InvertedPendulum-v5" else max(2, model.n_components)
        )  # type: ignore[attr-defined]
        assert getattr(model, "desired_kl") == entry.get("desired_kl")  # noqa: B009
    model.env.close()


@pytest.mark.parametrize("algo", ["gcrppo", "ppo"])
def test_train_stop_resume_enjoy_and_plot(
    algo: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The files of a run, and what is read back, are the same for GCRPPO and PPO."""
    calls = []
    update = PPO.train if algo == "ppo" else GCRPPO.train

    def interrupt(model: Any) -> None:
        calls.append(model.num_timesteps)
        if len(calls) == 2:
            raise KeyboardInterrupt
        update(model)

    frequencies = [
        "--eval-freq",
        "64",
        "--eval-episodes",
        "2",
        "--save-freq",
        "64",
        "--tensorboard-log",
        "tb",
    ]
    with monkeypatch.context() as stop:
        stop.setattr(PPO if algo == "ppo" else GCRPPO, "train", interrupt)
        train(algo, "Hopper-v5", "-n", "100000", *frequencies, *SMALL)
    run = Path(f"logs/{algo}/Hopper-v5_1")
    names = {path.name for path in run.iterdir()}
    assert names == {
        "0.monitor.csv",
        "Hopper-v5",
        "Hopper-v5.zip",
        "best_model.zip",
        "evaluations.npz",
    } | {f"rl_model_{n}_steps.zip" for n in (64, 128)}
    assert {path.name for path in (run / "Hopper-v5").iterdir()} == {
        "args.yml",
        "command.txt",
        "config.yml",
        "vecnormalize.pkl",
    }
    assert np.load(run / "evaluations.npz")["results"].shape == (2, 2)
    assert list(Path("tb").rglob("events.out.tfevents*"))
    assert "Loading saved" not in capsys.readouterr().out

    train(algo, "Hopper-v5", "-n", "128", "-i", str(run / "Hopper-v5.zip"), *frequencies, *SMALL)
    out = capsys.readouterr().out
    assert out.count("Loading saved VecNormalize stats") == 2  # of training and evaluation
    assert "Loading pretrained agent" in out
    counts = [
        VecNormalize.load(
            f"logs/{algo}/Hopper-v5_{i}/Hopper-v5/vecnormalize.pkl", _venv()
        ).obs_rms.count
        for i in (1, 2)
    ]
    assert counts[1] == pytest.approx(
        counts[0] + 129, abs=1
    )  # both started from what the first run has seen

    for chosen in ([], ["--load-best"], ["--load-checkpoint", "64"], ["--load-last-checkpoint"]):
        main(
            [
                "enjoy",
                "--algo",
                algo,
                "--env",
                "Hopper-v5",
                "-f",
                "logs",
                "-n",
                "60",
                "--no-render",
                *chosen,
            ]
        )
        assert "Loading running average" in capsys.readouterr().out

    main(["plot_train", "-a", algo, "-e", "Hopper-v5", "-f", "logs", "-w", "1"])
    main(
        [
            "all_plots",
            "-a",
            algo,
            "-e",
            "Hopper-v5",
            "-f",
            "logs",
            "--no-million",
            "-o",
            "results",
            "--no-display",
        ]
    )
    main(["plot_from_file", "-i", "results", "-o", "picture.svg", "--no-million"])
    assert Path("picture.svg").stat().st_size > 0


def _venv() -> Any:
    from stable_baselines3.common.env_util import make_vec_env

    return make_vec_env("Hopper-v5")


@needs_tasks
def test_batched_envs_train_evaluate_and_play(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--vec-env", "batch", "--algo", "gcrppo", "--env", "sb3_gcr/HumanoidMO-v0"]
    small = ["-params", "n_envs:8", "batch_size:128", "n_epochs:1", "--env-kwargs", "gait:1"]
    main(["train", *options, "-n", "256", "--eval-freq", "256", "--n-eval-envs", "2", *small])
    log = Path("logs/gcrppo/sb3_gcr-HumanoidMO-v0_1/0.monitor.csv").read_text().splitlines()
    assert [path.name for path in Path("logs").rglob("*.monitor.csv")] == ["0.monitor.csv"]
    rows = list(csv.DictReader(log[1:]))
    assert {"r_progress", "r_joint_pos_limits", "r_gait_range"} <= set(rows[0])
    for row in rows:
        terms = [float(value) for key, value in row.items() if key.startswith("r_")]
        assert sum(terms) == pytest.approx(float(row["r"]), abs=1e-3)
    capsys.readouterr()
    main(["enjoy", *options, "-f", "logs", "-n", "100", "--no-render"])
    assert "Mean reward" in capsys.readouterr().out
    from rl_zoo3 import exp_manager, utils

    assert exp_manager.ExperimentManager.default_vec_env_cls is None
    assert not hasattr(utils.create_test_env, "keywords")


@needs_tasks
def test_envpools_envs_train_and_play(capsys: pytest.CaptureFixture[str]) -> None:
    """In one pool, with the terms in Monitor's file; the model is played in one env."""
    pytest.importorskip("envpool")
    env_id, small = (
        "envpool/Reacher-v5",
        ["-params", "n_envs:8", "n_steps:64", "batch_size:128", "n_epochs:1"],
    )
    train("gcrppo", env_id, "--vec-env", "batch", "-n", "512", "--eval-freq", "-1", *small)
    folder = Path("logs/gcrppo/envpool-Reacher-v5_1")
    episodes = load_results(str(folder))
    assert len(episodes) >= 8
    np.testing.assert_allclose(
        episodes["r_reward_dist"] + episodes["r_reward_ctrl"], episodes["r"], atol=1e-4
    )
    for vec_env in ([], ["--vec-env", "batch"]):
        main(
            [
                "enjoy",
                "--algo",
                "gcrppo",
                "--env",
                env_id,
                "-f",
                "logs",
                "-n",
                "60",
                "--no-render",
                *vec_env,
            ]
        )
        assert "Episode Reward" in capsys.readouterr().out


def test_single_envs_log_their_terms_too() -> None:
    train("ppo", "sb3_gcr/Hopper-v0", "-n", "128", "--eval-freq", "-1", *SMALL, "n_envs:2")
    for path in Path("logs/ppo/sb3_gcr-Hopper-v0_1").glob("*.monitor.csv"):
        assert "r,l,t,r_reward_forward,r_reward_survive,r_reward_ctrl" in path.read_text()


@needs_tasks
def test_record_training_records_our_runs(tmp_path: Path) -> None:
    """It starts record_video as a subprocess, and ffmpeg."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin/ffmpeg").symlink_to(ffmpeg)
    train(
        "gcrppo",
        "sb3_gcr/Hopper-v0",
        "-n",
        "64",
        "--eval-freq",
        "-1",
        *SMALL,
        "n_envs:2",
        "--vec-env",
        "batch",
    )
    options = [
        "--algo",
        "gcrppo",
        "--env",
        "sb3_gcr/Hopper-v0",
        "-f",
        "logs",
        "-n",
        "5",
        "--vec-env",
        "batch",
    ]
    environment = {**os.environ, "MUJOCO_GL": "egl", "PATH": f"{tmp_path}/bin:{os.environ['PATH']}"}
    result = subprocess.run(
        [sys.executable, "-m", "sb3_gcr.zoo", "record_training", *options],
        capture_output=True,
        text=True,
        env=environment,
    )
    if "OpenGL context" in result.stderr or "EGL" in result.stderr:
        pytest.skip("no EGL here")
    assert result.returncode == 0, result.stderr
    videos = Path("logs/gcrppo/sb3_gcr-Hopper-v0_1/videos")
    assert (videos / "training.mp4").stat().st_size > 0
    assert list(videos.glob("final-model-*.mp4"))


def test_optimize_searches_the_resolver_too(capsys: pytest.CaptureFixture[str]) -> None:
    search = [
        "--storage",
        "search.log",
        "--study-name",
        "s",
        "--n-trials",
        "2",
        "--eval-episodes",
        "1",
        "-n",
        "200",
    ]
    train(
        "gcrppo",
        "Swimmer-v5",
        "-optimize",
        *search,
        "--env-kwargs",
        "max_episode_steps:20",
        "--no-optim-plots",
    )
    report = next(Path("logs/gcrppo").glob("report_*.csv"))
    rows = list(csv.DictReader(report.read_text().splitlines()))
    assert len(rows) == 2
    assert {row["params_resolver"] for row in rows} <= {"gcr", "guaranteed"}
    train(
        "gcrppo",
        "Swimmer-v5",
        "--storage",
        "search.log",
        "--study-name",
        "s",
        "--trial-id",
        "1",
        "-n",
        "10",
        "--eval-freq",
        "-1",
    )
    assert f"('resolver', '{rows[1]['params_resolver']}')" in capsys.readouterr().out


def test_tune_entropy_gives_every_value_all_seeds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    search = importlib.import_module("sb3_gcr.zoo.entropy_search")
    assert np.round(search.ENTROPY_GRID["ent_coef"], 8).tolist() == [
        *(0.0001, 0.00018847, 0.0003552, 0.00066943, 0.00126166),  # the numbers of the paper
        *(0.00237782, 0.0044814, 0.00844598, 0.01591789, 0.03),
    ]
    budgets = []
    learn = GCRPPO.learn

    def count(model: Any, total_timesteps: int, **kwargs: Any) -> Any:
        budgets.append((total_timesteps, model.ent_coef, model.seed))
        return learn(model, 128, **kwargs)

    monkeypatch.setattr(GCRPPO, "learn", count)
    monkeypatch.setattr(search, "ENTROPY_GRID", {"ent_coef": [1e-4, 3e-2], "seed": [0, 1]})
    command = ["tune_entropy", "--algo", "gcrppo", "--env", "Swimmer-v5", "--eval-episodes", "1"]
    command += [
        "--env-kwargs",
        "max_episode_steps:20",
        "-params",
        "n_envs:1",
        "n_steps:64",
        "n_timesteps:256",
        "batch_size:32",
    ]
    main(command)
    assert sorted(budgets) == [(128, value, seed) for value in (1e-4, 3e-2) for seed in (0, 1)]
    table = capsys.readouterr().out.splitlines()[-4:]
    assert table[0].split() == ["ent_coef", "return", "seeds"]
    assert [line.split()[0::2] for line in table[1:3]] == [["0.000100", "2"], ["0.030000", "2"]]
    means = {line.split()[0]: float(line.split()[1]) for line in table[1:3]}
    assert table[3].removeprefix("Best entropy coefficient: ") in means
    assert means[table[3].split()[-1]] == max(means.values())
    main(command)  # another machine that comes late has nothing to do
    assert len(budgets) == 4
    assert capsys.readouterr().out.splitlines()[-4:] == table


def test_envs_that_we_have_no_settings_for_get_those_of_rl_zoo3(
    capsys: pytest.CaptureFixture[str],
) -> None:
    small = [
        "-n",
        "10",
        "--eval-freq",
        "-1",
        "-params",
        "n_envs:1",
        "n_steps:8",
        "batch_size:8",
        "n_epochs:1",
    ]
    for algo in ("gcrppo", "ppo"):
        train(algo, "CartPole-v1", *small)
        assert "rl_zoo3/hyperparams/ppo.yml" in capsys.readouterr().out.replace(os.sep, "/")
    Path("mine.yml").write_text("CartPole-v1: {n_timesteps: 10, policy: MlpPolicy}")
    train("gcrppo", "CartPole-v1", "--conf-file", "mine.yml", *small)
    assert "Loading hyperparameters from: mine.yml" in capsys.readouterr().out


def test_custom_envs_make_rl_zoo3s_own_commands_work(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "rl_zoo3.train",
        "--algo",
        "gcrppo",
        "--env",
        "Hopper-v5",
        "-n",
        "10",
        "--eval-freq",
        "-1",
    ]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    (tmp_path / "custom_envs.py").write_text("from sb3_gcr.zoo import register\n\nregister()\n")
    result = subprocess.run([*command, *SMALL], capture_output=True, text=True, env=environment)
    assert result.returncode == 0, result.stderr
    assert "3 reward components" in result.stdout


@pytest.mark.parametrize("command", [*zoo.COMMANDS, "tune_entropy"])
def test_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    assert "--help" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "sb3-gcr-zoo: error: the following arguments are required: command"),
        (["play"], "sb3-gcr-zoo: error: argument command: invalid choice: 'play' (choose from"),
        (
            ["train", "--vec-env", "batch", "--env", "Ant-v5"],
            "--vec-env batch needs an env of sb3_gcr or EnvPool, such as '" + RUN,
        ),
        (
            ["enjoy", "--vec-env", "x"],
            "sb3-gcr-zoo enjoy: error: argument --vec-env: invalid choice: 'x' (choose from",
        ),
        (
            ["train", "--algo", "x"],
            "sb3-gcr-zoo train: error: argument --algo: invalid choice: 'x' (choose from",
        ),
        (
            ["tune_entropy", "--algo", "ppo"],
            "sb3-gcr-zoo tune_entropy: error: the following arguments are required: --env",
        ),
        (["tune_entropy", "--n-jobs", "2"], "argument --n-jobs: invalid choice: 2 (choose from"),
    ],
)
def test_errors(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    before = sys.argv
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    if message.endswith("'play' (choose from"):
        assert all(command in error for command in zoo.COMMANDS)
    assert sys.argv is before


def test_what_is_missing_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with monkeypatch.context() as without:
        without.setenv("PATH", "")
        with pytest.raises(SystemExit):
            main(["record_training"])
    assert capsys.readouterr().err == (
        "sb3-gcr-zoo record_training needs the program ffmpeg; on Debian and Ubuntu: apt install "
        "ffmpeg\n"
    )
    monkeypatch.setitem(sys.modules, "rl_zoo3", None)
    with pytest.raises(SystemExit) as stop:
        main(["train"])
    assert stop.value.code == 2
    assert capsys.readouterr().err.startswith(
        "sb3-gcr-zoo needs rl-zoo3: pip install 'sb3_gcr[zoo]' ("
    )
    with pytest.raises(ImportError, match=r"needs rl-zoo3: pip install 'sb3_gcr\[zoo\]'"):
        zoo.register()

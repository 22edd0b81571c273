"""A cell: what is trained, what is measured, and what the command line says to wrong input."""

from __future__ import annotations

import importlib.util
import json
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gcr import RewardSpec
from sb3_gcr.resolvers import RESOLVERS
from sb3_gcr.study import cells
from sb3_gcr.study.__main__ import main
from sb3_gcr.study.environments import Shown
from sb3_gcr.study.manifest import Manifest, expand
from sb3_gcr.study.settings import DEFAULTS, policy_kwargs
from sb3_gcr.study.watching import Recorder, WatchedResolver, over_windows
from tests.study_envs import Walk

SMALL = {**DEFAULTS, "n_envs": 4, "n_steps": 50, "batch_size": 50, "n_epochs": 2, "net_arch": [8]}
TERMS = {"speed": "task", "torque": "regulariser"}


def cell(method: str = "gcr", env: str = "tests.study_envs:Walk", **changes: Any) -> Any:
    """A cell of 1000 steps."""
    task = {"env": env, "timesteps": 1000, "components": TERMS, **changes.pop("task", {})}
    whole = {
        "name": "small",
        "methods": [method],
        "seeds": [3],
        "minutes": 1,
        "settings": {**SMALL, **changes},
        "tasks": {"walk": task},
    }
    return expand(Manifest.from_dict(whole))[0]


@pytest.fixture(scope="module")
def results() -> Mapping[str, Any]:
    """One finished cell a method."""
    methods = ("ppo", "multi_head", "gcr", "gcr_inverted")
    return {name: cells.run_cell(cell(name).canonical()) for name in methods}


def test_a_result_keeps_its_contract(results: Mapping[str, Any]) -> None:
    result = results["gcr"]
    text = json.dumps(result, allow_nan=False)
    assert json.loads(text) == result
    assert result["id"] == cell("gcr").id
    assert set(result) == {
        "schema",
        "id",
        "cell",
        "scalars",
        "final_terms",
        "curves",
        "levels",
        "cosines",
        "provenance",
    }
    curves = result["curves"]
    columns = [curves["steps"], curves["return"], curves["conflicts"], curves["conflict_rate"]]
    columns += [*curves["terms"].values(), *curves["weights"].values()]
    assert {len(column) for column in columns} == {50}
    assert curves["steps"][-1] == result["scalars"]["steps"] == 1000
    assert result["levels"] == {"speed": 0, "torque": 1}
    assert np.shape(result["cosines"]["first"]) == (2, 2)
    assert result["cosines"]["first"][0][0] == pytest.approx(1)
    assert len(result["provenance"]["digest"]) == 12


def test_terms_sum_to_the_return(results: Mapping[str, Any]) -> None:
    """All methods; PPO has the terms too, though it does not learn from them."""
    for result in results.values():
        final = sum(result["final_terms"].values())
        assert final == pytest.approx(result["scalars"]["return_final"], abs=1e-4)
        for window in range(50):
            total = result["curves"]["return"][window]
            terms = [curve[window] for curve in result["curves"]["terms"].values()]
            assert (total is None) == (terms[0] is None)
            if total is not None:
                assert sum(terms) == pytest.approx(total, abs=1e-4)


def test_windows_hold_the_episodes_that_ended_in_them(results: Mapping[str, Any]) -> None:
    """4 envs end their 20 steps at 80, 160, ...; a window has 20 steps."""
    curve = results["gcr"]["curves"]["return"]
    assert curve[:3] == [None] * 3
    assert curve[3] == curve[4] == curve[6] != curve[7]
    known = [value for value in curve if value is not None]
    assert results["gcr"]["scalars"]["return_training"] == pytest.approx(np.mean(known))


def test_what_ppo_does_not_have_is_null(results: Mapping[str, Any]) -> None:
    ppo = results["ppo"]
    assert ppo["scalars"]["conflict_count"] is None
    assert ppo["curves"]["weights"] is None
    assert ppo["cosines"] is None
    assert ppo["levels"] == {"speed": 0, "torque": 1}
    assert results["gcr_inverted"]["levels"] == {"speed": 1, "torque": 0}


def test_all_methods_meet_the_same_random_actions(results: Mapping[str, Any]) -> None:
    """Uniform actions pay 20 (0 - 0.5 / 3) = -3.33 an episode."""
    returns = {result["scalars"]["random_return"] for result in results.values()}
    assert len(returns) == 1
    assert returns.pop() == pytest.approx(-3.33, abs=2.5)


def test_training_finds_the_optimum_direction(results: Mapping[str, Any]) -> None:
    """Pushing right at full strength pays 20 (1 - 0.5) = 10, standing still 0."""
    longer = cell("gcr", n_steps=100, n_epochs=10, learning_rate=3e-3, task={"timesteps": 8000})
    scalars = cells.run_cell(longer.canonical())["scalars"]
    assert 8 < scalars["return_final"] <= 10.001
    assert scalars["failed_share"] == 0
    assert 0.5 <= scalars["dominance_share"] <= 1


def test_ppo_is_sb3s_bit_for_bit() -> None:
    one = cell("ppo", advantage_scope="minibatch", desired_kl=None).canonical()
    settings = one["settings"]
    spec = RewardSpec.from_dict(TERMS)
    envs = cells.normalised(cells.training_envs(one, 1), one)
    shown = Shown(envs, cells.trained_spec(one["algorithm"], spec))
    ours = cells.make_model(one, shown, WatchedResolver(RESOLVERS["sum"]))
    ours.learn(1000, callback=Recorder(spec.names, ours.resolver, 1000))  # type: ignore[arg-type]
    theirs = PPO(
        "MlpPolicy",
        VecNormalize(make_vec_env(Walk, 4, seed=30_000), gamma=settings["gamma"]),
        policy_kwargs=policy_kwargs(settings),
        seed=30_000,
        device="cpu",
        **{name: settings[name] for name in cells.MODEL},
    ).learn(1000)
    pairs = zip(ours.policy.parameters(), theirs.policy.parameters(), strict=True)
    assert all(th.equal(one, other) for one, other in pairs)


def test_the_same_cell_gives_the_same_numbers(results: Mapping[str, Any]) -> None:
    again = cells.run_cell(cell("gcr").canonical())
    timed = {"wall_s", "cpu_s", "collect_s", "update_s", "evaluate_s", "memory_mb"}
    assert set(again) == set(results["gcr"])
    for key in ("final_terms", "curves", "levels", "cosines"):
        assert again[key] == results["gcr"][key]
    for name in set(again["scalars"]) - timed:
        assert again["scalars"][name] == results["gcr"]["scalars"][name]


def test_our_own_envs_and_raw_returns() -> None:
    """A batched env, levels that are not its own, and no VecNormalize at all."""
    own = cell(
        "gcr_authors_mask",
        "sb3_gcr/HumanoidRun-v0",
        normalize_obs=False,
        normalize_reward=False,
        task={"components": None, "env_kwargs": {"regulariser_weight": 3.0}},
    )
    result = cells.run_cell(own.canonical())
    assert list(result["levels"].values()) == [1, 0, 1, 1, 0, 0, 0]
    assert result["curves"]["conflicts"][-1] >= 0


def test_windows_by_hand() -> None:
    """A window of 50 has 2 of 100 steps: 1 and 2 fall into the first, 100 into the last."""
    found = over_windows([1, 2, 3, 100], np.array([1.0, 2.0, 5.0, 7.0]), 100)
    assert found[:3] == [1.5, 5.0, 5.0]
    assert found[48:] == [5.0, 7.0]
    assert over_windows([], np.array([]), 100) == [None] * 50


def test_watched_gradients_by_hand() -> None:
    """g_1 = (3, 0) and g_2 = (-4, 0) conflict and have 4/7 of the sum; then they are orthogonal."""
    watched = WatchedResolver(RESOLVERS["sum"])
    levels, rng = np.array([0, 1]), np.random.default_rng(0)
    for gramian in ([[9.0, -12.0], [-12.0, 16.0]], [[9.0, 0.0], [0.0, 9.0]]):
        assert watched(np.array(gramian), levels, rng).tolist() == [1, 1]
    update = watched.read(10)
    assert update is not None
    assert update.conflicts == 0.5
    assert update.dominance == pytest.approx((4 / 7 + 1 / 2) / 2)
    assert update.cosines[0, 1] == -0.5
    assert watched.read(20) is None


def test_watching_costs_little(monkeypatch: pytest.MonkeyPatch) -> None:
    """The callback and the resolver around the resolver take less than 5 % of a training."""
    spent = {"watching": 0.0, "resolving": 0.0}

    def timed(function: Any, name: str) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            start = time.process_time()
            result = function(*args, **kwargs)
            spent[name] += time.process_time() - start
            return result

        return call

    for owner, name in (
        (WatchedResolver, "__call__"),
        (Recorder, "_on_step"),
        (Recorder, "_on_rollout_start"),
        (Recorder, "_on_rollout_end"),
    ):
        monkeypatch.setattr(owner, name, timed(getattr(owner, name), "watching"))
    one = cell("gcr", "HalfCheetah-v5", **DEFAULTS, task={"components": None}).canonical()
    envs = cells.normalised(cells.training_envs(one, 1), one)
    resolver = WatchedResolver(timed(RESOLVERS["gcr"], "resolving"))
    model = cells.make_model(one, envs, resolver)
    start = time.process_time()
    model.learn(4096, callback=Recorder(["reward_forward", "reward_ctrl"], resolver, 4096))
    whole = time.process_time() - start
    assert 0 < spent["watching"] - spent["resolving"] < 0.05 * whole


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What the command line says when it refuses."""
    assert main(arguments) == 2
    return capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env", "Nothing-v5"], "Unknown env 'Nothing-v5': give an id of Gymnasium ("),
        (["--env", "nothing:Here"], "Env 'nothing:Here': found no module 'nothing'. It must be"),
        (
            ["--env", "tests.study_envs:Silent"],
            "The env reports no reward terms. The keys of its info are ['weather'].",
        ),
        (
            ["--env", "tests.study_envs:Walk", "--components", "speed=task"],
            "Here: `--residual rest`.",
        ),
        (
            ["--env", "tests.study_envs:Walk", "--components", "sped=task"],
            "'sped' is missing: parameter `components` must name keys of `info`, found only "
            "['speed', 'torque']",
        ),
        (
            ["--env", "tests.study_envs:Walk", "--components", "speed=boss"],
            "Unknown level 'boss' of reward component 'speed'",
        ),
        (["--env", "HalfCheetah-v5", "--methods", "pp"], "Unknown methods ['pp']"),
        (["--env", "HalfCheetah-v5", "--settings", "rate=1"], "--settings: unknown settings"),
        (["--env", "HalfCheetah-v5", "--env-kwargs", "gait"], "--env-kwargs takes name=value"),
    ],
)
def test_wrong_input_is_refused_before_anything_runs(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "study"
    assert message in refused(["compare", *arguments, "--out", str(folder), "--yes"], capsys)
    assert not folder.exists()


def test_a_folder_of_another_manifest_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from sb3_gcr.study.folders import open_folder

    out = ["--out", str(tmp_path)]
    open_folder(Manifest.load("mask"), tmp_path)
    before = (tmp_path / "study.yml").read_bytes()
    assert "belongs to another manifest: 'mask' there is registered and cannot change" in refused(
        ["run", "smoke", *out], capsys
    )
    assert (tmp_path / "study.yml").read_bytes() == before
    assert refused(["cell", "mask", "nothing", *out], capsys).startswith(
        "sb3-gcr-study cell: 'mask' has no cell 'nothing'"
    )


def test_shards_are_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    message = refused(["run", "smoke", "--out", str(tmp_path), "--shard", "3/2"], capsys)
    assert "--shard takes which of how many, such as 2/4, found '3/2'." in message


def test_a_cell_in_the_foreground_and_one_that_raises(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import yaml

    task = {"timesteps": 200, "components": TERMS}
    content = {
        "name": "two",
        "methods": ["gcr"],
        "seeds": 1,
        "minutes": 1,
        "settings": SMALL,
        "tasks": {
            "good": {"env": "tests.study_envs:Walk", **task},
            "bad": {"env": "tests.study_envs:Raising", **task},
        },
    }
    path = tmp_path / "two.yml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    good, bad = expand(Manifest.load(path))
    out = ["--out", str(tmp_path / "out")]
    assert main(["cell", str(path), good.id, *out]) == 0
    assert main(["cell", str(path), bad.id, *out]) == 1
    assert main(["cell", str(path), good.id, *out]) == 0
    assert "good, gcr, seed 0 is done." in capsys.readouterr().out
    assert main(["status", str(path), *out]) == 0
    assert main(["plan", str(path), *out, "--cells"]) == 0
    assert f"{bad.id}  bad, gcr, seed 0" in capsys.readouterr().out
    assert main(["sbatch", str(path), *out]) == 0
    assert "#SBATCH --array=1-2\n" in capsys.readouterr().out
    error = json.loads((tmp_path / f"out/cells/{bad.id}/error.json").read_text())
    assert error["error"] == "RuntimeError: the robot is gone"


def test_run_names_failed_cells_and_finishes_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import yaml

    content = {
        "name": "two",
        "methods": ["gcr"],
        "seeds": 1,
        "minutes": 1,
        "settings": SMALL,
        "tasks": {
            name: {"env": f"tests.study_envs:{env}", "timesteps": 200, "components": TERMS}
            for name, env in {"bad": "Raising", "good": "Walk"}.items()
        },
    }
    path = tmp_path / "two.yml"
    path.write_text(yaml.safe_dump(content))
    bad, good = expand(Manifest.load(path))
    out = tmp_path / "out"
    assert main(["run", str(path), "--out", str(out), "--jobs", "2"]) == 1
    message = capsys.readouterr().err
    assert "FAILED bad, gcr, seed 0: exit code 1: RuntimeError: the robot is gone" in message
    assert f"again: sb3-gcr-study cell {out}/study.yml {bad.id}\n" in message
    assert (out / f"cells/{good.id}/result.json").exists()
    assert main(["plan", str(out / "study.yml")]) == 0
    assert "2 cells, 1 to run" in capsys.readouterr().out
    more = {**content, "name": "more", "tasks": {"good": content["tasks"]["good"]}}  # type: ignore[index]
    path.write_text(yaml.safe_dump(more))
    arguments = ["run", str(path), "--out", str(tmp_path / "more"), "--reuse", str(out)]
    assert main(arguments) == 0
    assert "1 cells taken over." in capsys.readouterr().out


def test_compare_answers_and_grows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("sb3_gcr.study.report")
    settings = ["n_envs=4", "n_steps=50", "batch_size=50", "n_epochs=2", "net_arch=[8]"]
    arguments = ["compare", "--env", "tests.study_envs:Walk", "--methods", "multi_head", "gcrppo"]
    arguments += ["--components", "speed=task", "torque=regulariser", "--timesteps", "200"]
    arguments += ["--settings", *settings, "--out", str(tmp_path), "--yes", "--jobs", "2"]
    assert main([*arguments, "--seeds", "1"]) == 0
    assert "| speed  | task" in capsys.readouterr().out
    first = {path: path.stat().st_mtime_ns for path in tmp_path.glob("cells/*/result.json")}
    assert len(first) == 2
    assert main([*arguments, "--seeds", "2"]) == 0
    assert "4 cells, 2 to run" in capsys.readouterr().out
    assert len(list(tmp_path.glob("cells/*/result.json"))) == 4
    assert all(path.stat().st_mtime_ns == moment for path, moment in first.items())
    assert "</html>" in (tmp_path / "report.html").read_text()
    assert main([*arguments, "--seeds", "1"]) == 2
    assert "a study can grow, not shrink" in capsys.readouterr().err


def test_regulariser_weight_multiplies_the_regularisers_alone() -> None:
    import gymnasium as gym

    rows = []
    for weight in (1.0, 10.0):
        env = gym.make("sb3_gcr/HumanoidRun-v0", regulariser_weight=weight)
        env.reset(seed=0)
        rows.append(env.step(np.full(17, 0.5, np.float32))[4]["reward_components"])
    assert rows[1] == pytest.approx(rows[0] * [1, 1, 1, 1, 10, 10, 10])


@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs Ray")
@pytest.mark.filterwarnings("ignore")
def test_ray_gives_the_same_numbers(
    tmp_path: Path, results: Mapping[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same scalars as in this process; a cell whose process crashes is named."""
    monkeypatch.setenv("RAY_worker_niceness", "0")  # 15 by default: nothing on a busy machine
    import ray

    from sb3_gcr.study.engines import RayEngine
    from sb3_gcr.study.runner import Limits, Runner
    from sb3_gcr.study.store import Store, collect

    good, bad = cell("gcr"), cell("gcr", "tests.study_envs:Crashing")
    store = Store(tmp_path)
    try:
        engine = RayEngine(store, threads=1, jobs=1)
        failed = Runner([[good, bad]], store, engine, Limits(jobs=1)).run()
    finally:
        ray.shutdown()
    assert failed == [bad]
    collected = collect(tmp_path)
    assert collected.errors[0]["error"].startswith("WorkerCrashedError")
    timed = {"wall_s", "cpu_s", "collect_s", "update_s", "evaluate_s", "memory_mb"}
    for name in set(collected.results[0]["scalars"]) - timed:
        assert collected.results[0]["scalars"][name] == results["gcr"]["scalars"][name]
    assert not math.isnan(collected.results[0]["scalars"]["return_final"])

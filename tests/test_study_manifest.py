"""Manifests, cells and their ids, methods and settings."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from sb3_gcr import RewardSpec
from sb3_gcr.study.compare import make_manifest, pairs
from sb3_gcr.study.manifest import (
    HELD_OUT,
    Manifest,
    blocks,
    cell_id,
    draw_configurations,
    expand,
)
from sb3_gcr.study.methods import METHODS, named, trained_spec, with_heads
from sb3_gcr.study.settings import DEFAULTS, settings_of

STUDIES = Path(__file__).parents[1] / "sb3_gcr/study/studies"
NAMES = sorted(path.stem for path in STUDIES.glob("*.yml"))


def content(**changes: Any) -> dict[str, Any]:
    """A small manifest."""
    task = {"env": "sb3_gcr/Walker2d-v0", "timesteps": 1000}
    whole = {
        "name": "small",
        "methods": ["ppo", "gcr"],
        "seeds": 2,
        "minutes": 1,
        "settings": dict(DEFAULTS),
        "tasks": {"walker": task, "again": {**task, "timesteps": 2000}},
    }
    return {**whole, **changes}


def test_blocks_hold_all_methods_and_the_first_seed_comes_first() -> None:
    found = [
        [(cell.task.name, cell.method, cell.seed) for cell in block]
        for block in blocks(Manifest.from_dict(content()))
    ]
    assert found == [
        [("walker", "ppo", 0), ("walker", "gcr", 0)],
        [("again", "ppo", 0), ("again", "gcr", 0)],
        [("walker", "ppo", 1), ("walker", "gcr", 1)],
        [("again", "ppo", 1), ("again", "gcr", 1)],
    ]


def test_ids_are_those_of_always() -> None:
    """A change here means that every result that anybody has is lost to its study."""
    ids = [cell.id for cell in expand(Manifest.from_dict(content()))]
    assert ids[:2] == GOLDEN
    assert len(set(ids)) == 8


def test_ids_do_not_depend_on_the_order_of_keys_or_the_kind_of_number() -> None:
    first = expand(Manifest.from_dict(content()))[0]
    turned = json.loads(json.dumps(first.canonical()))
    turned["settings"] = dict(reversed(turned["settings"].items()))
    assert cell_id(dict(reversed(turned.items()))) == first.id
    whole = content(settings={**DEFAULTS, "clip_obs": 10, "n_steps": 256.0})
    assert expand(Manifest.from_dict(whole))[0].id == first.id


def test_ids_depend_on_what_changes_numbers_and_on_nothing_else() -> None:
    def ids(**changes: Any) -> list[str]:
        return [cell.id for cell in expand(Manifest.from_dict(content(**changes)))]

    assert ids(name="other", minutes=5, question="why?") == ids()
    assert set(ids(settings={**DEFAULTS, "gamma": 0.9})).isdisjoint(ids())
    assert set(ids(seeds=[5, 6])).isdisjoint(ids())


def test_a_manifest_written_out_is_the_same_manifest() -> None:
    drawn = {
        "env": "sb3_gcr/HumanoidMO-v0",
        "timesteps": 1000,
        "draw": {"seed": 3, "number": 2, "factors": {"energy": [None, 0, 1], "gait": [None, 2]}},
        "variants": {
            "raw": {"settings": {"normalize_reward": False}},
            "scaled": {"settings": {"normalize_reward": True}},
        },
    }
    manifest = Manifest.from_dict(content(tasks={"mo": drawn}))
    assert [task.settings["normalize_reward"] for task in manifest.tasks] == [False, True] * 2
    assert manifest.tasks[0].env_kwargs == manifest.tasks[1].env_kwargs
    text = yaml.safe_dump(manifest.to_dict())
    again = Manifest.from_dict(yaml.safe_load(text))
    assert again == manifest
    assert again.to_dict()["digest"] == manifest.to_dict()["digest"]
    assert manifest.to_dict()["n_cells"] == len(expand(manifest)) == 16


def test_draws_are_distinct_and_more_of_them_begin_with_the_same() -> None:
    factors = {name: [None, 0, 1, 2, 3, 4] for name in ("energy", "baseh", "lean", "knee")}
    some = draw_configurations(factors, 80, seed=1, at_least=2)
    assert len({json.dumps(one) for one in some}) == 80
    assert all(sum(value is not None for value in one.values()) >= 2 for one in some)
    assert draw_configurations(factors, 12, seed=1, at_least=2) == some[:12]
    assert draw_configurations(factors, 80, seed=2, at_least=2) != some
    with pytest.raises(ValueError, match="at most 4, the number of distinct configurations"):
        draw_configurations({"a": [None, 1], "b": [0, 1]}, 5, seed=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"methods": ["pp0"]}, r"Unknown methods \['pp0'\]; valid choices are \['ppo', "),
        ({"colour": 1}, r"Study 'small': unknown keys \['colour'\]; valid choices are"),
        ({"seeds": [1000]}, r"`seeds` must be a number or distinct seeds from 0 to 999"),
        ({"seeds": [1, 1]}, r"`seeds` must be a number or distinct seeds"),
        ({"purpose": "fun"}, r"`purpose` must be one of \['study', 'pilot', 'tuning'\]"),
        ({"minutes": 0}, r"`minutes` must be a number above 0, found 0"),
        ({"tasks": {"a": {"env": "x"}}}, r"Task 'a' lacks \['timesteps'\]"),
        ({"settings": {}}, r"cells must not. Add \['n_envs', "),
        ({"settings": {**DEFAULTS, "speed": 1}}, r"unknown settings \['speed'\]"),
        ({"settings": {**DEFAULTS, "gamma": "9e-1"}}, r"YAML reads 3e-4 as a word"),
        ({"settings": {**DEFAULTS, "activation": "gelu"}}, r"one of \['tanh', 'relu', 'elu'\]"),
        ({"hypotheses": {"H1": {"claim": "x"}}}, r"Hypothesis 'H1' lacks \['contrast', "),
    ],
)
def test_wrong_manifests_are_refused_in_a_sentence(changes: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Manifest.from_dict(content(**changes))


def test_a_missing_manifest_names_those_that_are_there() -> None:
    with pytest.raises(FileNotFoundError, match=r"a YAML file or one of \['dose', .*found 'none'"):
        Manifest.load("none")


def test_heads_are_added_where_surgery_is_compared_with_ppo() -> None:
    assert with_heads(named(["ppo", "gcrppo"])) == ["ppo", "multi_head", "gcr"]
    assert with_heads(["gcr", "ppo"]) == ["gcr", "ppo", "multi_head"]
    assert with_heads(["ppo", "multi_head"]) == ["ppo", "multi_head"]
    assert with_heads(["gcr", "levels"]) == ["gcr", "levels"]


def test_levels_of_the_methods() -> None:
    """HumanoidRun's columns that the authors' code treats as tasks: alive, action_l2, energy,
    joint_pos_limits."""
    names = (
        "progress",
        "alive",
        "upright",
        "move_to_target",
        "action_l2",
        "energy",
        "joint_pos_limits",
    )
    spec = RewardSpec(names, (0, 0, 0, 0, 1, 1, 1))
    specs = {name: trained_spec(method.to_dict(), spec) for name, method in METHODS.items()}
    assert specs["gcr"] == spec
    assert specs["gcr_authors_mask"].levels == (1, 0, 1, 1, 0, 0, 0)
    assert specs["gcr_inverted"].levels == (1, 1, 1, 1, 0, 0, 0)
    assert specs["ppo"].names == ("reward",)


def test_settings_of_our_envs_are_those_of_the_yaml_file() -> None:
    found = settings_of("sb3_gcr/ThrowingMO-v0")
    assert found["net_arch"] == [256, 128]
    assert found["activation"] == "elu"
    assert found["log_std_init"] == -0.7
    assert found["desired_kl"] == 0.02
    assert found["normalize_reward"] is True
    assert settings_of("HalfCheetah-v5") == DEFAULTS
    assert settings_of("sb3_gcr/Hopper-v0")["ortho_init"] is False


def test_values_of_the_command_line() -> None:
    given = ["rate=3e-4", "n=16", "on=true", "kind=task", "none=null", "net=[8, 8]"]
    assert pairs(given, "--settings") == {
        "rate": 3e-4,
        "n": 16,
        "on": True,
        "kind": "task",
        "none": None,
        "net": [8, 8],
    }
    with pytest.raises(ValueError, match=r"--settings takes name=value, found 'gamma'\."):
        pairs(["gamma"], "--settings")


def test_compare_grows_by_seeds_and_by_nothing_else() -> None:
    def made(seeds: int, **settings: Any) -> Manifest:
        return make_manifest(
            "HalfCheetah-v5", ["ppo", "gcrppo"], 1000, seeds, {}, None, None, settings
        )

    assert made(10).grows_from(made(5))
    assert not made(5).grows_from(made(10))
    assert not made(10, gamma=0.9).grows_from(made(5))
    assert {cell.id for cell in expand(made(5))} < {cell.id for cell in expand(made(10))}


@pytest.mark.parametrize("name", NAMES)
def test_shipped_manifests(name: str) -> None:
    """They expand into distinct cells, and held-out tasks stay out of what choices are made on."""
    manifest = Manifest.load(name)
    assert manifest.name == name
    ids = [cell.id for cell in expand(manifest)]
    assert len(set(ids)) == len(ids) > 0
    if manifest.purpose == "tuning":
        assert not [task for task in manifest.tasks if task.env.split("/")[-1].startswith(HELD_OUT)]
    text = (STUDIES / f"{name}.yml").read_text()
    assert "surrogate_clipping: joint" in text
    assert "gramian_samples: null" in text


@pytest.mark.parametrize(
    ("env", "env_kwargs"),
    [
        ("sb3_gcr/Hopper-v0", {}),
        ("Ant-v5", {}),
        ("envpool/G1JoystickFlatTerrain-v1", {}),
        ("envpool/PandaPickCube-v1", {}),
        ("sb3_gcr/Walker2dMO-v0", {"energy": 1}),
    ],
)
def test_no_tuning_on_held_out_tasks(env: str, env_kwargs: dict[str, Any]) -> None:
    task = {"env": env, "env_kwargs": env_kwargs, "timesteps": 1000}
    with pytest.raises(ValueError, match="Task 'a' is held out from tuning"):
        Manifest.from_dict(content(purpose="tuning", seeds=1, tasks={"a": task}))


def test_the_study_seeds_and_the_tuning_seeds_never_meet() -> None:
    seeds = {name: set(Manifest.load(name).seeds) for name in NAMES}
    tuned = set().union(*(s for n, s in seeds.items() if Manifest.load(n).purpose == "tuning"))
    studied = set().union(*(s for n, s in seeds.items() if Manifest.load(n).purpose == "study"))
    assert tuned
    assert studied
    assert tuned.isdisjoint(studied)


def test_drawn_configurations_of_the_study_are_enough_for_its_last_look() -> None:
    manifest = Manifest.load("planar_mo")
    assert len(manifest.tasks) == manifest.looks[-1] == 36
    kwargs = [json.dumps([task.env, dict(task.env_kwargs)]) for task in manifest.tasks]
    assert len(set(kwargs)) == 36
    active = [sum(v is not None for v in task.env_kwargs.values()) for task in manifest.tasks]
    assert np.min(active) >= 1


GOLDEN = ["77ff66fb18e2", "d83bb217ab11"]

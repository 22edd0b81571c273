"""Study folders made of numbers, without any training."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

#: Terms of the made-up reward, with their levels.
LEVELS = {"speed": 0, "alive": 0, "torque": 1, "action_rate": 1, "joint_limits": 1}
N_WINDOWS = 50
Result = dict[str, Any]


def result(
    method: str,
    seed: int,
    training: float,
    final: float | None = None,
    env: str = "MyEnv-v0",
    terms: Mapping[str, float] | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    settings: Mapping[str, Any] | None = None,
    digest: str = "d1",
    conflicts: float | None = 2.3,
    random: float | None = 0.0,
    timesteps: int = 500_000,
) -> Result:
    """A finished cell whose curve rises in a straight line and has the mean ``training``."""
    cell = {
        "env": env,
        "env_kwargs": dict(env_kwargs or {}),
        "components": None,
        "residual": None,
        "method": method,
        "settings": dict(settings or {}),
        "timesteps": timesteps,
        "seed": seed,
    }
    names = list(LEVELS)
    terms = terms or {"speed": training, "alive": 10.0, "torque": -31.0} | dict.fromkeys(
        names[3:], -1.0
    )
    steps = [(i + 1) * timesteps // N_WINDOWS for i in range(N_WINDOWS)]
    rise = [2.0 * (i + 0.5) / N_WINDOWS for i in range(N_WINDOWS)]
    has_terms = method != "ppo"
    rate = None if conflicts is None else conflicts / 10
    return {
        "schema": 1,
        "id": hashlib.sha256(json.dumps(cell, sort_keys=True).encode()).hexdigest()[:12],
        "cell": cell,
        "scalars": {
            "return_training": training,
            "return_final": training * 2 if final is None else final,
            "return_final_std": 1.0,
            "random_return": random,
            "conflict_count": conflicts if has_terms else None,
            "conflict_rate": rate if has_terms else None,
            "failed_share": 0.0,
            "dominance_share": 0.5 if has_terms else None,
            "steps": timesteps,
            "wall_s": 100.0,
            "cpu_s": 95.0,
            "collect_s": 60.0,
            "update_s": 30.0 if has_terms else 20.0,
            "memory_mb": 400.0,
        },
        "final_terms": terms,
        "curves": {
            "steps": steps,
            "return": [training * one for one in rise],
            "terms": {name: [value * one for one in rise] for name, value in terms.items()},
            "conflicts": [conflicts] * N_WINDOWS if has_terms else None,
            "conflict_rate": [rate] * N_WINDOWS if has_terms else None,
            "weights": {name: [1.0] * N_WINDOWS for name in names} if has_terms else None,
        },
        "levels": LEVELS,
        "cosines": cosines() if has_terms else None,
        "provenance": {"digest": digest, "git": "0123456789", "dirty": False},
    }


def cosines(kind: str = "minibatch") -> dict[str, Any]:
    """Matrices in which speed and torque oppose each other ever more."""
    names = list(LEVELS)

    def matrix(opposed: float) -> list[list[float]]:
        rows = [[1.0 if i == j else 0.1 for j in range(len(names))] for i in range(len(names))]
        rows[0][2] = rows[2][0] = opposed
        return rows

    return {"names": names, "first": matrix(-0.2), "last": matrix(-0.4), "kind": kind}


def error(method: str, seed: int, env: str = "MyEnv-v0") -> Result:
    """A cell that failed twice."""
    return {
        "id": f"{method}-{seed}",
        "cell": {
            "env": env,
            "env_kwargs": {},
            "method": method,
            "settings": {},
            "timesteps": 500_000,
            "seed": seed,
        },
        "attempts": 2,
        "error": "Traceback\nValueError: no <good>",
        "log_tail": "the last lines",
    }


def write_study(
    folder: Path,
    results: Sequence[Result],
    errors: Sequence[Result] = (),
    seeds: int = 5,
    methods: Sequence[str] = ("ppo", "multi_head", "gcr"),
    tasks: Sequence[Mapping[str, Any]] = ({"env": "MyEnv-v0"},),
) -> Path:
    """A folder as the runner leaves it."""
    manifest = {
        "name": "my_study",
        "n_cells": len(tasks) * len(methods) * seeds,
        "tasks": [dict(task) for task in tasks],
        "methods": list(methods),
        "seeds": list(range(seeds)),
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "study.yml").write_text(yaml.safe_dump(manifest))
    for name, records in (("result.json", results), ("error.json", errors)):
        for record in records:
            cell = folder / "cells" / record["id"]
            cell.mkdir(parents=True, exist_ok=True)
            (cell / name).write_text(json.dumps(record, allow_nan=False))
    return folder

"""The project's own rules: which module may import which, and that what the README shows runs."""

from __future__ import annotations

import ast
import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import sb3_gcr

ROOT = Path(__file__).parents[1]
#: Modules of ours that each module may import.
ARROWS = {
    "advantages": set(),
    "angles": set(),
    "averaging": set(),
    "arguments": {"checks"},
    "checks": set(),
    "diagnosis": set(),
    "losses": {"advantages"},
    "fast_gcr": {"angles"},
    "guaranteed": {"angles"},
    "resolvers": {"angles", "fast_gcr", "guaranteed"},
    "torchjd_adapter": {"angles", "guaranteed", "resolvers"},
    "minibatches": {"advantages", "gradients.__init__", "gradients.memory"},
    "schedules": set(),
    "optimisers": set(),
    "policies": {"optimisers"},
    "buffers": {"advantages"},
    "evaluation": {"rewards.reading"},
    "rewards.__init__": set(),
    "rewards.spec": set(),
    "rewards.values": {"rewards.spec"},
    "rewards.sums": {"rewards.spec"},
    "rewards.fitting": set(),
    "rewards.residuals": {"rewards.fitting", "rewards.spec"},
    "rewards.layers": {"rewards.spec"},
    "rewards.sources": {"checks", "rewards.values"},
    "rewards.gymnasium_envs": set(),
    "rewards.samples": {"rewards.values"},
    "rewards.found": {"rewards.decomposition", "rewards.samples", "rewards.spec"},
    "rewards.finding": {
        "checks",
        "rewards.decomposition",
        "rewards.fitting",
        "rewards.found",
        "rewards.samples",
        "rewards.spec",
        "rewards.sums",
        "rewards.values",
    },
    "rewards.returns": {"rewards.layers"},
    "rewards.decomposition": {
        "checks",
        "rewards.gymnasium_envs",
        "rewards.sources",
        "rewards.spec",
        "rewards.sums",
        "rewards.values",
    },
    "rewards.reading": {
        "rewards.decomposition",
        "rewards.gymnasium_envs",
        "rewards.layers",
        "rewards.residuals",
        "rewards.spec",
        "rewards.sums",
        "rewards.values",
    },
    "gradients.__init__": {
        "gradients.by_autograd",
        "gradients.by_hand",
        "gradients.fitting",
        "gradients.memory",
    },
    "gradients.by_autograd": {"gradients.hooks", "gradients.memory"},
    "gradients.fitting": {"gradients.hooks", "gradients.layers"},
    "gradients.hooks": set(),
    "gradients.gramian": {"gradients.memory"},
    "gradients.layers": {"gradients.memory"},
    "gradients.heads": {"gradients.memory"},
    "gradients.memory": set(),
    "gradients.by_hand": {
        "gradients.fitting",
        "gradients.gramian",
        "gradients.heads",
        "gradients.layers",
        "gradients.memory",
    },
    "conflicts.__init__": set(),
    "conflicts.estimators": set(),
    "conflicts.blocks": {"conflicts.estimators"},
    "conflicts.heads": {"advantages"},
    "conflicts.undisturbed": {"rewards.layers"},
    "conflicts.result": {"conflicts.estimators", "logs.shown", "rewards.spec"},
    "conflicts.measuring": {
        "checks",
        "conflicts.blocks",
        "conflicts.estimators",
        "conflicts.heads",
        "conflicts.result",
        "conflicts.undisturbed",
        "gcrppo",
        "gradients.by_autograd",
        "minibatches",
        "rewards.layers",
        "rewards.reading",
        "saving.model",
        "saving.statistics",
        "update",
    },
    "logs.__init__": set(),
    "logs.figures": {
        "angles",
        "conflicts.estimators",
        "gradients.memory",
        "losses",
        "rewards.spec",
    },
    "logs.shown": {"conflicts.estimators", "rewards.spec"},
    "logs.report": {"conflicts.estimators", "logs.shown", "rewards.spec"},
    "multi_head": {
        "advantages",
        "diagnosis",
        "logs.shown",
        "policies",
        "rewards.layers",
        "rewards.reading",
        "rewards.returns",
        "rewards.spec",
    },
    "multi_head_ppo": {"buffers", "multi_head", "policies"},
    "update": {
        "arguments",
        "averaging",
        "checks",
        "gradients.__init__",
        "gradients.by_hand",
        "gradients.memory",
        "logs.figures",
        "logs.shown",
        "losses",
        "minibatches",
        "multi_head",
        "resolvers",
        "rewards.decomposition",
        "schedules",
    },
    "gcrppo": {
        "arguments",
        "gradients.__init__",
        "multi_head_ppo",
        "resolvers",
        "saving.model",
        "update",
    },
    "recurrent.__init__": {
        "recurrent.buffers",
        "recurrent.policies",
        "recurrent.recurrent_gcrppo",
    },
    "recurrent.sequences": set(),
    "recurrent.policies": {"policies"},
    "recurrent.buffers": {"buffers", "recurrent.sequences"},
    "recurrent.by_autograd": {
        "gradients.by_autograd",
        "gradients.hooks",
        "gradients.memory",
        "recurrent.sequences",
    },
    "recurrent.multi_head_ppo": {
        "multi_head",
        "recurrent.buffers",
        "recurrent.policies",
        "recurrent.sequences",
    },
    "recurrent.recurrent_gcrppo": {
        "arguments",
        "gradients.__init__",
        "recurrent.by_autograd",
        "recurrent.multi_head_ppo",
        "recurrent.sequences",
        "resolvers",
        "saving.model",
        "update",
    },
    "saving.__init__": set(),
    "saving.checkpoints": set(),
    "saving.statistics": set(),
    "saving.warm_start": set(),
    "saving.settings": {"checks"},
    "saving.spaces": set(),
    "saving.unpickling": set(),
    "saving.archive": {
        "rewards.spec",
        "saving.settings",
        "saving.spaces",
        "saving.statistics",
        "saving.unpickling",
    },
    "saving.model": {
        "rewards.spec",
        "saving.archive",
        "saving.checkpoints",
        "saving.settings",
        "saving.spaces",
        "saving.statistics",
        "saving.warm_start",
    },
    "__init__": {
        "buffers",
        "conflicts.measuring",
        "envs.__init__",
        "evaluation",
        "gcrppo",
        "policies",
        "resolvers",
        "rewards.decomposition",
        "rewards.finding",
        "rewards.spec",
        "saving.checkpoints",
    },
    "zoo.__init__": {"zoo.commands", "zoo.hyperparameters"},
    "zoo.patches": set(),
    "zoo.hyperparameters": set(),
    "zoo.managers": {"zoo.hyperparameters"},
    "zoo.entropy_search": {"zoo.managers", "zoo.patches"},
    "zoo.__main__": {"zoo.commands"},
    "zoo.commands": {
        "recurrent.__init__",
        "simulators.envpool_gym",
        "zoo.components",
        "zoo.conflicts",
        "zoo.entropy_search",
        "zoo.hyperparameters",
        "zoo.managers",
        "zoo.patches",
    },
    "zoo.components": {"rewards.finding"},
    "zoo.conflicts": {"conflicts.measuring", "conflicts.result", "rewards.gymnasium_envs"},
    "envs.__init__": {"envs.hiding", "envs.tasks.catalogue", "simulators.envpool_gym"},
    "envs.hiding": set(),
    "envs.task": {"rewards.spec"},
    "envs.curriculum": {"rewards.layers"},
    "envs.engine": {"envs.task"},
    "envs.single": {"envs.engine", "envs.tasks.catalogue", "rewards.spec"},
    "envs.batched": {"envs.engine", "envs.single", "rewards.spec"},
    "envs.vector": {"envs.engine", "envs.tasks.catalogue", "rewards.spec"},
    "envs.tasks.__init__": set(),
    "envs.tasks.catalogue": {"envs.task"},
    "envs.tasks.geometry": set(),
    "envs.tasks.ranges": set(),
    "envs.tasks.humanoid": {
        "envs.task",
        "envs.tasks.geometry",
        "envs.tasks.ranges",
        "rewards.spec",
    },
    "envs.tasks.throwing": {
        "envs.task",
        "envs.tasks.geometry",
        "envs.tasks.ranges",
        "rewards.spec",
    },
    "envs.tasks.planar": {"envs.task", "rewards.decomposition", "rewards.spec"},
    "envs.tasks.planar_mo": {
        "envs.task",
        "envs.tasks.geometry",
        "envs.tasks.planar",
        "envs.tasks.ranges",
        "rewards.spec",
    },
    "envs.tasks.quadcopter": {"envs.task", "envs.tasks.geometry", "rewards.spec"},
    "envs.tasks.reach": {"envs.task", "envs.tasks.geometry", "rewards.spec"},
    "envs.tasks.locomanip": {
        "envs.task",
        "envs.tasks.geometry",
        "envs.tasks.locomanip_model",
        "envs.tasks.locomanip_terms",
        "rewards.spec",
    },
    "envs.tasks.locomanip_model": {"envs.task"},
    "envs.tasks.locomanip_terms": {"envs.task"},
    "simulators.__init__": set(),
    "simulators.envpool": {"rewards.spec"},
    "simulators.manager_spaces": set(),
    "simulators.manager_terms": {"rewards.spec", "simulators.manager_spaces"},
    "simulators.managers": {
        "rewards.spec",
        "simulators.manager_spaces",
        "simulators.manager_terms",
    },
    "simulators.envpool_gym": {"rewards.spec", "simulators.envpool"},
    "study.__init__": set(),
    "study.__main__": {"study.__init__"},
    "study.cells": {
        "gcrppo",
        "multi_head",
        "recurrent.__init__",
        "update",
        "resolvers",
        "rewards.reading",
        "rewards.spec",
        "study.environments",
        "study.manifest",
        "study.methods",
        "study.provenance",
        "study.settings",
        "study.store",
        "study.watching",
    },
    "study.commands": {
        "logs.shown",
        "study.__init__",
        "study.cells",
        "study.costs",
        "study.engines",
        "study.folders",
        "study.manifest",
        "study.probe",
        "study.runner",
        "study.store",
    },
    "study.compare": {
        "rewards.decomposition",
        "study.costs",
        "study.manifest",
        "study.methods",
        "study.settings",
    },
    "study.costs": {"study.manifest"},
    "study.engines": {"study.cells", "study.manifest", "study.store"},
    "study.environments": {
        "envs.__init__",
        "rewards.decomposition",
        "rewards.spec",
        "simulators.envpool_gym",
    },
    "study.folders": {"study.manifest", "study.provenance", "study.store"},
    "study.configurations": {"study.store"},
    "study.reading": {"study.configurations", "study.settings"},
    "study.manifest": {"study.configurations", "study.methods", "study.reading"},
    "study.methods": {"rewards.spec"},
    "study.probe": {"logs.shown", "rewards.spec", "rewards.sums", "study.environments"},
    "study.process": {"study.cells", "study.store"},
    "study.provenance": set(),
    "study.runner": {
        "study.__init__",
        "study.costs",
        "study.engines",
        "study.manifest",
        "study.store",
    },
    "study.settings": set(),
    "study.store": set(),
    "study.watching": {"angles", "resolvers"},
    "study.paper": {"study.statistics.__init__"},
    "study.collected": {"study.store"},
    "study.contrasts": {"study.statistics.__init__"},
    "study.words": {"study.contrasts"},
    "study.tables": {"study.contrasts", "study.store"},
    "study.scores": {"study.statistics.__init__", "study.tables"},
    "study.rules": {
        "study.contrasts",
        "study.scores",
        "study.statistics.__init__",
        "study.tables",
        "study.words",
    },
    "study.hypotheses": {
        "study.__init__",
        "study.contrasts",
        "study.scores",
        "study.statistics.__init__",
        "study.store",
        "study.tables",
    },
    "study.registration": {"study.collected"},
    "study.answers": {"study.contrasts", "study.hypotheses", "study.words"},
    "study.frames": {"study.collected", "study.store"},
    "study.conclusions": {
        "study.__init__",
        "study.collected",
        "study.contrasts",
        "study.frames",
        "study.hypotheses",
        "study.registration",
        "study.scores",
        "study.tables",
        "study.words",
    },
    "study.drawing": set(),
    "study.page": {"study.drawing"},
    "study.figures": {
        "study.contrasts",
        "study.drawing",
        "study.statistics.__init__",
        "study.words",
    },
    "study.sections": {
        "study.__init__",
        "study.collected",
        "study.conclusions",
        "study.contrasts",
        "study.frames",
        "study.page",
        "study.words",
    },
    "study.detail_sections": {
        "rewards.spec",
        "study.__init__",
        "study.collected",
        "study.conclusions",
        "study.frames",
        "study.page",
        "study.sections",
        "study.store",
        "study.words",
    },
    "study.paper_tables": {
        "study.__init__",
        "study.contrasts",
        "study.statistics.__init__",
        "study.tables",
    },
    "study.paper_figures": {"study.drawing", "study.paper_tables"},
    "study.paper_sections": {
        "study.__init__",
        "study.collected",
        "study.conclusions",
        "study.frames",
        "study.page",
        "study.sections",
        "study.store",
        "study.words",
    },
    "study.report": {
        "study.__init__",
        "study.collected",
        "study.conclusions",
        "study.drawing",
        "study.frames",
        "study.page",
    },
    "study.statistics.__init__": {
        "study.statistics.bootstrap",
        "study.statistics.counts",
        "study.statistics.intervals",
        "study.statistics.permutation",
        "study.statistics.relation",
        "study.statistics.scores",
    },
    "study.statistics.bootstrap": {"study.statistics.checks"},
    "study.statistics.checks": set(),
    "study.statistics.counts": {"study.statistics.checks"},
    "study.statistics.intervals": {"study.statistics.checks"},
    "study.statistics.permutation": {"study.statistics.checks"},
    "study.statistics.relation": {"study.statistics.checks"},
    "study.statistics.scores": {"study.statistics.checks"},
}
#: Packages that the pure modules do without.
FORBIDDEN = {
    "advantages": {"torch", "stable_baselines3"},
    "averaging": {"torch", "stable_baselines3"},
    "conflicts.estimators": {"torch", "stable_baselines3"},
    "conflicts.blocks": {"torch", "stable_baselines3"},
    "resolvers": {"stable_baselines3"},
    "losses": {"stable_baselines3"},
    "envs.task": {"torch", "stable_baselines3"},
    "envs.tasks.humanoid": {"torch", "stable_baselines3"},
    "envs.tasks.planar": {"torch", "stable_baselines3"},
    "envs.tasks.planar_mo": {"torch", "stable_baselines3"},
    "envs.tasks.quadcopter": {"torch", "stable_baselines3"},
    "envs.tasks.reach": {"torch", "stable_baselines3"},
    "envs.tasks.locomanip": {"torch", "stable_baselines3"},
    "envs.tasks.locomanip_model": {"torch", "stable_baselines3"},
    "envs.tasks.locomanip_terms": {"torch", "stable_baselines3"},
    "envs.tasks.throwing": {"torch", "stable_baselines3"},
    "envs.engine": {"torch", "stable_baselines3"},
    "study.paper": {"torch", "stable_baselines3"},
    "study.answers": {"torch", "stable_baselines3", "pandas", "matplotlib"},
    "study.contrasts": {"torch", "stable_baselines3", "pandas", "matplotlib"},
    "study.words": {"torch", "stable_baselines3", "pandas", "matplotlib"},
    "study.statistics.bootstrap": {"torch", "stable_baselines3"},
    "study.statistics.counts": {"torch", "stable_baselines3"},
    "study.statistics.intervals": {"torch", "stable_baselines3"},
    "study.statistics.permutation": {"torch", "stable_baselines3"},
    "study.statistics.relation": {"torch", "stable_baselines3"},
    "study.statistics.scores": {"torch", "stable_baselines3"},
}
MODULES = {
    ".".join(path.relative_to(ROOT / "sb3_gcr").with_suffix("").parts): path
    for path in sorted((ROOT / "sb3_gcr").rglob("*.py"))
}


def imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
        elif isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
    return found


@pytest.mark.parametrize("name", MODULES)
def test_imports_point_one_way(name: str) -> None:
    modules = imports(MODULES[name])
    ours = {module.removeprefix("sb3_gcr.") for module in modules if module.startswith("sb3_gcr.")}
    named = {f"{module}.__init__" if f"{module}.__init__" in MODULES else module for module in ours}
    assert named <= ARROWS[name], f"extend ARROWS[{name!r}] in {__file__} if the map allows it"
    assert not {module.split(".")[0] for module in modules} & FORBIDDEN.get(name, set())


def test_users_of_the_package_take_the_public_way() -> None:
    for folder in ("examples", "benchmarks"):
        for path in (ROOT / folder).glob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sb3_gcr"):
                    assert not [alias.name for alias in node.names if alias.name.startswith("_")]


def test_every_public_name_exists_and_is_documented() -> None:
    for name in sb3_gcr.__all__:
        assert getattr(sb3_gcr, name).__doc__


def test_import_is_silent() -> None:
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", "import sb3_gcr"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stdout == result.stderr == ""


def test_the_lines_of_the_readme_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every Python block, in one namespace, with a smaller budget."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    assert blocks
    if importlib.util.find_spec("mujoco.batch") is None:  # the batched envs need MuJoCo 4.0
        blocks = [block for block in blocks if "sb3_gcr.envs" not in block]
    monkeypatch.chdir(tmp_path)
    code = "\n".join(blocks).replace("250_000", "4_096")
    namespace: dict[str, object] = {}
    exec(compile(code, "README.md", "exec"), namespace)
    namespace["model"].logger.close()  # type: ignore[attr-defined]
    written = {path.name for path in (tmp_path / "logs/humanoid").iterdir()}
    assert {
        "model.zip",
        "progress.csv",
        "cosines.csv",
        "returns.png",
        "cosines.png",
        "conflicts.png",
    } <= written


def test_yaml_files_parse_and_the_version_is_one() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == sb3_gcr.__version__
    assert f"## {sb3_gcr.__version__}" in (ROOT / "CHANGELOG.md").read_text()
    assert yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]


def test_make_lists_its_commands_and_refuses_without_python(tmp_path: Path) -> None:
    listed = subprocess.run(
        ["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    for command in ("train", "test", "check", "format", "bench"):
        assert f"make {command}" in listed
    missing = subprocess.run(
        ["make", "install", "PYTHON=no-such-python", f"VENV={tmp_path}/none"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert missing.returncode != 0
    assert "sb3_gcr needs Python 3.10 or newer: 'no-such-python' was not found." in missing.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env", "CartPole-v1"], "Parameter `components` must be given for 'CartPole-v1'"),
        (["--env", "No-v0"], "doesn't exist"),
        (["--resolver", "best"], "invalid choice: 'best'"),
        (["--timesteps", "many"], "invalid int value: 'many'"),
    ],
)
def test_train_says_what_is_wrong(arguments: list[str], message: str, tmp_path: Path) -> None:
    command = [
        sys.executable,
        str(ROOT / "examples/train.py"),
        "--folder",
        str(tmp_path),
        *arguments,
    ]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 2
    assert message in result.stderr
    assert "Traceback" not in result.stderr
    assert not list(tmp_path.iterdir())

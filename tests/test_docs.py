"""The documentation: its Python blocks run, its links lead somewhere, and nothing public goes
unexplained.
"""

from __future__ import annotations

import ast
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.logger import configure

import sb3_gcr
from examples.humanoid_table import END, RESULTS, START, markdown, rows_of, stored
from sb3_gcr import GCRPPO
from tests.envs import Env

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.glob("*.md"))
#: What the blocks of a page need beyond the core.
NEEDS = {
    "quickstart": ["pandas", "matplotlib", "tensorboard"],
    "logs": ["pandas", "matplotlib"],
    "resolvers": ["torchjd"],
    "tasks": ["mujoco.batch", "envpool"],
    "deployment": ["onnxscript", "onnxruntime"],
}
#: Pages whose blocks other tests run, or that show scripts.
ELSEWHERE = {"saving", "rl_zoo3", "simulators"}
#: A Python block, and the error or warning that follows it, if it is there to fail.
BLOCK = re.compile(
    r"^```python\n(.*?)^```\n(?:\n^```text\n(\w+(?:Error|Warning)): (.*?)\n^```)?", re.S | re.M
)
KEY = re.compile(r"(?:gcr|train|rollout|time|curriculum)/[\w/]+")


def blocks(page: Path) -> list[tuple[str, str, str]]:
    return BLOCK.findall(page.read_text(encoding="utf-8"))


def anchors(page: Path) -> set[str]:
    """The names that GitHub and MyST give to headings."""
    headings = re.findall(
        r"^#+ (.*)$",
        re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.S | re.M),
        re.M,
    )
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.filterwarnings(
    "ignore:::torch", "ignore:::onnxscript", "ignore:`isinstance:FutureWarning"
)
@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if blocks(page) and page.stem not in ELSEWHERE],
    ids=lambda p: p.stem,
)
def test_the_blocks_of_a_page_run(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In one namespace, with a rollout or two and short updates; what stands before an error must
    raise it, … is anything.
    """
    for module in NEEDS.get(page.stem, []):
        pytest.importorskip(module)
    learn, n_rollouts = GCRPPO.learn, 2 if "write_report" in page.read_text(encoding="utf-8") else 1

    learned: list[GCRPPO] = []

    def learn_a_little(self: GCRPPO, total_timesteps: int, *args: Any, **kwargs: Any) -> GCRPPO:
        self.n_epochs = 1
        learned.append(self)
        return learn(
            self, min(total_timesteps, n_rollouts * self.n_steps * self.n_envs), *args, **kwargs
        )

    monkeypatch.setattr(GCRPPO, "learn", learn_a_little)
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, Any] = {"__name__": page.stem}
    for code, kind, message in blocks(page):
        compiled = compile(code, page.name, "exec")
        if not kind:
            exec(compiled, namespace)
            continue
        expected = "^" + re.escape(" ".join(message.split())).replace("…", ".*") + "$"
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            with pytest.raises((Exception, Warning), match=expected) as error:
                exec(compiled, namespace)
        assert error.type.__name__ == kind
    for model in learned:  # with their loggers, which would otherwise be collected with open files
        if hasattr(model, "_logger"):
            model.logger.close()


@pytest.mark.parametrize(
    "page", [*PAGES, ROOT / "README.md", ROOT / "CHANGELOG.md"], ids=lambda p: p.name
)
def test_links_lead_somewhere(page: Path) -> None:
    prose = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.S | re.M)
    for link in re.findall(r"\]\(([^)\s]+)\)", prose):
        if link.startswith(("http://", "https://")):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), f"{page.name} links to {link}"
        if anchor:
            assert anchor in anchors(target), (
                f"{page.name} links to {link}, found {sorted(anchors(target))}"
            )


def test_every_page_and_picture_is_in_the_site() -> None:
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    listed = {
        re.sub(r".*<(.*)>", r"\1", line)
        for tree in re.findall(r"^```\{toctree\}\n(.*?)^```", index, re.S | re.M)
        for line in tree.splitlines()
        if line and not line.startswith(":")
    }
    assert listed == {page.stem for page in [*PAGES, *DOCS.glob("*.rst")]} - {"index"}
    shown = set(
        re.findall(
            r"images/([\w.-]+)",
            "".join(page.read_text(encoding="utf-8") for page in [*PAGES, ROOT / "README.md"]),
        )
    )
    assert shown == {picture.name for picture in (DOCS / "images").iterdir()}


def test_every_public_name_is_in_the_api() -> None:
    api = (DOCS / "api.rst").read_text(encoding="utf-8")
    for name in sb3_gcr.__all__:
        assert re.search(rf"(?:auto\w+|py:\w+):: sb3_gcr\.{name}\s", api), name


def explained() -> str:
    return (DOCS / "logs.md").read_text(encoding="utf-8")


def test_every_key_in_the_source_is_explained() -> None:
    text = explained()
    for path in sorted((ROOT / "sb3_gcr").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if (
                isinstance(node, ast.Constant)
                and isinstance(node.value, str)
                and KEY.fullmatch(node.value)
            ):
                key = node.value + ("<name>" if node.value.endswith("/") else "")
                assert f"`{key}`" in text or f"`{key}/<name>`" in text, f"{key} of {path.name}"


def test_every_key_of_a_run_is_explained(tmp_path: Path) -> None:
    model = GCRPPO("MlpPolicy", Env(), n_steps=64, desired_kl=0.01, clip_range_vf=1.0, device="cpu")
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(128)
    model.logger.close()
    header = np.loadtxt(tmp_path / "progress.csv", dtype=str, delimiter=",", max_rows=1)
    names = "|".join(model.reward_spec.names)
    keys = {re.sub(rf"/(?:{names})$", "/<name>", key) for key in header}
    assert [key for key in sorted(keys) if f"`{key}`" not in explained()] == []
    told = {
        re.sub(r"/reward_\w+$", "/<name>", key)
        for key in re.findall(r"`((?:gcr|train)/[\w/<>]+)`", explained())
    }
    assert told - keys == {"gcr/cosines"}  # a picture, for TensorBoard alone


def test_the_results_are_those_of_the_runs() -> None:
    """The tables of results.md are what ``examples/humanoid_table.py`` makes of the stored runs."""
    page = (DOCS / "results.md").read_text(encoding="utf-8")
    _, start, rest = page.partition(START)
    shown, end, _ = rest.partition(END)
    assert start
    assert end
    expected = markdown(rows_of(stored(RESULTS)))
    assert shown.strip() == expected, "run examples/humanoid_table.py --write"

"""``sb3-gcr-zoo components``: what find_components finds, from a shell."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from sb3_gcr import find_components
from sb3_gcr.zoo.commands import main
from tests.stand_ins import Merge

ROBOT = """
import tests.stand_ins

class Robot(tests.stand_ins.MetaWorld): ...

def make():
    return Robot()

def nothing():
    return 3
"""


def test_an_env_of_ones_own_and_one_of_gymnasium(capsys: pytest.CaptureFixture[str]) -> None:
    main(["components", "--env", "tests.stand_ins:Merge", "--n-steps", "50", "--seed", "3"])
    assert capsys.readouterr().out == f"{find_components(Merge(), 50, 3)}\n"
    main(["components", "--env", "HalfCheetah-v5", "--n-steps", "20"])
    assert capsys.readouterr().out.endswith("\n\nenv = RewardDecomposition(env)\n")


def test_a_module_in_the_current_folder(tmp_path: Path) -> None:
    (tmp_path / "my_robot.py").write_text(ROBOT)
    root = Path(__file__).parents[1]
    code = f"import sys; sys.path.append({str(root)!r}); from sb3_gcr.zoo import main; main()"
    for name in ("Robot", "make"):
        command = [sys.executable, "-P", "-c", code, "components", "--env", f"my_robot:{name}"]
        result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        assert "weights=5)  # levels are guesses" in result.stdout


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--env", "No-v0"], "Environment `No` doesn't exist."),
        (["--env", "tests.stand_ins:No"], "Module 'tests.stand_ins' has no 'No'."),
        (["--env", "no_such_module:Robot"], "No module named 'no_such_module'"),
        (
            ["--env", "tests.stand_ins:gym"],
            "'tests.stand_ins:gym' must be a class or function that makes an env, found a module.",
        ),
        (
            ["--env", "tests.stand_ins:Merge", "--n-steps", "1"],
            "Parameter `n_steps` must be an integer ≥ 10, found 1.",
        ),
    ],
)
def test_what_cannot_be_looked_at(
    options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(["components", *options])
    assert end.value.code == 2
    assert message in capsys.readouterr().err

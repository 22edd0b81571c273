"""Check the wheel and the sdist in dist/: what they contain, and that each works in an empty
environment (``make build``).
"""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import tempfile
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
#: What the sdist has beside the package, its settings and its metadata.
SDIST_EXTRAS = {
    "CHANGELOG.md",
    "CITATION.cff",
    "LICENSE",
    "MANIFEST.in",
    "README.md",
    "pyproject.toml",
    "setup.cfg",
}
#: Trains, saves and loads, finds the data files of the package, and makes an env of ours where
#: MuJoCo has its batches.
SMOKE = """
import importlib.util, warnings
import gymnasium as gym
import sb3_gcr
from importlib.resources import files
from sb3_gcr import GCRPPO, RewardDecomposition
env = RewardDecomposition(gym.make("HalfCheetah-v5"))
model = GCRPPO("MlpPolicy", env, n_steps=250, batch_size=125, n_epochs=2, device="cpu").learn(1000)
model.save("model")
assert GCRPPO.load("model", env=env, device="cpu").n_components == 2
assert (files("sb3_gcr.hyperparams") / "gcrppo.yml").is_file()
assert (files("sb3_gcr") / "py.typed").is_file()
if importlib.util.find_spec("mujoco.batch"):
    gym.make("sb3_gcr/ThrowingMO-v0").reset(seed=0)
print("works:", sb3_gcr.__version__, sb3_gcr.__file__)
"""


def tracked() -> set[str]:
    """The package's files that git knows, by the path that they have when installed."""
    listed = subprocess.run(
        ["git", "ls-files", "sb3_gcr", "hyperparams"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return {
        path if path.startswith("sb3_gcr/") else f"sb3_gcr/{path}"
        for path in listed.stdout.splitlines()
    }


def check_contents(wheel: Path, sdist: Path) -> None:
    """The wheel is the package and its metadata; the sdist has what is needed to build it, and
    nothing else.
    """
    with zipfile.ZipFile(wheel) as archive:
        inside = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert inside == tracked(), f"the wheel differs from git: {sorted(inside ^ tracked())}"
    with tarfile.open(sdist) as archive:
        names = {member.name.split("/", 1)[1] for member in archive.getmembers() if member.isfile()}
    strays = {
        name
        for name in names - SDIST_EXTRAS
        if not name.startswith(("sb3_gcr/", "hyperparams/", "sb3_gcr.egg-info/"))
        and name != "PKG-INFO"
    }
    assert not strays, f"the sdist has strays: {sorted(strays)}"
    assert names >= SDIST_EXTRAS, f"the sdist lacks {sorted(SDIST_EXTRAS - names)}"
    print(f"{wheel.name}: {len(inside)} files, {sdist.name}: {len(names)} files")


def smoke_test(distribution: Path) -> None:
    """Install into an empty environment, and use it from an empty folder."""
    with tempfile.TemporaryDirectory() as folder:
        venv.create(Path(folder) / "env", with_pip=True)
        python = str(Path(folder) / "env" / ("Scripts" if os.name == "nt" else "bin") / "python")
        install = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        subprocess.run(
            [*install, "-c", str(ROOT / "constraints.txt"), str(distribution)], check=True
        )
        result = subprocess.run(
            [python, "-W", "error", "-c", SMOKE], cwd=folder, capture_output=True, text=True
        )
        if result.returncode:
            sys.exit(f"{distribution.name} does not work:\n{result.stderr}")
        print(f"{distribution.name} {result.stdout.splitlines()[-1]}")


def main() -> None:
    """Check the one wheel and the one sdist in dist/."""
    (wheel,), (sdist,) = (
        sorted((ROOT / "dist").glob(pattern)) for pattern in ("*.whl", "*.tar.gz")
    )
    check_contents(wheel, sdist)
    for distribution in (wheel, sdist):
        smoke_test(distribution)


if __name__ == "__main__":
    main()

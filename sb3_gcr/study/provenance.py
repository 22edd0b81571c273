"""Under which circumstances a cell ran."""

from __future__ import annotations

import hashlib
import platform
import subprocess
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import sb3_gcr

PACKAGE = Path(sb3_gcr.__file__).parent
#: Modules that decide no numbers of a cell.
SHOWING = ("logs", "saving", "zoo", "study")
#: Modules of the study that decide numbers.
DECIDING = ("cells", "environments", "methods", "settings", "watching")
#: Packages whose versions are kept.
PACKAGES = (
    "sb3_gcr",
    "stable-baselines3",
    "gymnasium",
    "torch",
    "numpy",
    "scipy",
    "mujoco",
    "envpool",
)


def provenance(started: float, threads: int) -> dict[str, Any]:
    """Revision, versions and machine.

    :param started: seconds since the epoch
    :param threads: of the cell
    """
    return {
        "git": git("rev-parse", "HEAD"),
        "dirty": bool(git("status", "--porcelain", "--untracked-files=no", "--", ".")),
        "digest": digest(),
        "versions": versions(),
        "cpu": cpu(),
        "threads": threads,
        "started": _iso(started),
        "finished": _iso(time.time()),
    }


def git(*arguments: str) -> str | None:
    """What git says of the package's folder; None where it is no checkout.

    :param arguments: of git
    """
    command = ["git", "-C", str(PACKAGE), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=20)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def digest() -> str:
    """12 hex digits of the modules and assets that decide the numbers of a cell."""
    paths = [path for path in PACKAGE.rglob("*") if path.suffix in (".py", ".xml")]
    total = hashlib.sha256()
    for path in sorted(paths):
        room = path.relative_to(PACKAGE).parts[0]
        if room not in SHOWING or (room == "study" and path.stem in DECIDING):
            total.update(path.relative_to(PACKAGE).as_posix().encode())
            total.update(path.read_bytes())
    return total.hexdigest()[:12]


def versions() -> dict[str, str]:
    """Of Python and of the packages that are installed."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def cpu() -> str:
    """The processor's name."""
    path = Path("/proc/cpuinfo")
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _iso(seconds: float) -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(seconds))

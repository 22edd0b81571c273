"""Print the exact lower bounds of the dependencies as pip constraints: ``make lower`` tests with
them.

torch is left as in constraints.txt, because its old releases come with gigabytes of CUDA.
"""

from __future__ import annotations

import configparser
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
#: Extras that the tests of the core need.
EXTRAS = ("plots",)


def lower_bounds() -> list[str]:
    """One constraint per dependency of the core and of ``EXTRAS``."""
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    requirements = [
        config["options"]["install_requires"],
        *(config["options.extras_require"][name] for name in EXTRAS),
    ]
    found = re.findall(r"^([\w-]+)(?:\[\w+\])?>=([\d.]+)", "\n".join(requirements), re.M)
    torch = re.findall(r"^torch==.*$", (ROOT / "constraints.txt").read_text(), re.M)
    return [*(f"{name}=={version}" for name, version in found if name != "torch"), *torch]


if __name__ == "__main__":
    print("\n".join(lower_bounds()))

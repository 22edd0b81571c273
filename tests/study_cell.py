"""A cell that takes a tenth of a second; the runner starts it in place of a training."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
spec = importlib.util.spec_from_file_location("process", ROOT / "sb3_gcr/study/process.py")
assert spec is not None
assert spec.loader is not None
process = importlib.util.module_from_spec(spec)
spec.loader.exec_module(process)  # without PyTorch, which takes seconds to import

request = process.read_request(sys.stdin)
folder = Path(request["folder"])
cell = request["cell"]
cell_id = f"{cell['method']}-{cell['seed']}"
seed = cell["seed"]


def note(word: str) -> None:
    """One line in a diary that all cells share; appending it is atomic."""
    with (folder / "diary.txt").open("a") as file:
        file.write(f"{word} {cell_id}\n")


note("begin")
sys.stdout.write(f"cell {cell_id} has begun\n")
sys.stdout.flush()
time.sleep(0.1)
if cell["env_kwargs"].get("fate") == "raise" and cell["method"] == "gcr":
    sys.exit("RuntimeError: the robot is gone")
if cell["env_kwargs"].get("fate") == "crash" and cell["method"] == "gcr":
    os.abort()
if cell["env_kwargs"].get("fate") == "hang" and cell["method"] == "gcr":
    time.sleep(1000)
target = folder / "cells" / request["id"] / "result.json"
scalars = {"wall_s": 0.1, "return_training": 10.0 * seed + len(cell["method"])}
text = json.dumps({"schema": 1, "id": request["id"], "cell": cell, "scalars": scalars})
temporary = target.with_name(f"result.{os.getpid()}.tmp")
for part in (text[:40], text[40:]):  # slowly, so that a kill finds it half-written
    with temporary.open("a") as file:
        file.write(part)
    time.sleep(0.02)
temporary.replace(target)
note("end")

"""How long cells take: measured where there are results, else from a table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from statistics import median
from typing import Any

from sb3_gcr.study.manifest import Cell

#: Env steps a second on one core of a loaded machine, training included, by part of the env's name;
#: the first that fits counts.
RATES = {
    "Reacher": 7700,
    "HalfCheetah": 5400,
    "Swimmer": 5900,
    "Pusher": 4700,
    "PandaOpenCabinet": 4200,
    "Hopper": 4000,
    "HumanoidRun": 3500,
    "Walker2d": 3100,
    "HumanoidMO": 3100,
    "PandaPick": 2800,
    "HumanoidStandup": 1200,
    "Humanoid": 1500,
    "Ant": 2100,
    "ThrowingMO": 2100,
    "Go1JoystickFlat": 2100,
    "Go1JoystickRough": 1350,
    "H1": 2000,
    "Leap": 1500,
    "G1JoystickFlat": 850,
    "G1JoystickRough": 600,
}
#: For all others.
RATE = 1500
#: Seconds that a cell takes besides: its start, and episodes of evaluation.
OVERHEAD = 20.0


def estimate(cell: Cell) -> float:
    """Seconds that a cell takes by the table.

    :param cell: any
    """
    name = cell.task.env.rsplit("/", 1)[-1]
    rate = next((rate for part, rate in RATES.items() if part in name), RATE)
    return OVERHEAD + cell.task.timesteps / rate


class Costs:
    """What the cells of a study take, better known with each one that ends.

    :param results: contents of ``result.json`` so far
    """

    def __init__(self, results: Iterable[Mapping[str, Any]] = ()):
        self._measured: dict[tuple[str, int], list[float]] = {}
        for result in results:
            self.add(result)

    def add(self, result: Mapping[str, Any]) -> None:
        """Learn from a result.

        :param result: content of ``result.json``
        """
        cell = result["cell"]
        key = (cell["env"], cell["timesteps"])
        self._measured.setdefault(key, []).append(result["scalars"]["wall_s"])

    def seconds(self, cell: Cell) -> float:
        """Expected for a cell.

        :param cell: any
        """
        found = self._measured.get((cell.task.env, cell.task.timesteps))
        return median(found) if found else estimate(cell)

"""``sb3-gcr-study``: compare methods on one env, or run a study from a manifest."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

DESCRIPTION = (
    "Does resolving conflicts help on my reward? `compare` answers; the other commands run a study "
    "from a YAML manifest, or from one of sb3_gcr by its name, such as `smoke`."
)


def make_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser("sb3-gcr-study", description=DESCRIPTION)
    commands = parser.add_subparsers(dest="command", required=True)
    compare = commands.add_parser("compare", help="train, compare, answer")
    _add_compare(compare)
    _add_running(compare)
    helps = {
        "plan": "cells and minutes",
        "run": "run the cells, or go on",
        "status": "what is done",
        "report": "tables, pictures and the answer; runs nothing",
        "cell": "one cell in the foreground",
        "sbatch": "print a script for SLURM",
    }
    for name, text in helps.items():
        command = commands.add_parser(name, help=text)
        command.add_argument("manifest", help="YAML file, or a name such as smoke")
        command.add_argument("--out", metavar="FOLDER", help="(default: results/NAME)")
        if name == "run":
            _add_running(command)
        if name in ("cell", "sbatch"):
            command.add_argument("--threads", type=_count, default=1, help="of each cell")
        if name == "cell":
            command.add_argument("id", help="12 hex digits")
        if name == "sbatch":
            command.add_argument("--array", type=_count, help="runners (default: one a block)")
        if name == "plan":
            command.add_argument("--cells", action="store_true", help="list their ids")
    return parser


def _add_compare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--env", required=True, help="id of Gymnasium, sb3_gcr/…, envpool/…, or module:Class"
    )
    parser.add_argument("--methods", nargs="+", default=["ppo", "gcrppo"])
    parser.add_argument("--timesteps", type=_count, default=500_000)
    parser.add_argument("--seeds", type=_count, default=5, help="how many")
    parser.add_argument("--out", required=True, metavar="FOLDER")
    parser.add_argument("--yes", action="store_true", help="begin without asking")
    for name, text in {
        "components": "level of each term by info key: speed=task torque=regulariser",
        "env-kwargs": "arguments of the env",
        "settings": "settings that differ, for all methods: learning_rate=1e-3 n_envs=16",
    }.items():
        parser.add_argument(f"--{name}", nargs="+", default=[], metavar="NAME=VALUE", help=text)
    parser.add_argument(
        "--residual", metavar="NAME", help="term for the rest of the reward; NAME=regulariser too"
    )


def _add_running(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--jobs", type=_count, default=1, help="cells at the same time")
    parser.add_argument("--threads", type=_count, default=1, help="of each cell")
    parser.add_argument("--hours", type=float, help="nothing begins that cannot end within")
    parser.add_argument("--minutes", type=float, help="a cell that takes longer has failed")
    parser.add_argument("--shard", metavar="K/N", help="every N-th block, from the K-th on")
    parser.add_argument(
        "--reuse", nargs="+", default=[], metavar="FOLDER", help="take over equal cells of studies"
    )
    parser.add_argument("--engine", choices=["local", "ray"], default="local")
    parser.add_argument("--address", help="of a Ray cluster, such as auto")


def _count(text: str) -> int:
    """A whole number above 0; 500_000 and 5e5 too."""
    try:
        value = float(text)
    except ValueError:
        value = 0
    if value < 1 or value != int(value):
        raise argparse.ArgumentTypeError(f"must be a whole number above 0, found {text!r}")
    return int(value)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; 0 is good, 1 means that cells have failed, 2 that nothing ran.

    :param arguments: of the command line; None takes them from there
    """
    options = make_parser().parse_args(arguments)
    try:
        from sb3_gcr.study import commands

        code: int = getattr(commands, options.command)(options)
    except (ValueError, TypeError, ImportError, FileNotFoundError) as error:
        sys.stderr.write(f"sb3-gcr-study {options.command}: {error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("\nInterrupted. The same command goes on from here.\n")
        return 130
    return code


if __name__ == "__main__":
    sys.exit(main())

"""Reading the entries of a manifest, and refusing wrong ones in a sentence."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sb3_gcr.study.configurations import Fields, Task, draw_configurations
from sb3_gcr.study.settings import check_names, check_settings

#: First seed of each purpose, and the first that is too large.
SEEDS = {"study": (0, 1000), "pilot": (1000, 2000), "tuning": (2000, 1_000_000)}
#: No tuning sees envs whose name begins so, nor objectives of an env.
HELD_OUT = (
    "Ant",
    "Swimmer",
    "Pusher",
    "Reacher",
    "Hopper",
    "PandaOpenCabinet",
    "PandaPickCube",
    "H1",
    "Go1",
    "G1",
    "LeapCube",
)
TASK_KEYS = {
    "env",
    "timesteps",
    "env_kwargs",
    "components",
    "residual",
    "settings",
    "variants",
    "draw",
}
HYPOTHESIS_KEYS = {"claim", "contrast", "metric", "unit", "supported", "refuted"}


def read_tasks(given: Any, shared: Fields) -> Iterator[Task]:
    """Configurations of the tasks, which are a mapping in a file and a list where written out.

    :param given: by name, or written out
    :param shared: settings of all tasks
    :raises ValueError: for unknown and missing entries
    """
    check_names(shared, "The manifest")
    if isinstance(given, list):
        given = {task["name"]: {k: v for k, v in task.items() if k != "name"} for task in given}
    if not isinstance(given, Mapping) or not given:
        raise ValueError(f"`tasks` must map names to tasks, found {given!r}.")
    for name, task in given.items():
        where = f"Task '{name}'"
        check_keys(task, TASK_KEYS, {"env", "timesteps"}, where)
        for label, env_kwargs, own in _variants(name, task):
            settings = {**shared, **(task.get("settings") or {}), **own}
            yield Task(
                name=label,
                env=task["env"],
                env_kwargs=env_kwargs,
                components=task.get("components"),
                residual=task.get("residual"),
                settings=check_settings(settings, where),
                timesteps=int(positive(task["timesteps"], f"{where}: `timesteps`")),
            )


def _variants(name: str, task: Fields) -> Iterator[tuple[str, dict[str, Any], Fields]]:
    """Name, arguments and own settings of each drawn configuration in each variant."""
    drawn: list[dict[str, Any]] = [{}]
    if task.get("draw"):
        drawn = draw_configurations(**task["draw"])
    for configuration in drawn:
        active = [f"{key}={value}" for key, value in configuration.items() if value is not None]
        for variant, changes in (task.get("variants") or {"": {}}).items():
            label = " ".join([name, *active, *([variant] if variant else [])])
            env_kwargs = {**(task.get("env_kwargs") or {}), **configuration}
            yield (
                label,
                {**env_kwargs, **(changes.get("env_kwargs") or {})},
                (changes.get("settings") or {}),
            )


def read_seeds(given: Any, purpose: str, name: str) -> tuple[int, ...]:
    """Seeds of a number or a list, inside the range of the purpose.

    :param given: number or list
    :param purpose: of the manifest
    :param name: of the study
    :raises ValueError: for an unknown purpose and for seeds of another one
    """
    if purpose not in SEEDS:
        raise ValueError(
            f"Study '{name}': `purpose` must be one of {list(SEEDS)}, found {purpose!r}."
        )
    first, end = SEEDS[purpose]
    seeds = tuple(range(first, first + given)) if isinstance(given, int) else tuple(given)
    wrong = [seed for seed in seeds if not isinstance(seed, int) or not first <= seed < end]
    if wrong or not seeds or len(set(seeds)) < len(seeds):
        raise ValueError(
            f"Study '{name}': `seeds` must be a number or distinct seeds from {first} to "
            f"{end - 1}, those of a {purpose}, found {given!r}."
        )
    return seeds


def read_hypotheses(given: Fields, methods: Sequence[str]) -> Fields:
    """Hypotheses by name, as they are.

    :param given: by name
    :param methods: of the study
    :raises ValueError: for missing entries and for methods that the study does not have
    """
    for name, hypothesis in given.items():
        where = f"Hypothesis '{name}'"
        check_keys(hypothesis, HYPOTHESIS_KEYS, HYPOTHESIS_KEYS, where)
        unknown = [one for one in hypothesis["contrast"] if one not in methods]
        if unknown:
            raise ValueError(
                f"{where}: `contrast` must name methods of the study, {list(methods)}, found "
                f"{unknown}."
            )
    return given


def check_held_out(purpose: str, tasks: Sequence[Task]) -> None:
    """No tuning on what the study is about.

    :param purpose: of the manifest
    :param tasks: its configurations
    :raises ValueError: for a held-out task in a tuning manifest
    """
    if purpose != "tuning":
        return
    for task in tasks:
        name = task.env.rsplit("/", 1)[-1]
        has_objective = "MO-v" in name and any(v is not None for v in task.env_kwargs.values())
        if name.startswith(HELD_OUT) or has_objective:
            raise ValueError(
                f"Task '{task.name}' is held out from tuning: names that begin with "
                f"{list(HELD_OUT)}, and objectives of an MO env."
            )


def check_keys(given: Any, known: set[str], needed: set[str], where: str) -> None:
    """Refuse what is no mapping, keys that nobody knows, and missing ones.

    :param given: of the manifest
    :param known: valid keys
    :param needed: those that must be there
    :param where: for the error
    :raises ValueError: for each of these
    """
    if not isinstance(given, Mapping):
        raise ValueError(f"{where} must map names to values, found {given!r}.")
    unknown = sorted(set(given) - known)
    if unknown:
        raise ValueError(f"{where}: unknown keys {unknown}; valid choices are {sorted(known)}.")
    missing = sorted(needed - set(given))
    if missing:
        raise ValueError(f"{where} lacks {missing}.")


def positive(value: Any, where: str) -> float:
    """A number above 0.

    :param value: of the manifest
    :param where: for the error
    :raises ValueError: for anything else
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
        raise ValueError(f"{where} must be a number above 0, found {value!r}.")
    return value

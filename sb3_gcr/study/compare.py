"""The manifest behind `compare`: one env, some methods, equal settings."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

from sb3_gcr.rewards.decomposition import GYMNASIUM_ENVS
from sb3_gcr.study.costs import estimate
from sb3_gcr.study.manifest import Manifest, expand
from sb3_gcr.study.methods import named, with_heads
from sb3_gcr.study.settings import check_names, settings_of

#: What a report needs, and the smallest scipy.
NEEDED = ("matplotlib", "pandas", "scipy", "yaml")
SCIPY = (1, 15)


def make_manifest(
    env: str,
    methods: Sequence[str],
    timesteps: int,
    seeds: int,
    env_kwargs: Mapping[str, Any],
    components: Mapping[str, Any] | None,
    residual: Mapping[str, Any] | None,
    settings: Mapping[str, Any],
) -> Manifest:
    """A manifest of one task; the heads alone are added where PPO is compared with surgery.

    :param env: id, or ``module:Class``
    :param methods: names
    :param timesteps: of each run
    :param seeds: how many
    :param env_kwargs: arguments of the env
    :param components: levels of terms by info key, or None
    :param residual: name and level of the rest, or None
    :param settings: those that differ from the env's
    :raises ValueError: for what is unknown
    """
    check_names(settings, "--settings")
    if components is None and env in GYMNASIUM_ENVS:  # a cell says what it is made of
        components = GYMNASIUM_ENVS[env]["components"]
        rest = GYMNASIUM_ENVS[env].get("residual")
        residual = residual or ({rest: "task"} if rest else None)
    task = {
        "env": env,
        "env_kwargs": dict(env_kwargs),
        "components": components,
        "residual": residual,
        "timesteps": timesteps,
    }
    content = {
        "name": f"compare {env}",
        "question": f"Does resolving conflicts help on {env}?",
        "methods": with_heads(named(methods)),
        "seeds": seeds,
        "minutes": 60,
        "settings": {**settings_of(env), **settings},
        "tasks": {env: task},
    }
    slowest = max(map(estimate, expand(Manifest.from_dict(content))))
    return Manifest.from_dict({**content, "minutes": max(15, round(6 * slowest / 60))})


def pairs(given: Sequence[str], option: str) -> dict[str, Any]:
    """``name=value`` arguments; values are read as YAML.

    :param given: of the command line
    :param option: for the error
    :raises ValueError: for one without a name or without "="
    """
    found = {}
    for one in given:
        name, equals, value = one.partition("=")
        if not name or not equals:
            raise ValueError(f"{option} takes name=value, found {one!r}.")
        found[name] = _value(value)
    return found


def _value(text: str) -> Any:
    """A YAML value, and 3e-4 too, which YAML reads as a word."""
    import yaml

    try:
        return float(text) if "e" in text.lower() else yaml.safe_load(text)
    except ValueError:
        return yaml.safe_load(text)


def check_extras() -> None:
    """Refuse before anything runs where the report could not be made after it.

    :raises ImportError: if a package is missing or too old
    """
    for name in NEEDED:
        try:
            importlib.import_module(name)
        except ImportError as error:
            raise ImportError(
                f"A report needs {name}: pip install 'sb3_gcr[study]' ({error})"
            ) from error
    found = tuple(int(part) for part in version("scipy").split(".")[:2])
    if found < SCIPY:
        raise ImportError(
            f"A report needs scipy 1.15 or newer, found {version('scipy')}: "
            "pip install 'sb3_gcr[study]'"
        )

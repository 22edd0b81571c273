"""What a model's file holds: SB3's entries, and beside them ``sb3_gcr.json``, which says as much as
plain JSON can.
"""

from __future__ import annotations

import io
import json
import pickle
import zipfile
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.save_util import load_from_zip_file, open_path
from stable_baselines3.common.utils import get_device

from sb3_gcr.rewards.spec import SCALAR_REWARD, RewardSpec
from sb3_gcr.saving.settings import (
    POLICIES,
    collect_settings,
    describe_object,
    describe_settings,
    describe_space,
    find_differences,
    parse_settings,
    to_plain,
)
from sb3_gcr.saving.statistics import describe_statistics

#: The entry's name; SB3 reads "data" and the entries that end in .pth, and passes over all others.
ENTRY = "sb3_gcr.json"
#: Raised when a reader of older versions would misread the entry.
FORMAT = 1
#: What a model counts while it learns.
COUNTERS = ("num_timesteps", "_n_updates", "_n_rollouts_learned", "_adaptive_learning_rate")

ModelPath = str | Path | io.BufferedIOBase


@dataclass
class SavedModel:
    """What a file says of the model in it.

    :param policy: name or class of the policy
    :param spec: the reward components of its value heads
    :param settings: arguments of its constructor
    :param spaces: descriptions of its observation and action spaces
    :param parameters: state dicts of policy and optimiser
    :param counters: attributes by name
    :param statistics: of VecNormalize, if it had one
    """

    policy: Any
    spec: RewardSpec
    settings: dict[str, Any]
    spaces: dict[str, Any]
    parameters: dict[str, Any]
    counters: dict[str, Any] = field(default_factory=dict)
    statistics: dict[str, Any] | None = None


def describe_model(model: OnPolicyAlgorithm, spec: RewardSpec) -> dict[str, Any]:
    """All that is plain of a model, and the names of what is not.

    :param model: PPO or a subclass
    :param spec: its reward components
    """
    policy = POLICIES.get(model.policy_class)
    plain, rest = describe_settings(collect_settings(model.__dict__))
    if policy is None:
        rest = {"policy": describe_object(model.policy_class), **rest}
    vec_normalize = model.get_vec_normalize_env()
    return {
        "format": FORMAT,
        "policy": policy,
        "components": spec.to_dict(),
        "settings": plain,
        "not_plain": rest,
        **_describe_spaces(model.observation_space, model.action_space),
        "counters": {
            name: to_plain(model.__dict__[name]) for name in COUNTERS if name in model.__dict__
        },
        "vec_normalize": None if vec_normalize is None else describe_statistics(vec_normalize),
    }


def _describe_spaces(
    observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
) -> dict[str, Any]:
    return {
        "observation_space": describe_space(observation_space),
        "action_space": describe_space(action_space),
    }


def append_description(file: IO[bytes], description: Mapping[str, Any]) -> None:
    """Add our entry to a file that SB3 has written.

    :param file: open for reading and writing
    :param description: of ``describe_model``
    """
    with zipfile.ZipFile(file, "a") as archive:
        archive.writestr(ENTRY, json.dumps(description, indent=1))


def read_entries(path: ModelPath, names: Collection[str]) -> dict[str, bytes]:
    """Some entries of a model's file, as bytes.

    :param path: as for ``model.load``
    :param names: of the entries; those that are missing are left out
    :raises ValueError: if it is no zip file
    """
    file = open_path(path, "r", suffix="zip")
    try:
        with zipfile.ZipFile(file) as archive:
            return {name: archive.read(name) for name in names if name in archive.namelist()}
    except zipfile.BadZipFile as error:
        raise ValueError(f"Parameter `path` must be a zip file, found {path}: {error}.") from None
    finally:
        if isinstance(path, str | Path):
            file.close()


def read_statistics(path: ModelPath) -> dict[str, Any] | None:
    """VecNormalize's statistics in a model's file, None where it has none.

    :param path: as for ``model.load``
    """
    entries = read_entries(path, [ENTRY])
    statistics: dict[str, Any] | None = (
        json.loads(entries[ENTRY])["vec_normalize"] if entries else None
    )
    return statistics


def read_plain(path: ModelPath, device: th.device | str, given: Collection[str] = ()) -> SavedModel:
    """Read a file without unpickling anything.

    :param path: as for ``model.load``
    :param device: where the weights go
    :param given: names of settings that the file need not have, because the caller has them
    :raises ValueError: if the file has no plain settings, or needs more than those, or holds more
        than tensors
    """
    entries = read_entries(path, [ENTRY, "policy.pth", "policy.optimizer.pth"])
    if ENTRY not in entries:
        raise ValueError(
            "Parameter `weights_only` must be False for this file, found True: it has no entry "
            f"{ENTRY!r}, which "
            "`GCRPPO.save` writes. Load it without, if you trust it."
        )
    described = json.loads(entries.pop(ENTRY))
    if described["format"] != FORMAT:
        raise ValueError(
            f"The entry {ENTRY!r} must have format {FORMAT}, found {described['format']!r}."
        )
    missing = {
        name: what
        for name, what in described["not_plain"].items()
        if name.partition("[")[0] not in given
    }
    if missing:
        listed = ", ".join(f"{name} ({what})" for name, what in missing.items())
        raise ValueError(
            f"Parameter `weights_only` must be False for this file, found True: it needs {listed}. "
            "Give what is missing as "
            "keyword arguments, or load it without, if you trust it."
        )
    return SavedModel(
        policy=str(described["policy"]),
        spec=RewardSpec.from_dict(described["components"]),
        settings=parse_settings(described["settings"]),
        spaces={name: described[name] for name in ("observation_space", "action_space")},
        parameters={
            name.removesuffix(".pth"): _read_tensors(name, content, device)
            for name, content in entries.items()
        },
        counters=_check_counters(described["counters"]),
        statistics=described["vec_normalize"],
    )


def _read_tensors(name: str, content: bytes, device: th.device | str) -> Any:
    try:
        return th.load(io.BytesIO(content), map_location=get_device(device), weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            f"The entry {name!r} must hold tensors and nothing else: {reason}"
        ) from None


def _check_counters(counters: Mapping[str, Any]) -> dict[str, Any]:
    for name, value in counters.items():
        if name not in COUNTERS or not isinstance(value, int | float | None):
            raise ValueError(
                f"The counters in a file must be numbers named {list(COUNTERS)}, found "
                f"{name}={value!r}."
            )
    return dict(counters)


def read_pickled(
    path: ModelPath, device: th.device | str, custom_objects: dict[str, Any] | None = None
) -> SavedModel:
    """Read the file of a PPO or a GCRPPO; that runs the pickled code in it.

    :param path: as for ``model.load``
    :param device: where the weights go
    :param custom_objects: as for ``model.load``
    :raises ValueError: if it is of another algorithm
    """
    data, parameters, _ = load_from_zip_file(path, device=device, custom_objects=custom_objects)
    policy = (data or {}).get("policy_class")
    if (
        data is None
        or not (isinstance(policy, type) and issubclass(policy, ActorCriticPolicy))
        or "n_epochs" not in data
    ):
        raise ValueError(
            "Parameter `path` must be the file of a PPO or a GCRPPO, found another's, with policy "
            f"{policy!r}."
        )
    return SavedModel(
        policy=POLICIES.get(policy, policy),
        spec=data.get("reward_spec", SCALAR_REWARD),
        settings=collect_settings(data),
        spaces=_describe_spaces(data["observation_space"], data["action_space"]),
        parameters=dict(parameters),
        statistics=read_statistics(path),
    )


def check_spaces(
    saved: SavedModel, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
) -> None:
    """Refuse an env that the model in a file does not fit.

    :param saved: the model in the file
    :param observation_space: of the env
    :param action_space: of the env
    :raises ValueError: says what differs
    """
    found = _describe_spaces(observation_space, action_space)
    differences = [
        line for name in found for line in find_differences(saved.spaces[name], found[name], name)
    ]
    if differences:
        raise ValueError(
            "Parameter `env` must have the spaces of the saved model, found others: "
            f"{'; '.join(differences)}."
        )

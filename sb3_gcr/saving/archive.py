"""What a model's file holds: SB3's entries, and beside them ``sb3_gcr.json``, which says as much as
plain JSON can.
"""

from __future__ import annotations

import io
import json
import pickle
import zipfile
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import torch as th
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file, open_path
from stable_baselines3.common.utils import get_device

from sb3_gcr.rewards.spec import SCALAR_REWARD, RewardSpec
from sb3_gcr.saving.settings import (
    collect_settings,
    describe_object,
    describe_settings,
    find_policy_name,
    find_settings,
    parse_settings,
    refuse_text,
    to_plain,
)
from sb3_gcr.saving.spaces import describe_spaces
from sb3_gcr.saving.statistics import describe_statistics
from sb3_gcr.saving.unpickling import unpickle_attributes

#: The entry's name; SB3 reads "data" and the entries that end in .pth, and passes over all others.
ENTRY = "sb3_gcr.json"
#: Raised when a reader of older versions would misread the entry.
FORMAT = 1
#: Settings that older files lack, with what their models were trained with.
FORMERLY: dict[str, Any] = {"surrogate_clipping": "component"}

ModelPath = str | Path | io.BufferedIOBase


@dataclass
class SavedModel:
    """What a file says of the model in it.

    :param policy: name or class of the policy
    :param spec: the reward components of its value heads
    :param settings: arguments of its constructor
    :param spaces: descriptions of its observation and action spaces
    :param parameters: state dicts of policy and optimiser
    :param numbers: attributes by name, such as counters
    """

    policy: Any
    spec: RewardSpec
    settings: dict[str, Any]
    spaces: dict[str, Any]
    parameters: dict[str, Any]
    numbers: dict[str, Any] = field(default_factory=dict)


def describe_model(
    model: OnPolicyAlgorithm,
    spec: RewardSpec,
    numbers: Iterable[str],
    statistics: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """All that is plain of a model, and the names of what is not.

    :param model: PPO or a subclass
    :param spec: its reward components
    :param numbers: names of the attributes that are counters and the like
    :param statistics: those of VecNormalize if the env has none
    """
    policy = find_policy_name(type(model), model.policy_class)
    attributes = model.__dict__
    plain, rest = describe_settings(collect_settings(attributes, find_settings(type(model))))
    if policy is None:
        rest = {"policy": describe_object(model.policy_class), **rest}
    vec_normalize = model.get_vec_normalize_env()
    return {
        "format": FORMAT,
        "policy": policy,
        "components": spec.to_dict(),
        "settings": plain,
        "not_plain": rest,
        **describe_spaces(model.observation_space, model.action_space),
        "counters": {name: to_plain(attributes[name]) for name in numbers if name in attributes},
        "vec_normalize": describe_statistics(vec_normalize) if vec_normalize else statistics,
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


def read_description(path: ModelPath) -> dict[str, Any] | None:
    """Our entry of a model's file, None where it has none.

    :param path: as for ``model.load``
    """
    entries = read_entries(path, [ENTRY])
    return json.loads(entries[ENTRY]) if entries else None


def read_plain(
    path: ModelPath,
    device: th.device | str,
    model_class: type[Any],
    numbers: Collection[str],
    given: Collection[str] = (),
) -> SavedModel:
    """Read a file without unpickling anything.

    :param path: as for ``model.load``
    :param device: where the weights go
    :param model_class: whose settings they are
    :param numbers: names of its attributes that are counters and the like
    :param given: names of settings that the file need not have, because the caller has them
    :raises ValueError: if the file has no plain settings, or needs more than those, or holds more
        than tensors
    """
    entries = read_entries(path, [ENTRY, "policy.pth", "policy.optimizer.pth"])
    if ENTRY not in entries:
        raise ValueError(
            "Parameter `weights_only` must be False for this file, found True: it has no entry "
            f"{ENTRY!r}, which `GCRPPO.save` writes. Load it without, if you trust it."
        )
    described = json.loads(entries.pop(ENTRY))
    if described["format"] != FORMAT:
        raise ValueError(
            f"The entry {ENTRY!r} must have format {FORMAT}, found {described['format']!r}."
        )
    _refuse_missing(described["not_plain"], given)
    settings = parse_settings(described["settings"], model_class)
    return SavedModel(
        policy=str(described["policy"]),
        spec=RewardSpec.from_dict(described["components"]),
        settings={**former_settings(settings, model_class), **settings},
        spaces={name: described[name] for name in ("observation_space", "action_space")},
        parameters={
            name.removesuffix(".pth"): _read_tensors(name, content, device)
            for name, content in entries.items()
        },
        numbers=_check_numbers(described["counters"], numbers),
    )


def _refuse_missing(not_plain: Mapping[str, str], given: Collection[str]) -> None:
    """Refuse a file that needs what neither JSON nor the caller has."""
    missing = {
        name: what for name, what in not_plain.items() if name.partition("[")[0] not in given
    }
    if missing:
        listed = ", ".join(f"{name} ({what})" for name, what in missing.items())
        raise ValueError(
            f"Parameter `weights_only` must be False for this file, found True: it needs {listed}. "
            "Give what is missing as keyword arguments, or load it without, if you trust it."
        )


def former_settings(found: Collection[str], model_class: type[Any]) -> dict[str, Any]:
    """The settings that a file of ours lacks because they are younger, as they were then.

    :param found: names that the file has
    :param model_class: whose settings they are
    """
    missing = find_settings(model_class).keys() - set(found)
    return {name: value for name, value in FORMERLY.items() if name in missing}


def missing_attributes(found: Collection[str], model_class: type[Any]) -> dict[str, Any]:
    """What the file of a PPO, or an older one of ours, does not say of its model.

    :param found: names of the attributes in the file
    :param model_class: whose settings they are
    """
    if "reward_spec" not in found:
        return {"reward_spec": SCALAR_REWARD}
    return former_settings(found, model_class)


def _read_tensors(name: str, content: bytes, device: th.device | str) -> Any:
    try:
        return th.load(io.BytesIO(content), map_location=get_device(device), weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            f"The entry {name!r} must hold tensors and nothing else: {reason}"
        ) from None


def _check_numbers(found: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    for name, value in found.items():
        items = value if isinstance(value, list) else [value]
        is_plain = all(isinstance(item, int | float | None) for item in items)
        if name not in names or not is_plain:
            raise ValueError(
                f"The counters in a file must be numbers named {list(names)}, found "
                f"{name}={value!r}."
            )
    return dict(found)


def read_attributes(
    path: ModelPath, custom_objects: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """The attributes of a PPO or a GCRPPO in a file; that runs the pickled code in it.

    :param path: as for ``model.load``
    :param custom_objects: as for ``model.load``
    :raises ValueError: if it is of another algorithm, before anything of it is run, or if it cannot
        be read here
    """
    entries = read_entries(path, ["data"])
    written = json.loads(entries["data"]) if entries else {}
    if "n_epochs" not in written:
        policy = written.get("policy_class", {}).get("__module__", "none")
        raise ValueError(
            "Parameter `path` must be the file of a PPO or a GCRPPO, found another's, with a "
            f"policy of {policy}."
        )
    return unpickle_attributes(written, custom_objects or {})


def read_pickled(
    path: ModelPath,
    device: th.device | str,
    model_class: type[Any],
    custom_objects: dict[str, Any] | None = None,
) -> SavedModel:
    """Read the file of a PPO or a GCRPPO; that runs the pickled code in it.

    :param path: as for ``model.load``
    :param device: where the weights go
    :param model_class: whose settings are wanted
    :param custom_objects: as for ``model.load``
    :raises ValueError: if it is of another algorithm, or cannot be read here
    """
    attributes = read_attributes(path, custom_objects)
    settings = collect_settings(attributes, find_settings(model_class))
    refuse_text(settings, find_settings(model_class), " in the file")
    parameters = load_from_zip_file(path, load_data=False, device=device)[1]
    policy = attributes["policy_class"]
    former = former_settings(attributes, model_class) if "reward_spec" in attributes else {}
    return SavedModel(
        policy=find_policy_name(model_class, policy) or policy,
        spec=attributes.get("reward_spec", SCALAR_REWARD),
        settings={**former, **settings},
        spaces=describe_spaces(attributes["observation_space"], attributes["action_space"]),
        parameters=dict(parameters),
    )

"""Settings are what a constructor takes; text is no number."""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3.common.env_util import make_vec_env

from sb3_gcr import GCRPPO
from sb3_gcr.saving.settings import find_settings
from tests.envs import Env

SMALL: dict[str, Any] = {"n_steps": 32, "batch_size": 16, "n_epochs": 2, "seed": 0, "device": "cpu"}
HINT = " That is text: YAML needs a dot in 1.0e-2."


def exactly(message: str) -> str:
    return f"^{re.escape(message)}$"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "model.zip"


# === Which settings there are ===


class Base:
    def __init__(self, policy: str, env: Any, gamma: float = 0.9, *, device: str = "cpu"):
        pass


class Passing(Base):
    def __init__(self, *args: Any, alpha: int | None = None, gamma: int = 1, **kwargs: Any):
        super().__init__(*args, **kwargs)


class Silent(Passing):
    pass


class Closed(Silent):
    def __init__(self, policy: str, env: Any, beta: bool = True):
        super().__init__(policy, env)


class Unknown(Base):
    def __init__(self, alpha: NoSuchType):  # type: ignore[name-defined]  # noqa: F821
        pass


def test_arguments_that_are_passed_on_are_settings_too() -> None:
    assert find_settings(Base) == {"gamma": float}
    assert find_settings(Passing) == {"alpha": int | None, "gamma": int}  # the nearest type counts
    assert find_settings(Silent) == find_settings(Passing)
    assert find_settings(Closed) == {"beta": bool}
    assert find_settings(Unknown) == {"alpha": "NoSuchType"}


def test_what_a_model_runs_on_is_no_setting() -> None:
    settings = find_settings(GCRPPO)
    assert {"learning_rate", "seed", "tensorboard_log", "resolver", "gramian_samples"} <= set(
        settings
    )
    assert not {"self", "policy", "env", "device", "_init_setup_model"} & set(settings)


# === Text is no number ===

TEXTS = [
    ("gamma", "0.99", "a number"),
    ("learning_rate", "1e-3", "a number"),
    ("clip_range_vf", "0.2", "a number"),
    ("desired_kl", "1e-2", "a number"),
    ("kappa_max", "ten", "a number"),
    ("gramian_samples", "8", "a number"),
    ("n_epochs", "4", "a number"),
    ("seed", "0", "a number"),
    ("use_sde", "false", "True or False"),
]


@pytest.mark.parametrize(("name", "value", "wanted"), TEXTS)
def test_text_for_a_number_is_refused_when_loading(
    path: Path, name: str, value: str, wanted: str
) -> None:
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL).save(path)
    env = make_vec_env(Env, 1)
    hint = HINT if re.fullmatch(r"[\d.e-]+", value) else ""
    message = f"Parameter `{name}` must be {wanted}, found {value!r}.{hint}"
    for load in (GCRPPO.load, GCRPPO.warm_start):
        for weights_only in (False, True):
            given: dict[str, Any] = {name: value, "weights_only": weights_only}
            with pytest.raises(TypeError, match=exactly(message)):
                load(path, env=env, **given)
    with pytest.raises(TypeError, match=exactly(message)):
        GCRPPO.load(path, env, custom_objects={name: value})


@pytest.mark.parametrize(("name", "value", "wanted"), [*TEXTS, ("ent_coef", [0.1], "a number")])
def test_text_in_a_file_is_refused(path: Path, name: str, value: Any, wanted: str) -> None:
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL).save(path)
    rewrite(path, name, value)
    message = f"Parameter `{name}` must be {wanted}, found {value!r} in the file."
    for load in (GCRPPO.load, GCRPPO.warm_start):
        for weights_only in (False, True):
            with pytest.raises(TypeError, match=exactly(message)):
                load(path, env=make_vec_env(Env, 1), weights_only=weights_only)


def rewrite(path: Path, name: str, value: Any) -> None:
    """Give a setting another value, in SB3's entry and in ours."""
    with zipfile.ZipFile(path) as archive:
        entries = {entry: archive.read(entry) for entry in archive.namelist()}
    data, ours = json.loads(entries["data"]), json.loads(entries["sb3_gcr.json"])
    data[name] = value
    ours["settings"][name] = value
    changed = {"data": json.dumps(data), "sb3_gcr.json": json.dumps(ours)}
    with zipfile.ZipFile(path, "w") as archive:
        for entry, content in entries.items():
            archive.writestr(entry, changed.get(entry, content))


def test_what_may_be_text_stays_text(path: Path, tmp_path: Path) -> None:
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL).save(path)
    logs = str(tmp_path / "logs")
    loaded = GCRPPO.load(path, resolver="sum", tensorboard_log=logs, advantage_scope="minibatch")
    assert (loaded.resolver, loaded.tensorboard_log) == ("sum", logs)

"""The settings that all methods of a study share, every one of them named."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Mapping
from importlib.resources import files
from typing import Any

#: Settings that SB3's PPO and GCRPPO take as they are.
MODEL = (
    "learning_rate",
    "n_steps",
    "batch_size",
    "n_epochs",
    "gamma",
    "gae_lambda",
    "clip_range",
    "clip_range_vf",
    "normalize_advantage",
    "ent_coef",
    "vf_coef",
    "max_grad_norm",
    "target_kl",
)
#: Settings that only GCRPPO has.
OURS = (
    "advantage_scope",
    "desired_kl",
    "gramian_method",
    "gramian_samples",
    "kappa_max",
    "surrogate_clipping",
)
#: Settings that count something; all other numbers are floats, so that 10 and 10.0 are one cell.
COUNTS = ("n_envs", "n_steps", "batch_size", "n_epochs", "gramian_samples")
#: Activation functions by the name in a manifest.
ACTIVATIONS = {"tanh": "Tanh", "relu": "ReLU", "elu": "ELU"}
#: What `compare` takes where nothing is given: the defaults of SB3's PPO, for a rollout of 2048
#: steps from 8 envs, observations and returns scaled by VecNormalize.
DEFAULTS: dict[str, Any] = {
    "n_envs": 8,
    "normalize_obs": True,
    "normalize_reward": True,
    "clip_obs": 10.0,
    "clip_reward": 10.0,
    "policy": "MlpPolicy",
    "net_arch": [64, 64],
    "activation": "tanh",
    "log_std_init": 0.0,
    "ortho_init": True,
    "learning_rate": 3e-4,
    "n_steps": 256,
    "batch_size": 64,
    "n_epochs": 10,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "clip_range_vf": None,
    "normalize_advantage": True,
    "ent_coef": 0.0,
    "vf_coef": 0.5,
    "max_grad_norm": 0.5,
    "target_kl": None,
    "advantage_scope": "rollout",
    "desired_kl": None,
    "gramian_method": "auto",
    "gramian_samples": None,
    "kappa_max": 10.0,
    "surrogate_clipping": "joint",
}


def check_settings(settings: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The same, in the order of ``DEFAULTS``.

    :param settings: by name
    :param where: for the error, e.g. "Task 'walker'"
    :raises ValueError: for unknown and missing names, and for an unknown activation
    """
    check_names(settings, where)
    missing = [name for name in DEFAULTS if name not in settings]
    if missing:
        raise ValueError(
            f"{where}: `settings` must name everything that has a default, because defaults may "
            f"change and cells must not. Add {missing}."
        )
    if settings["activation"] not in ACTIVATIONS:
        raise ValueError(
            f"{where}: setting `activation` must be one of {list(ACTIVATIONS)}, found "
            f"{settings['activation']!r}."
        )
    return {name: _number(name, settings[name], where) for name in DEFAULTS}


def _number(name: str, value: Any, where: str) -> Any:
    """A number in the type of its setting, everything else as it is."""
    default = DEFAULTS[name]
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    wants_number = isinstance(default, int | float) and not isinstance(default, bool)
    if wants_number and not is_number:
        raise ValueError(
            f"{where}: setting `{name}` must be a number, found {value!r}. "
            "YAML reads 3e-4 as a word: write 3.0e-4."
        )
    if not is_number:
        return value
    return int(value) if name in COUNTS else float(value)


def check_names(names: Iterable[str], where: str) -> None:
    """Refuse settings that nobody knows.

    :param names: of settings
    :param where: for the error
    :raises ValueError: for an unknown name
    """
    unknown = [name for name in names if name not in DEFAULTS]
    if unknown:
        raise ValueError(
            f"{where}: unknown settings {unknown}; valid choices are {sorted(DEFAULTS)}."
        )


def policy_kwargs(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of the policy.

    :param settings: all of them
    """
    from torch import nn

    return {
        "net_arch": list(settings["net_arch"]),
        "activation_fn": getattr(nn, ACTIVATIONS[settings["activation"]]),
        "log_std_init": settings["log_std_init"],
        "ortho_init": settings["ortho_init"],
    }


def settings_of(env_id: str) -> dict[str, Any]:
    """The settings of an env for all methods: those of its entry in ``hyperparams/gcrppo.yml``
    where it is an env of sb3_gcr or EnvPool, else ``DEFAULTS``.

    :param env_id: id of the env
    """
    if not env_id.startswith(("sb3_gcr/", "envpool/")):
        return dict(DEFAULTS)
    import yaml

    text = (files("sb3_gcr.hyperparams") / "gcrppo.yml").read_text(encoding="utf-8")
    entry: dict[str, Any] = yaml.safe_load(text).get(env_id)
    return dict(DEFAULTS) if entry is None else _from_entry(entry)


def _from_entry(entry: Mapping[str, Any]) -> dict[str, Any]:
    """An entry of rl-zoo3's format as settings."""
    settings = {**DEFAULTS, **{name: entry[name] for name in DEFAULTS if name in entry}}
    settings["normalize_obs"] = settings["normalize_reward"] = bool(entry.get("normalize"))
    given = _keywords(str(entry.get("policy_kwargs") or "dict()"))
    if "activation_fn" in given:
        settings["activation"] = given.pop("activation_fn").lower()
    return settings | given


def _keywords(text: str) -> dict[str, Any]:
    """The keywords of ``dict(activation_fn=nn.ELU, net_arch=[128, 128])`` without running it."""
    call = ast.parse(text, mode="eval").body
    assert isinstance(call, ast.Call)
    found: dict[str, Any] = {}
    for keyword in call.keywords:
        assert keyword.arg is not None
        value = keyword.value
        if isinstance(value, ast.Attribute):
            found[keyword.arg] = value.attr
        else:
            found[keyword.arg] = ast.literal_eval(value)
    return found

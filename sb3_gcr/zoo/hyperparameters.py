"""Where our YAML files of hyperparameters are."""

from __future__ import annotations

from importlib.resources import files

#: Our algorithms, and those whose settings of rl-zoo3 they take where we have none.
INHERITED = {"gcrppo": "ppo", "gcrppo_lstm": "ppo_lstm"}


def hyperparameter_file(algo: str, env_id: str) -> str | None:
    """Our file of hyperparameters for an algorithm and an env, None where we have none.

    :param algo: "gcrppo", "gcrppo_lstm" or "ppo"; for others we have none
    :param env_id: id of the env
    """
    import yaml

    path = files("sb3_gcr.hyperparams") / f"{algo}.yml"
    return str(path) if path.is_file() and env_id in yaml.safe_load(path.read_text()) else None

"""SB3's methods that we override or rely on are the ones we have read."""

from __future__ import annotations

import hashlib
import inspect
from typing import Any

import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.vec_env import VecNormalize

REVIEWED = {
    (PPO, "__init__"): "21c5c4ab7fe7",
    (PPO, "_setup_model"): "165f5575cd97",
    (PPO, "train"): "7c8d09940123",
    (PPO, "learn"): "3765df0b88e6",
    (OnPolicyAlgorithm, "_setup_model"): "1bfc1e2ac80d",
    (OnPolicyAlgorithm, "_maybe_recommend_cpu"): "059330d480e9",
    (OnPolicyAlgorithm, "collect_rollouts"): "07f9eed35d9d",
    (OnPolicyAlgorithm, "dump_logs"): "22e7a7c5dd2a",
    (BaseAlgorithm, "_excluded_save_params"): "5452fc7cb8c0",
    (BaseAlgorithm, "_get_policy_from_name"): "4f517fba221d",
    (BaseAlgorithm, "_setup_learn"): "1c5a903f4b48",
    (BaseAlgorithm, "_update_learning_rate"): "2c117a53cb3a",
    (BaseAlgorithm, "load"): "d069b9b05c12",
    (BaseAlgorithm, "save"): "c7b1113e7105",
    (BaseAlgorithm, "set_env"): "1fe1a0febcdb",
    (BaseAlgorithm, "set_random_seed"): "0e7d5cb60fca",
    (ActorCriticPolicy, "_build"): "262b19d3fff0",
    (ActorCriticPolicy, "_get_constructor_parameters"): "12e4522b41b0",
    (ActorCriticPolicy, "_get_action_dist_from_latent"): "96660636deab",
    (ActorCriticPolicy, "evaluate_actions"): "064f42328253",
    (BasePolicy, "extract_features"): "302b47463695",
    (RolloutBuffer, "reset"): "20b4f5d48e0c",
    (RolloutBuffer, "add"): "624274151cae",
    (RolloutBuffer, "get"): "7500122932f8",
    (RolloutBuffer, "compute_returns_and_advantage"): "1a229ef50a03",
    (DictRolloutBuffer, "add"): "19875423ca87",
    (VecNormalize, "normalize_reward"): "2fd793eb4439",
    (VecNormalize, "step_wait"): "9b005da93b70",
    (None, "evaluate_policy"): "2fba33ab1a6b",
}


def fingerprint(function: Any) -> str:
    """Hash of a function's source."""
    return hashlib.sha256(inspect.getsource(function).encode()).hexdigest()[:12]


@pytest.mark.parametrize(
    ("owner", "name"), list(REVIEWED), ids=lambda value: getattr(value, "__name__", str(value))
)
def test_upstream_is_what_we_reviewed(owner: Any, name: str) -> None:
    function = evaluate_policy if owner is None else inspect.getattr_static(owner, name)
    function = getattr(function, "__func__", function)
    if fingerprint(function) != REVIEWED[owner, name]:
        pytest.fail(
            f"SB3 has changed {getattr(owner, '__name__', '')}.{name}: review again what we "
            "override or rely on, then put "
            f"{fingerprint(function)!r} into REVIEWED."
        )

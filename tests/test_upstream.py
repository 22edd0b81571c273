"""SB3's methods that we override or rely on are the ones we have read."""

from __future__ import annotations

import ast
import hashlib
import inspect
import textwrap
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
    (PPO, "__init__"): "e5dc2a3ec0ea",
    (PPO, "_setup_model"): "3eadd6fa7bef",
    (PPO, "train"): "c15fc60a06f4",
    (PPO, "learn"): "14f3a3585e64",
    (OnPolicyAlgorithm, "_setup_model"): "c78bcf109c28",
    (OnPolicyAlgorithm, "_maybe_recommend_cpu"): "f36f8d1ad4e6",
    (OnPolicyAlgorithm, "collect_rollouts"): "09638559a70d",
    (OnPolicyAlgorithm, "dump_logs"): "6deb3e96fc2e",
    (BaseAlgorithm, "_excluded_save_params"): "7a6cc8b6049a",
    (BaseAlgorithm, "_get_policy_from_name"): "8bf7f38faaf5",
    (BaseAlgorithm, "_setup_learn"): "046e4c1ed033",
    (BaseAlgorithm, "_update_learning_rate"): "49ee53488615",
    (BaseAlgorithm, "load"): "bdb2adbee75f",
    (BaseAlgorithm, "save"): "d0e1b80df84b",
    (BaseAlgorithm, "set_env"): "ca0edc808158",
    (BaseAlgorithm, "set_random_seed"): "be86d2e27087",
    (ActorCriticPolicy, "_build"): "254a5d13487e",
    (ActorCriticPolicy, "_get_constructor_parameters"): "48d213848c33",
    (ActorCriticPolicy, "_get_action_dist_from_latent"): "257b1ee4cc5b",
    (ActorCriticPolicy, "evaluate_actions"): "1546a913cc01",
    (BasePolicy, "extract_features"): "ba54d728fa0d",
    (RolloutBuffer, "reset"): "75073a3bb62f",
    (RolloutBuffer, "add"): "f7744f96609b",
    (RolloutBuffer, "get"): "4511b8697883",
    (RolloutBuffer, "compute_returns_and_advantage"): "0677212ed6ed",
    (DictRolloutBuffer, "add"): "879c3665f2f6",
    (VecNormalize, "normalize_reward"): "df4fbeae1e35",
    (VecNormalize, "step_wait"): "b063880f71c4",
    (None, "evaluate_policy"): "0c9558a987c1",
}


def fingerprint(function: Any) -> str:
    """Hash of a function's code without comments, docstrings and formatting."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and ast.get_docstring(node) is not None:
            node.body = node.body[1:]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:12]


@pytest.mark.parametrize(("owner", "name"), list(REVIEWED), ids=lambda value: getattr(value, "__name__", str(value)))
def test_upstream_is_what_we_reviewed(owner: Any, name: str) -> None:
    function = evaluate_policy if owner is None else inspect.getattr_static(owner, name)
    function = getattr(function, "__func__", function)
    if fingerprint(function) != REVIEWED[owner, name]:
        pytest.fail(
            f"SB3 has changed {getattr(owner, '__name__', '')}.{name}: review again what we override or rely on, then put "
            f"{fingerprint(function)!r} into REVIEWED."
        )

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
    (PPO, "__init__"): "9149f29c4465",
    (PPO, "_setup_model"): "b63eabb97579",
    (PPO, "train"): "744e951f0ff6",
    (PPO, "learn"): "f2d9e9d25b6c",
    (OnPolicyAlgorithm, "_setup_model"): "f4350385d82e",
    (OnPolicyAlgorithm, "_maybe_recommend_cpu"): "6eac4f54b045",
    (OnPolicyAlgorithm, "collect_rollouts"): "ade66a1ce768",
    (OnPolicyAlgorithm, "dump_logs"): "6b245e0f4d2e",
    (BaseAlgorithm, "_excluded_save_params"): "82e5c65739ba",
    (BaseAlgorithm, "_get_policy_from_name"): "3e6820ba3f96",
    (BaseAlgorithm, "_setup_learn"): "7eed1da120cc",
    (BaseAlgorithm, "_update_learning_rate"): "f3a9690538a7",
    (BaseAlgorithm, "load"): "b5180feac421",
    (BaseAlgorithm, "save"): "63a986b4596f",
    (BaseAlgorithm, "set_env"): "a5e6da0dc352",
    (BaseAlgorithm, "set_random_seed"): "bd6c75e74746",
    (ActorCriticPolicy, "_build"): "1e0564f2a405",
    (ActorCriticPolicy, "_get_constructor_parameters"): "3c22594e38b8",
    (ActorCriticPolicy, "_get_action_dist_from_latent"): "7344d5c35282",
    (ActorCriticPolicy, "evaluate_actions"): "ccf6b1574512",
    (BasePolicy, "extract_features"): "a43d6d220031",
    (RolloutBuffer, "reset"): "de8f977b2615",
    (RolloutBuffer, "add"): "da5ab2c5d3f5",
    (RolloutBuffer, "get"): "2c1a9e9863ce",
    (RolloutBuffer, "compute_returns_and_advantage"): "f64be170293e",
    (DictRolloutBuffer, "add"): "67ccae224fa1",
    (VecNormalize, "normalize_reward"): "ebd5e333496a",
    (VecNormalize, "step_wait"): "a8bc18106882",
    (None, "evaluate_policy"): "a425756913b1",
}


def fingerprint(function: Any) -> str:
    """Hash of a function's code without comments, docstrings and formatting."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and ast.get_docstring(node) is not None:
            node.body = node.body[1:]
    return hashlib.sha256(ast.unparse(tree).encode()).hexdigest()[:12]


@pytest.mark.parametrize(("owner", "name"), list(REVIEWED), ids=lambda value: getattr(value, "__name__", str(value)))
def test_upstream_is_what_we_reviewed(owner: Any, name: str) -> None:
    function = evaluate_policy if owner is None else inspect.getattr_static(owner, name)
    function = getattr(function, "__func__", function)
    if fingerprint(function) != REVIEWED[owner, name]:
        pytest.fail(
            f"SB3 has changed {getattr(owner, '__name__', '')}.{name}: review again what we override or rely on, then put "
            f"{fingerprint(function)!r} into REVIEWED."
        )

"""rl-zoo3's manager of experiments, with our hyperparameters and our terms in Monitor's files.

It needs rl-zoo3, so it is imported where that is known to be installed.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
from rl_zoo3 import exp_manager
from stable_baselines3.common.vec_env import VecEnv

from sb3_gcr.zoo.hyperparameters import INHERITED, hyperparameter_file


class ZooManager(exp_manager.ExperimentManager):
    """Finds our hyperparameters, and lets Monitor write the return of each term of our envs."""

    def __init__(
        self, args: argparse.Namespace, algo: str, env_id: str, *others: Any, **kwargs: Any
    ):
        super().__init__(args, algo, env_id, *others, **kwargs)
        if not kwargs.get("config"):
            theirs = Path(self.config).with_name(f"{INHERITED.get(algo, algo)}.yml")
            self.config = hyperparameter_file(algo, env_id) or str(theirs)

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """The envs, with Monitor's columns for the terms of ours.

        :param n_envs: how many
        :param eval_env: whether they are for evaluation
        :param no_log: whether Monitor writes no file
        """
        given, env_id = self.monitor_kwargs, self.env_name.gym_id
        if gym.spec(env_id).namespace in ("sb3_gcr", "envpool"):
            env = gym.make(env_id, **(self.eval_env_kwargs if eval_env else self.env_kwargs))
            self.monitor_kwargs = {
                "info_keywords": env.get_wrapper_attr("reward_spec").return_keys,
                **given,
            }
            env.close()
        try:
            return super().create_envs(n_envs, eval_env, no_log)
        finally:
            self.monitor_kwargs = given

"""GCR-PPO for Stable-Baselines3: PPO that keeps the terms of a reward apart.

Read the method top to bottom: ``rewards.spec`` (names and levels of the reward's terms),
``multi_head`` (rollouts with a value per term), ``buffers`` and ``advantages`` (one advantage per
term), ``losses`` (one surrogate per term), ``update`` (the loop), ``resolvers`` (who yields to
whom), ``gradients`` (one gradient per term and their Gramian). ``envs`` has tasks with such
rewards, and a thread pool that steps hundreds of them.
"""

import sb3_gcr.envs as envs
from sb3_gcr.buffers import VectorRolloutBuffer
from sb3_gcr.conflicts.measuring import measure_conflicts
from sb3_gcr.evaluation import evaluate_components
from sb3_gcr.gcrppo import GCRPPO
from sb3_gcr.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_gcr.resolvers import RESOLVERS
from sb3_gcr.rewards.decomposition import RewardDecomposition
from sb3_gcr.rewards.finding import find_components
from sb3_gcr.rewards.spec import RewardSpec
from sb3_gcr.saving.checkpoints import latest_checkpoint

__version__ = "0.1.0"

__all__ = [
    "GCRPPO",
    "RESOLVERS",
    "CnnPolicy",
    "MlpPolicy",
    "MultiInputPolicy",
    "RewardDecomposition",
    "RewardSpec",
    "VectorRolloutBuffer",
    "envs",
    "evaluate_components",
    "find_components",
    "latest_checkpoint",
    "measure_conflicts",
]

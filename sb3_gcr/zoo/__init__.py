"""rl-zoo3's commands for GCRPPO."""

from sb3_gcr.zoo.commands import main, register
from sb3_gcr.zoo.hyperparameters import hyperparameter_file

__all__ = ["hyperparameter_file", "main", "register"]

"""rl-zoo3's commands for GCRPPO."""

from sb3_gcr.zoo.commands import hyperparameter_file, main, register

__all__ = ["hyperparameter_file", "main", "register"]

"""Simulators made by others, as VecEnvs of Stable-Baselines3 with reward components."""

"""Settings by env in rl-zoo3's format; a package, `sb3_gcr.hyperparams`, so that an installed
sb3_gcr finds them.
"""

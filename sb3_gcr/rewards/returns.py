"""When the return of an episode begins and ends."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, is_vecenv_wrapped

from sb3_gcr.rewards.layers import layers_of


def is_monitored(env: VecEnv) -> bool:
    """Whether a Monitor says when episodes end: not with each life, as some wrappers do.

    :param env: a VecEnv
    """
    if is_vecenv_wrapped(env, VecMonitor):
        return True
    try:
        return bool(env.env_is_wrapped(Monitor)[0])
    except Exception:  # somebody else's VecEnv may not know
        return False


def find_ended(
    dones: NDArray[np.bool_], infos: Sequence[dict[str, Any]], monitored: bool
) -> NDArray[np.intp]:
    """Indices of the envs whose episode has ended, as SB3's ``evaluate_policy`` counts them.

    :param dones: shape (N,)
    :param infos: of the same step
    :param monitored: whether infos tell
    """
    done = np.flatnonzero(dones)
    if not monitored or len(infos) == 0:
        return done
    return np.array([index for index in done.tolist() if "episode" in infos[index]], dtype=np.intp)


@contextmanager
def zero_on_reset(env: VecEnv, running: NDArray[np.float64]) -> Iterator[None]:
    """Set the rows of an array to 0 whose envs somebody resets in the meantime, such as a callback.

    :param env: a VecEnv
    :param running: what the episodes have paid so far, shape (N, K)
    """
    innermost = layers_of(env)[-1]
    reset, env_method = innermost.reset, getattr(innermost, "env_method", None)

    def watched_reset(*args: Any, **kwargs: Any) -> Any:
        running[:] = 0.0
        return reset(*args, **kwargs)

    def watched_env_method(name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        assert env_method is not None
        if name == "reset":
            running[slice(None) if indices is None else indices] = 0.0
        return env_method(name, *args, indices=indices, **kwargs)

    watched = {"reset": watched_reset}
    if env_method is not None:  # somebody else's VecEnv may have none
        watched["env_method"] = watched_env_method
    own = {name: value for name, value in vars(innermost).items() if name in watched}
    vars(innermost).update(watched)
    try:
        yield
    finally:
        for name in watched:
            del vars(innermost)[name]
        vars(innermost).update(own)

"""Measure the conflicts of a policy on rollouts of its own, without disturbing its training."""

from __future__ import annotations

import io
from collections.abc import Iterable
from contextlib import ExitStack
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch.nn import RNNBase

from sb3_gcr.checks import check_number
from sb3_gcr.conflicts.blocks import Blocks
from sb3_gcr.conflicts.estimators import MIN_BLOCKS, estimate
from sb3_gcr.conflicts.heads import fit_policy
from sb3_gcr.conflicts.result import Conflicts
from sb3_gcr.conflicts.undisturbed import (
    adopt_statistics,
    kept_generators,
    kept_statistics,
    normalisers,
)
from sb3_gcr.gcrppo import GCRPPO
from sb3_gcr.gradients.by_autograd import ByAutograd
from sb3_gcr.minibatches import Normalisation, minibatches
from sb3_gcr.rewards.layers import layers_of
from sb3_gcr.rewards.reading import find_reward_spec
from sb3_gcr.saving.model import Saving
from sb3_gcr.saving.statistics import ONE_OBSERVATION, count_seen
from sb3_gcr.update import ConflictResolution

#: Samples whose graph is in memory at a time.
CHUNK = 4096


def measure_conflicts(
    model: PPO | ConflictResolution,
    env: gym.Env[Any, Any] | VecEnv,
    n_rollouts: int = 24,
    seed: int | None = None,
    progress_bar: bool = False,
) -> Conflicts:
    r"""Which terms of a reward really conflict for a policy as it is now, and how certain that is.

    A copy of the model makes ``n_rollouts`` rollouts of its own length on ``env``. Each is a block
    with gradients :math:`g_i = \frac{1}{n}\sum_b (A^i_b - \bar A^i) ∇\log π(a_b|s_b)`, and products
    of different blocks share no noise:

    .. math:: Ĝ_{ij} = \frac{1}{n(n-1)} \sum_{a ≠ b} g_i^a·g_j^b

    The model, its env, the statistics of every VecNormalize, and Python's, NumPy's and PyTorch's
    generators are afterwards what they were. ``env`` is stepped. It is seen with the statistics of
    the model's own VecNormalize, where the model has one; else its ``norm_reward`` must be that of
    training, because a critic's values have the units of the rewards.

    SB3's ``PPO`` has one value head, so one for each term is fitted first to four more rollouts, on
    the features of its critic.

    :param model: a GCRPPO, a RecurrentGCRPPO, or SB3's PPO; trained or loaded
    :param env: another env than the model's own, with the same reward terms
    :param n_rollouts: number of blocks, of ``model.n_steps`` steps of every env each; at least 3
    :param seed: of the copy and of ``env``; None goes on with the generators as they are
    :param progress_bar: show a progress bar (needs tqdm)
    :return: cosines, z values, signal, tables and a picture
    :raises ValueError: for too few rollouts, for an env without terms, with one term, with other
        terms, or that the model trains on, and for a VecNormalize without statistics
    :raises TypeError: for another algorithm than PPO
    """
    check_number("n_rollouts", n_rollouts, MIN_BLOCKS, integer=True)
    if not isinstance(model, PPO | ConflictResolution):
        raise TypeError(
            "Parameter `model` must be a GCRPPO, a RecurrentGCRPPO or SB3's PPO, found "
            f"{type(model).__name__}."
        )
    venv = BaseAlgorithm._wrap_env(env, 0)
    _check_env(model, venv)
    with ExitStack() as kept:
        kept.enter_context(kept_generators())
        wrappers = normalisers(venv)
        kept.enter_context(kept_statistics(wrappers))
        own = model.get_env()
        adopt_statistics(wrappers, [] if own is None else normalisers(own))
        copy = _copy(model, venv, seed)
        _check_statistics(wrappers)
        return _measure(copy, n_rollouts, not isinstance(model, Saving), progress_bar)


def _check_env(model: PPO | ConflictResolution, env: VecEnv) -> None:
    """Refuse an env that cannot tell terms apart, or whose episodes training would miss."""
    spec = find_reward_spec(env)
    if spec is None:
        raise ValueError(
            "Parameter `env` must report reward components, found none. Wrap it with "
            "`RewardDecomposition`."
        )
    if len(spec) < 2:
        raise ValueError(
            "Parameter `env` must report at least two reward components, found only "
            f"'{spec.names[0]}': one term has nothing to conflict with."
        )
    own = model.get_env()
    if own is not None and _simulations(own) & _simulations(env):
        raise ValueError(
            "Parameter `env` must be another env than the model's own, whose episodes the "
            "measurement would cut. Make a second one in the same way."
        )


def _check_statistics(wrappers: list[VecNormalize]) -> None:
    """Refuse to show a policy observations that it has never seen."""
    if any(wrapper.norm_obs and count_seen(wrapper) < ONE_OBSERVATION for wrapper in wrappers):
        raise ValueError(
            "The VecNormalize of `env` must have the statistics that the model has learned with, "
            "found none, in the model neither. Load them: `VecNormalize.load(path, venv)`."
        )


def _simulations(env: VecEnv) -> set[int]:
    """Ids of a VecEnv's innermost layer and of the envs in it."""
    innermost = layers_of(env)[-1]
    single = getattr(innermost, "envs", None) or []
    return {id(innermost), *(id(one.unwrapped) for one in single)}


def _copy(model: PPO | ConflictResolution, env: VecEnv, seed: int | None) -> ConflictResolution:
    """A model of the same policy on another env, which prints and logs nothing."""
    stream = io.BytesIO()
    model.save(stream)
    stream.seek(0)
    given: dict[str, Any] = {"verbose": 0, "tensorboard_log": None, "seed": seed}
    if isinstance(model, Saving):
        copy: Any = type(model).load(stream, env, device=model.device, **given)
    else:
        batch_size = model.n_steps * env.num_envs
        copy = GCRPPO.warm_start(stream, env, device=model.device, batch_size=batch_size, **given)
    copy.set_logger(Logger(None, []))
    return copy  # type: ignore[no-any-return]


def _measure(
    model: ConflictResolution, n_rollouts: int, fits_heads: bool, progress_bar: bool
) -> Conflicts:
    """Collect the rollouts and multiply their gradients."""
    assert model.env is not None
    env, buffer = model.env, model.rollout_buffer
    _, callback = model._setup_learn(n_rollouts * model.n_steps * env.num_envs)

    def collect() -> None:
        model.collect_rollouts(env, callback, buffer, model.n_steps)

    if fits_heads:
        fit_policy(model, collect)
    blocks = Blocks(n_rollouts)
    for _ in _shown(range(n_rollouts), progress_bar):
        collect()
        blocks.add(rollout_gradients(model))
    products = blocks.products()
    naive = np.einsum("aaij->ij", products) / len(products)
    return Conflicts(model.reward_spec, estimate(products), naive, len(products))


def rollout_gradients(model: ConflictResolution, chunk: int = CHUNK) -> NDArray[np.float32]:
    """The K policy gradients of the rollout in a model's buffer, at the policy that made it.

    Its advantages lose their means.

    :param model: after ``collect_rollouts``
    :param chunk: samples of one forward pass
    :return: shape (K, D)
    """
    buffer = model.rollout_buffer
    buffer.advantages = buffer.advantages - buffer.advantages.mean((0, 1))
    n_samples = buffer.advantages[..., 0].size
    chosen = model._choose_actor_critic()
    actor_critic = chosen if isinstance(chosen, ByAutograd) else ByAutograd(model.policy)
    # As in the rollout; but CUDA's recurrent layers have a backward pass in training alone.
    model.policy.set_training_mode(any(isinstance(m, RNNBase) for m in model.policy.modules()))
    total: Any = 0.0
    batches = minibatches(
        buffer,
        chunk,
        Normalisation(None, np.inf),
        actor_critic,
        discrete=isinstance(model.action_space, spaces.Discrete),
    )
    for batch in batches:
        actor_critic.evaluate(batch.observations, batch.actions)
        total = total + actor_critic.jacobian(batch.advantages / n_samples)
    return total.cpu().numpy()  # type: ignore[no-any-return]


def _shown(rounds: Iterable[int], progress_bar: bool) -> Iterable[int]:
    """With a progress bar, if wanted."""
    if not progress_bar:
        return rounds
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise ImportError("A progress bar needs tqdm: pip install 'sb3_gcr[plots]'") from error
    return tqdm(rounds, desc="rollouts", unit="rollout")

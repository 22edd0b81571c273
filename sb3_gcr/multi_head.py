"""PPO on reward vectors: everything around the update, with a last axis of K reward components."""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, TypeVar

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, PyTorchObs
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv

from sb3_gcr.advantages import bootstrap_truncations
from sb3_gcr.diagnosis import in_plain_words, why_no_actions
from sb3_gcr.logs.shown import component_table
from sb3_gcr.policies import check_value_heads
from sb3_gcr.rewards.layers import outermost_attribute
from sb3_gcr.rewards.reading import (
    ComponentReader,
    find_reward_spec,
    match_specs,
    refuse_vector_rewards,
    undecomposed_id,
)
from sb3_gcr.rewards.returns import find_ended, is_monitored, zero_on_reset
from sb3_gcr.rewards.spec import SCALAR_REWARD, RewardSpec

T = TypeVar("T")


#: Which algorithm trains a kind of policy, as the end of an error message.
ALGORITHMS = {
    "flat": " A policy without memory needs `sb3_gcr.GCRPPO`.",
    "recurrent": " A policy with an LSTM needs `sb3_gcr.recurrent.RecurrentGCRPPO`.",
    "maskable": " A maskable policy needs sb3-contrib's MaskablePPO, which has one objective.",
}


def find_kind(policy: str | type[BasePolicy]) -> str:
    """Whether a policy is "flat", "recurrent", "maskable", or another one of sb3-contrib's, "".

    :param policy: its class, or the name of one
    """
    if isinstance(policy, str):
        return "recurrent" if "Lstm" in policy else "flat"
    modules = [base.__module__ for base in policy.__mro__]
    contributed = [module for module in modules if module.startswith("sb3_contrib")]
    for kind in ("recurrent", "maskable"):
        if any(kind in module for module in contributed):
            return kind
    return "" if contributed else "flat"


class MultiHead(OnPolicyAlgorithm):
    """A critic head and a return per reward component, as a base before a PPO; the update is left
    to a subclass.

    With one component, and nothing that asks for more, that PPO's own code runs. What depends on
    the kind of policy is left to :class:`MultiHeadPPO` and its recurrent sibling.

    :param args: the arguments of the PPO
    :param kwargs: the keyword arguments of the PPO
    """

    #: What a policy with K heads is a subclass of.
    multi_head_policy: ClassVar[type[BasePolicy]]
    #: Its kind, see :func:`find_kind`.
    policy_kind: ClassVar[str]

    #: Attributes that are in no file; see ``saving.model``.
    unsaved: ClassVar[tuple[str, ...]] = ("_reader", "_ended_returns", "_is_monitored")
    #: See :class:`~sb3_gcr.saving.model.Saving`.
    saved_numbers: ClassVar[tuple[str, ...]] = ("_has_paid",)

    #: Names and levels of the reward components.
    reward_spec: RewardSpec

    def __init__(self, *args: Any, **kwargs: Any):
        self.ep_component_buffer: deque[NDArray[np.float64]] = deque(
            maxlen=kwargs.get("stats_window_size", 100)
        )
        self._episode_components: NDArray[np.float64] | None = None
        #: Which components have ever paid, 1 or 0 each, in the order of ``reward_spec``.
        self._has_paid: list[int] = []
        self._ended_returns: dict[int, float] = {}
        self._reader: ComponentReader | None = None
        self._is_monitored = False
        super().__init__(*args, **kwargs)

    @property
    def n_components(self) -> int:
        """Number K of reward components."""
        return len(self.reward_spec)

    @property
    def _is_scalar_ppo(self) -> bool:
        """Whether SB3's own rollouts and update run."""
        return self.n_components == 1

    def _setup_model(self) -> None:
        if find_kind(self.policy_class) != self.policy_kind:
            raise ValueError(self._wrong_policy_message(self.policy_class))
        self._adopt_reward_spec()
        if self._is_scalar_ppo:
            super()._setup_model()
            return
        given = {
            name: getattr(self, name)
            for name in ("policy_kwargs", "rollout_buffer_class", "rollout_buffer_kwargs")
        }
        self._choose_vector_classes()
        super()._setup_model()
        self.__dict__.update(given)  # what a model saves is what its constructor was given
        check_value_heads(self.policy, self.n_components, self._first_value_of)

    def _adopt_reward_spec(self) -> None:
        """Take over the env's spec, or check it against the one that a loaded model was made
        with.
        """
        found = None if self.env is None else find_reward_spec(self.env)
        if self.env is not None and found is None:
            refuse_vector_rewards(self.env)
        if "reward_spec" in self.__dict__:
            self.reward_spec = match_specs(self.reward_spec, found)
            return
        self.reward_spec = found or SCALAR_REWARD
        env_id = None if self.env is None else undecomposed_id(self.env)
        if env_id is not None:
            warnings.warn(
                f"'{env_id}' reports the terms of its reward, but nothing collects them, so GCRPPO "
                "trains one objective. "
                "Add the line `env = RewardDecomposition(env)`, or `make_vec_env(..., "
                "wrapper_class=RewardDecomposition)`.",
                stacklevel=2,
            )

    def _choose_vector_classes(self) -> None:
        """Let SB3's setup build a policy with K heads."""
        if issubclass(self.policy_class, self.multi_head_policy):
            self.policy_kwargs = {**self.policy_kwargs, "n_components": self.n_components}
        elif self.n_components > 1:
            raise ValueError(self._wrong_policy_message(self.policy_class))

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        if policy_name not in self.policy_aliases:
            raise ValueError(self._wrong_policy_message(policy_name))
        return self.policy_aliases[policy_name]

    @classmethod
    def _wrong_policy_message(cls, policy: str | type[BasePolicy]) -> str:
        name = policy if isinstance(policy, str) else policy.__name__
        kind = find_kind(policy)
        way_out = "" if kind == cls.policy_kind else ALGORITHMS.get(kind, "")
        return (
            f"Parameter `policy` must be one of {sorted(cls.policy_aliases)} or a subclass of "
            f"{cls.multi_head_policy.__name__}, found {name!r}.{way_out}"
        )

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        if isinstance(env, gym.vector.VectorEnv):
            raise TypeError(
                "Parameter `env` must be a Gymnasium env, its id or a VecEnv of SB3, found a "
                f"Gymnasium vector env, {type(env).__name__}. Use SB3's `make_vec_env(id, "
                "n_envs)`; for the envs of this package with "
                "`vec_env_cls=sb3_gcr.envs.BatchedVecEnv`."
            )
        return OnPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """SB3's ``set_env``; the reward components must be those of the model, their order may
        differ.

        :param env: the environment to learn from
        :param force_reset: reset it before training
        :raises ValueError: if the names differ
        """
        env = self._wrap_env(env, self.verbose)
        spec = match_specs(self.reward_spec, find_reward_spec(env))
        super().set_env(env, force_reset)
        self.reward_spec = spec

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        assert self.env is not None
        if self.n_components > 1 and find_reward_spec(self.env) is None:
            raise ValueError(
                f"The env reports no reward components, but the model has {self.n_components}: "
                f"{self.reward_spec}. "
                "Wrap it with `RewardDecomposition`, or set another with `set_env`; `predict` "
                "works without."
            )
        resets = reset_num_timesteps or self._last_obs is None
        if resets or self._episode_components is None:
            self._episode_components = np.zeros((self.env.num_envs, self.n_components))
        if reset_num_timesteps:
            self.ep_component_buffer = deque(maxlen=self._stats_window_size)
        result = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        if self._reader is None or not self._reader.is_for(self.env, self.reward_spec):
            self._reader = ComponentReader(self.env, self.reward_spec)
        self._is_monitored = is_monitored(self.env)
        if self.n_components > 1:
            self.logger.info(f"{self.n_components} reward components: {self.reward_spec}")
        else:
            self.logger.info("One reward component: training is SB3's PPO with one objective.")
        return result

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """SB3's ``collect_rollouts`` with reward components; a callback's ``locals["values"]`` has
        shape (N, K).

        :param env: training env
        :param callback: called at each step
        :param rollout_buffer: buffer to fill
        :param n_rollout_steps: number of steps per env
        :return: False if the callback stopped the rollout
        :raises ValueError: if the components of a step are missing, not finite, or do not sum to
            the reward; if the policy can give no actions, since an observation or a parameter is
            not finite or a standard deviation is 0
        """
        collect = super().collect_rollouts if self._is_scalar_ppo else self._collect_components
        with self._in_plain_words():
            return collect(env, callback, rollout_buffer, n_rollout_steps)

    @contextmanager
    def _in_plain_words(self) -> Iterator[None]:
        """Explain why the policy could give no actions, if so."""
        with in_plain_words(
            lambda: why_no_actions(self.policy, self._last_obs, self.num_timesteps)  # type: ignore[arg-type]
        ):
            yield

    def _collect_components(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        assert self._last_obs is not None, "No previous observation was provided"
        self.policy.set_training_mode(False)
        rollout_buffer.reset()
        if self.use_sde:
            self.policy.reset_noise(env.num_envs)
        self._listen(callback.on_rollout_start)
        has_paid = self.has_paid
        n_steps = 0
        while n_steps < n_rollout_steps:
            if self.use_sde and self.sde_sample_freq > 0 and n_steps % self.sde_sample_freq == 0:
                self.policy.reset_noise(env.num_envs)
            with th.no_grad():
                actions, values, log_probs = self._act()
            clipped_actions = self._to_env_actions(actions)
            new_obs, rewards, dones, infos = env.step(clipped_actions)
            self.num_timesteps += env.num_envs
            reward_components, original_components = self._read_components(rewards, infos)
            self._count_components(original_components, dones, infos)
            has_paid |= (original_components != 0).any(0)
            callback.update_locals(locals())
            if not self._listen(callback.on_step):
                return False
            self._update_info_buffer(infos, dones)
            n_steps += 1
            reward_components = self._bootstrap(reward_components, dones, infos)
            self._add_step(rollout_buffer, actions, reward_components, values, log_probs)
            self._last_obs = new_obs  # type: ignore[assignment]
            self._last_episode_starts = dones
        with th.no_grad():
            values = self._value_of(obs_as_tensor(new_obs, self.device), dones)  # type: ignore[arg-type]
        rollout_buffer.compute_returns_and_advantage(last_values=values, dones=dones)
        self._has_paid = has_paid.astype(int).tolist()
        # The untrained head of a component that has never paid says nothing of an action.
        rollout_buffer.advantages[..., ~self.has_paid] = 0.0
        callback.update_locals(locals())
        self._listen(callback.on_rollout_end)
        return True

    @property
    def has_paid(self) -> NDArray[np.bool_]:
        """Which components have paid in any rollout so far, shape (K,); one alone counts as such.

        A component that has not has no advantage, no gradient and weight 1.
        """
        if self.n_components == 1:
            return np.ones(1, dtype=bool)
        return np.array(self._has_paid or np.zeros(self.n_components), dtype=bool)

    def _act(self) -> tuple[NDArray[Any], th.Tensor, th.Tensor]:
        """Sample the policy at the last observations: actions, V (N, K) and log π (N,)."""
        raise NotImplementedError

    def _add_step(
        self,
        rollout_buffer: RolloutBuffer,
        actions: NDArray[Any],
        reward_components: NDArray[Any],
        values: th.Tensor,
        log_probs: th.Tensor,
    ) -> None:
        """Put a step of all envs into the buffer."""
        raise NotImplementedError

    def _value_of(self, observations: PyTorchObs, dones: NDArray[np.bool_]) -> th.Tensor:
        """V of the observations after a step of all envs, shape (N, K).

        :param observations: one per env
        :param dones: which of them begin an episode, shape (N,)
        """
        raise NotImplementedError

    def _terminal_value_of(self, observations: PyTorchObs, indices: NDArray[np.int_]) -> th.Tensor:
        """V of the observations that a time limit cut off, shape (n, K).

        :param observations: terminal observations
        :param indices: numbers of their envs, shape (n,)
        """
        raise NotImplementedError

    def _first_value_of(self, observations: PyTorchObs) -> th.Tensor:
        """V of observations that begin an episode, shape (n, K)."""
        raise NotImplementedError

    def _to_env_actions(self, actions: NDArray[Any]) -> NDArray[Any]:
        """Bring the policy's actions into the bounds of the action space."""
        if not isinstance(self.action_space, spaces.Box):
            return actions
        if self.policy.squash_output:
            return self.policy.unscale_action(actions)
        return np.clip(actions, self.action_space.low, self.action_space.high)

    def _read_components(
        self, rewards: NDArray[Any], infos: Any
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        if self.n_components == 1:  # a VecEnv may then return no infos at all
            return rewards[:, None], rewards[:, None]
        assert self._reader is not None
        return self._reader.read(rewards, infos, self.num_timesteps)

    def _count_components(
        self, components: NDArray[Any], dones: NDArray[np.bool_], infos: Any
    ) -> None:
        """Keep the return of each component per episode, in the units of the env."""
        assert self._episode_components is not None
        self._episode_components += components
        ended = find_ended(dones, infos, self._is_monitored)
        returns = self._episode_components[ended]
        self.ep_component_buffer.extend(returns)
        self._ended_returns = dict(zip(ended.tolist(), returns.sum(1).tolist(), strict=True))
        self._episode_components[ended] = 0.0

    def _update_info_buffer(self, infos: Any, dones: NDArray[np.bool_] | None = None) -> None:
        """SB3's, but the return of an episode is the sum of its components."""
        if self.n_components > 1:
            infos = list(infos)
            for index, total in self._ended_returns.items():
                if index < len(infos) and "episode" in infos[index]:
                    episode = {**infos[index]["episode"], "r": total}
                    infos[index] = {**infos[index], "episode": episode}
        super()._update_info_buffer(infos, dones)

    def _listen(self, call: Callable[[], T]) -> T:
        """Call a callback, which may reset envs: their episodes then begin anew."""
        assert self.env is not None
        assert self._episode_components is not None
        with zero_on_reset(self.env, self._episode_components):
            return call()

    def _bootstrap(
        self, components: NDArray[Any], dones: NDArray[np.bool_], infos: Any
    ) -> NDArray[Any]:
        """Add the value of the terminal observation where a time limit ended the episode, all of
        them in one forward pass.
        """
        truncated = np.zeros(len(dones), dtype=bool)
        for index in np.flatnonzero(dones):
            info = infos[index] if len(infos) else {}
            truncated[index] = (
                info.get("TimeLimit.truncated", False)
                and info.get("terminal_observation") is not None
            )
        if not truncated.any():
            return components
        terminal = [infos[index]["terminal_observation"] for index in np.flatnonzero(truncated)]
        if isinstance(terminal[0], dict):
            observations: Any = {
                key: np.stack([row[key] for row in terminal]) for key in terminal[0]
            }
        else:
            observations = np.stack(terminal)
        with th.no_grad():
            terminal_values = self._terminal_value_of(
                self.policy.obs_to_tensor(observations)[0], np.flatnonzero(truncated)
            )
        return bootstrap_truncations(
            components, truncated, terminal_values.cpu().numpy(), self.gamma
        )

    def dump_logs(self, iteration: int = 0) -> None:
        """Write SB3's log, with the return of each component, and our own table of components.

        :param iteration: current logging iteration
        """
        assert self.env is not None
        n_diverged = outermost_attribute(self.env, "n_diverged")  # our batched envs count them
        if n_diverged is not None:
            self.logger.record("rollout/n_diverged", n_diverged)
        if self.n_components == 1:
            super().dump_logs(iteration)
            return
        if self.ep_component_buffer:
            means = np.mean(self.ep_component_buffer, axis=0)
            for name, value in zip(self.reward_spec.names, means, strict=True):
                self.logger.record(f"rollout/ep_rew/{name}", float(value), exclude="stdout")
        table = component_table(self.reward_spec, self.logger.name_to_value)
        super().dump_logs(iteration)
        self.logger.info(table)

"""GCRPPO: PPO that keeps the components of a reward apart and resolves the conflicts between their gradients."""

from __future__ import annotations

import inspect
import warnings
from collections import deque
from functools import partial
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Figure, TensorBoardOutputFormat
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import explained_variance, obs_as_tensor, update_learning_rate
from stable_baselines3.common.vec_env import VecEnv

from sb3_gcr.advantages import bootstrap_truncations, joint_scale, normalize_jointly
from sb3_gcr.buffers import VectorDictRolloutBuffer, VectorRolloutBuffer
from sb3_gcr.components import (
    GYMNASIUM_ENVS,
    SCALAR_REWARD,
    ComponentReader,
    RewardDecomposition,
    RewardSpec,
    find_reward_spec,
    match_specs,
    undecomposed_id,
)
from sb3_gcr.diagnostics import (
    MinibatchStatistics,
    append_cosines,
    component_table,
    cosine_figure,
    mean_cosines,
    summarise,
)
from sb3_gcr.gradients import ManyBackwards, clipped_surrogates, surrogate_cotangents, value_errors
from sb3_gcr.one_backward import OneBackward
from sb3_gcr.policies import CnnPolicy, MlpPolicy, MultiHeadActorCriticPolicy, MultiInputPolicy
from sb3_gcr.resolvers import RESOLVERS, Resolver
from sb3_gcr.schedules import adapt_learning_rate

SelfGCRPPO = TypeVar("SelfGCRPPO", bound="GCRPPO")

#: Every how many updates the cosine matrix goes to TensorBoard as a picture.
FIGURE_INTERVAL = 10


class GCRPPO(PPO):
    """PPO with gradient conflict resolution (GCR-PPO, arXiv:2509.14816): a critic head, advantage and gradient per component.

    The env must report its reward components (see :class:`~sb3_gcr.components.RewardDecomposition`); an id of Gymnasium's
    MuJoCo envs such as ``"Humanoid-v5"`` is taken apart by itself. Without components it is SB3's PPO. All parameters of
    SB3's PPO keep their names, order and defaults; these are added:

    :param resolver: name in ``RESOLVERS``, or a callable ``(gramian (K, K), levels (K,), rng) -> weights (K,)``
    :param resolver_kwargs: keyword arguments bound to the resolver
    :param advantage_scope: over what advantages are normalised jointly, "rollout" or "minibatch"; None is "rollout" for more
        than one component and "minibatch", as in PPO, for one
    :param kappa_max: bound of κ · max_k std(A^(k)), for components that cancel each other
    :param desired_kl: target of the learning rate that follows the KL divergence; None keeps ``learning_rate``
    :param gramian_method: "one_backward" for actors of linear layers, "passes" (K backward passes) for any network; "auto"
        takes the first where it fits. Both give the same numbers
    :param gramian_samples: number of samples of each minibatch that the weights are taken from, for large networks and
        batches; the step takes all of them. None is exact
    :raises ValueError: for an unknown resolver or scope, a wrong policy class, a spec that does not match a loaded model
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        n_steps: int = 2048,
        batch_size: int = 64,
        n_epochs: int = 10,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip_range: float | Schedule = 0.2,
        clip_range_vf: float | Schedule | None = None,
        normalize_advantage: bool = True,
        ent_coef: float = 0.0,
        vf_coef: float = 0.5,
        max_grad_norm: float = 0.5,
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        rollout_buffer_class: type[RolloutBuffer] | None = None,
        rollout_buffer_kwargs: dict[str, Any] | None = None,
        target_kl: float | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        resolver: str | Resolver = "gcr",
        resolver_kwargs: dict[str, Any] | None = None,
        advantage_scope: str | None = None,
        kappa_max: float = 10.0,
        desired_kl: float | None = None,
        gramian_method: str = "auto",
        gramian_samples: int | None = None,
    ):
        self.resolver = resolver
        self.resolver_kwargs = resolver_kwargs
        self.advantage_scope = advantage_scope
        self.kappa_max = kappa_max
        self.desired_kl = desired_kl
        self.gramian_method = gramian_method
        self.gramian_samples = gramian_samples
        self.reward_spec: RewardSpec | None = None
        self.ep_component_buffer: deque[NDArray[np.float64]] = deque(maxlen=stats_window_size)
        self._episode_components: NDArray[np.float64] | None = None
        self._resolver_rng: np.random.Generator | None = None
        self._adaptive_learning_rate: float | None = None
        if isinstance(env, str) and env in GYMNASIUM_ENVS:
            env = RewardDecomposition(maybe_make_env(env, verbose))
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            n_steps=n_steps,
            batch_size=batch_size,
            n_epochs=n_epochs,
            gamma=gamma,
            gae_lambda=gae_lambda,
            clip_range=clip_range,
            clip_range_vf=clip_range_vf,
            normalize_advantage=normalize_advantage,
            ent_coef=ent_coef,
            vf_coef=vf_coef,
            max_grad_norm=max_grad_norm,
            use_sde=use_sde,
            sde_sample_freq=sde_sample_freq,
            rollout_buffer_class=rollout_buffer_class,
            rollout_buffer_kwargs=rollout_buffer_kwargs,
            target_kl=target_kl,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
        )

    @property
    def n_objectives(self) -> int:
        """Number K of reward components."""
        return len(self.reward_spec or SCALAR_REWARD)

    # ------------------------------------------------------------------ setup

    def _setup_model(self) -> None:
        self._check_parameters()
        if self.env is not None:
            self._adopt_reward_spec(self.env)
        elif self.reward_spec is None:
            self.reward_spec = SCALAR_REWARD
        self._resolve = _bind_resolver(self.resolver, self.resolver_kwargs)
        loaded_rng = self._resolver_rng
        given = {name: getattr(self, name) for name in ("policy_kwargs", "rollout_buffer_class", "rollout_buffer_kwargs")}
        if not self._is_plain_ppo:
            self._choose_vector_classes()
        super()._setup_model()
        if not self._is_plain_ppo:
            self.__dict__.update(given)  # what a model saves is what its constructor was given
        if loaded_rng is not None:
            self._resolver_rng = loaded_rng
        elif self._resolver_rng is None:
            self._resolver_rng = np.random.default_rng()

    def _check_parameters(self) -> None:
        if self.advantage_scope not in (None, "rollout", "minibatch"):
            raise ValueError(
                f"Parameter `advantage_scope` must be 'rollout', 'minibatch' or None, found {self.advantage_scope!r}."
            )
        if not self.kappa_max > 0:
            raise ValueError(f"Parameter `kappa_max` must be a number > 0, found {self.kappa_max!r}.")
        if self.gramian_method not in ("auto", "one_backward", "passes"):
            raise ValueError(
                f"Parameter `gramian_method` must be 'auto', 'one_backward' or 'passes', found {self.gramian_method!r}."
            )
        if self.gramian_samples is not None and not self.gramian_samples > 0:
            raise ValueError(f"Parameter `gramian_samples` must be an integer > 0 or None, found {self.gramian_samples!r}.")
        if self.desired_kl is not None and not self.desired_kl > 0:
            raise ValueError(f"Parameter `desired_kl` must be a number > 0 or None, found {self.desired_kl!r}.")
        if any(base.__module__.startswith("sb3_contrib") for base in self.policy_class.__mro__):
            raise ValueError(_wrong_policy_message(self.policy_class.__name__))

    @property
    def _is_plain_ppo(self) -> bool:
        """One objective and none of our options: PPO's own code runs."""
        return self.n_objectives == 1 and self.desired_kl is None and self.advantage_scope in (None, "minibatch")

    def _adopt_reward_spec(self, env: VecEnv) -> None:
        """Take over the spec of an env, or check it against the one that the model was made with."""
        found = find_reward_spec(env)
        if self.reward_spec is not None:
            self.reward_spec = match_specs(self.reward_spec, found)
            return
        self.reward_spec = found or SCALAR_REWARD
        env_id = undecomposed_id(env)
        if env_id is not None:
            warnings.warn(
                f"'{env_id}' reports the terms of its reward, but nothing collects them, so GCRPPO trains one objective. "
                "Add the line `env = RewardDecomposition(env)`, or `make_vec_env(..., wrapper_class=RewardDecomposition)`.",
                stacklevel=2,
            )

    def _choose_vector_classes(self) -> None:
        """Let SB3's setup build a policy and a buffer with K heads."""
        if not issubclass(self.policy_class, MultiHeadActorCriticPolicy):
            if self.n_objectives > 1:
                raise ValueError(_wrong_policy_message(self.policy_class.__name__))
        else:
            self.policy_kwargs = {**self.policy_kwargs, "n_objectives": self.n_objectives}
        if self.rollout_buffer_class is None:
            is_dict = isinstance(self.observation_space, spaces.Dict)
            self.rollout_buffer_class = VectorDictRolloutBuffer if is_dict else VectorRolloutBuffer
        elif not issubclass(self.rollout_buffer_class, VectorRolloutBuffer):
            raise ValueError(
                "Parameter `rollout_buffer_class` must be a subclass of VectorRolloutBuffer for more than one reward "
                f"component, found {self.rollout_buffer_class.__name__}."
            )
        self.rollout_buffer_kwargs = {**self.rollout_buffer_kwargs, "n_objectives": self.n_objectives}

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        if policy_name not in self.policy_aliases:
            raise ValueError(_wrong_policy_message(policy_name))
        return self.policy_aliases[policy_name]

    def _maybe_recommend_cpu(self, mlp_class_name: str = MlpPolicy.__name__) -> None:
        super()._maybe_recommend_cpu(mlp_class_name)

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed all generators of SB3, and the one that the resolver draws from.

        :param seed: None leaves them as they are
        """
        super().set_random_seed(seed)
        if seed is not None:
            self._resolver_rng = np.random.default_rng(seed)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """SB3's ``set_env``; the reward components must be those of the model, their order may differ.

        :param env: the environment to learn from
        :param force_reset: reset it before training
        :raises ValueError: if the names differ
        """
        env = self._wrap_env(env, self.verbose)
        spec = match_specs(self.reward_spec or SCALAR_REWARD, find_reward_spec(env))
        super().set_env(env, force_reset)
        self.reward_spec = spec

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_resolve", "_reader", "_networks"]

    # --------------------------------------------------------------- rollouts

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        assert self.env is not None
        assert self.reward_spec is not None
        if self.n_objectives > 1 and find_reward_spec(self.env) is None:
            raise ValueError(
                f"The env reports no reward components, but the model has {self.n_objectives}: {self.reward_spec}. "
                "Wrap it with `RewardDecomposition`, or set another with `set_env`; `predict` works without."
            )
        if not self._is_plain_ppo:
            self._weigh(np.eye(self.n_objectives), np.random.default_rng(0))  # a wrong resolver fails before the first rollout
        resets = reset_num_timesteps or self._last_obs is None
        if resets or self._episode_components is None:
            self._episode_components = np.zeros((self.env.num_envs, self.n_objectives))
        if reset_num_timesteps:
            self.ep_component_buffer = deque(maxlen=self._stats_window_size)
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        self._reader = ComponentReader(self.env, self.reward_spec)
        if self.n_objectives > 1:
            self.logger.info(f"{self.n_objectives} reward components: {self.reward_spec}")
        else:
            self.logger.info("One reward component: training is SB3's PPO with one objective.")
        return result

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """SB3's ``collect_rollouts`` with reward components; a callback's ``locals["values"]`` has shape (N, K).

        :param env: training env
        :param callback: called at each step
        :param rollout_buffer: buffer to fill
        :param n_rollout_steps: number of steps per env
        :return: False if the callback stopped the rollout
        :raises ValueError: if the components of a step are missing, not finite, or do not sum to the reward
        """
        if self._is_plain_ppo:
            return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)
        assert self._last_obs is not None, "No previous observation was provided"
        self.policy.set_training_mode(False)
        rollout_buffer.reset()
        if self.use_sde:
            self.policy.reset_noise(env.num_envs)
        callback.on_rollout_start()
        for n_steps in range(n_rollout_steps):
            if self.use_sde and self.sde_sample_freq > 0 and n_steps % self.sde_sample_freq == 0:
                self.policy.reset_noise(env.num_envs)
            with th.no_grad():
                obs_tensor = obs_as_tensor(self._last_obs, self.device)  # type: ignore[arg-type]
                actions, values, log_probs = self.policy(obs_tensor)
            actions = actions.cpu().numpy()
            clipped_actions = self._to_env_actions(actions)
            new_obs, rewards, dones, infos = env.step(clipped_actions)
            self.num_timesteps += env.num_envs
            reward_components, original_components = self._read_components(rewards, infos)
            callback.update_locals(locals())
            if not callback.on_step():
                return False
            self._update_info_buffer(infos, dones)
            self._count_components(original_components, dones)
            reward_components = self._bootstrap(reward_components, dones, infos)
            rollout_buffer.add(self._last_obs, actions, reward_components, self._last_episode_starts, values, log_probs)  # type: ignore[arg-type]
            self._last_obs = new_obs  # type: ignore[assignment]
            self._last_episode_starts = dones
        with th.no_grad():
            values = self.policy.predict_values(obs_as_tensor(new_obs, self.device))  # type: ignore[arg-type]
        rollout_buffer.compute_returns_and_advantage(last_values=values, dones=dones)
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def _to_env_actions(self, actions: NDArray[Any]) -> NDArray[Any]:
        """Bring the policy's actions into the bounds of the action space."""
        if not isinstance(self.action_space, spaces.Box):
            return actions
        if self.policy.squash_output:
            return self.policy.unscale_action(actions)
        return np.clip(actions, self.action_space.low, self.action_space.high)

    def _read_components(self, rewards: NDArray[Any], infos: Any) -> tuple[NDArray[Any], NDArray[Any]]:
        if self.n_objectives == 1:  # a VecEnv may then return no infos at all
            return rewards[:, None], rewards[:, None]
        return self._reader.read(rewards, infos, self.num_timesteps)

    def _count_components(self, components: NDArray[Any], dones: NDArray[np.bool_]) -> None:
        """Keep the return of each component per episode, in the units of the env."""
        assert self._episode_components is not None
        self._episode_components += components
        self.ep_component_buffer.extend(self._episode_components[dones])
        self._episode_components[dones] = 0.0

    def _bootstrap(self, components: NDArray[Any], dones: NDArray[np.bool_], infos: Any) -> NDArray[Any]:
        """Add the value of the terminal observation where a time limit ended the episode, all of them in one forward pass."""
        truncated = np.zeros(len(dones), dtype=bool)
        for index in np.flatnonzero(dones):
            info = infos[index] if len(infos) else {}
            truncated[index] = info.get("TimeLimit.truncated", False) and info.get("terminal_observation") is not None
        if not truncated.any():
            return components
        terminal = [infos[index]["terminal_observation"] for index in np.flatnonzero(truncated)]
        if isinstance(terminal[0], dict):
            observations: Any = {key: np.stack([row[key] for row in terminal]) for key in terminal[0]}
        else:
            observations = np.stack(terminal)
        with th.no_grad():
            terminal_values = self.policy.predict_values(self.policy.obs_to_tensor(observations)[0])
        return bootstrap_truncations(components, truncated, terminal_values.cpu().numpy(), self.gamma)

    # ----------------------------------------------------------------- update

    def train(self) -> None:
        """Update the policy from the current rollout: the paper's method, minibatch by minibatch.

        :raises ValueError: if a loss or gradient is not finite, before it reaches the weights
        """
        self._check_rollout_is_finite()
        if self._is_plain_ppo:
            super().train()
            return
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        clip_range = self.clip_range(self._current_progress_remaining)  # type: ignore[operator]
        clip_range_vf = None
        if self.clip_range_vf is not None:
            clip_range_vf = self.clip_range_vf(self._current_progress_remaining)  # type: ignore[operator]
        self._networks = self._choose_networks()
        kappa = self._normalize_rollout()
        minibatches: list[MinibatchStatistics] = []
        continue_training = True
        for epoch in range(self.n_epochs):
            for batch in self.rollout_buffer.get(self.batch_size):
                statistics, continue_training = self._train_minibatch(batch, clip_range, clip_range_vf, len(minibatches) == 0)
                minibatches.append(statistics._replace(epoch=epoch, kappa=kappa or statistics.kappa))
                if not continue_training:
                    break
            self._n_updates += 1
            if not continue_training:
                break
        self._log_update(minibatches, clip_range, clip_range_vf)

    def _choose_networks(self) -> OneBackward | ManyBackwards:
        """The cheapest way through the policy that gives the exact Gramian."""
        fits = OneBackward.fits(self.policy)
        if self.gramian_method == "one_backward" and not fits:
            raise ValueError(
                "Parameter `gramian_method` must be 'auto' or 'passes' for this policy, found 'one_backward', which needs an "
                "actor and a critic of linear layers and common activations, a flat features extractor and no gSDE."
            )
        self.logger.record("gcr/one_backward", int(fits and self.gramian_method != "passes"))
        return ManyBackwards(self.policy) if self.gramian_method == "passes" or not fits else OneBackward(self.policy)

    def _check_rollout_is_finite(self) -> None:
        """Refuse a rollout with NaN or infinity, which rewards, observations or the networks may have brought in."""
        for name in ("log_probs", "values", "advantages"):
            if not np.isfinite(getattr(self.rollout_buffer, name)).all():
                raise ValueError(
                    f"The rollout's `{name}` must be finite, found NaN or infinity before the update at timestep "
                    f"{self.num_timesteps}. The policy is as it was; check rewards and observations, e.g. with VecCheckNan."
                )

    @property
    def _scope(self) -> str | None:
        if not self.normalize_advantage:
            return None
        return self.advantage_scope or ("rollout" if self.n_objectives > 1 else "minibatch")

    def _normalize_rollout(self) -> float | None:
        """Normalise the advantages of the whole rollout, if that is the scope, and return κ."""
        if self._scope != "rollout":
            return None
        advantages = self.rollout_buffer.advantages
        self.rollout_buffer.advantages = normalize_jointly(advantages, kappa_max=self.kappa_max)
        return float(joint_scale(advantages.reshape(-1, self.n_objectives), kappa_max=self.kappa_max))

    def _train_minibatch(
        self, batch: Any, clip_range: float, clip_range_vf: float | None, is_first: bool
    ) -> tuple[MinibatchStatistics, bool]:
        """One optimiser step; returns the minibatch's figures and whether ``target_kl`` lets training go on."""
        actions = batch.actions.long().flatten() if isinstance(self.action_space, spaces.Discrete) else batch.actions
        networks = self._networks.evaluate(batch.observations, actions)
        with th.no_grad():
            advantages, kappa = batch.advantages, th.ones(())
            if self._scope == "minibatch":
                kappa = th.as_tensor(joint_scale(advantages, kappa_max=self.kappa_max))
                advantages = normalize_jointly(advantages, kappa_max=self.kappa_max)
            surrogate = (networks.log_prob, batch.old_log_prob, advantages, clip_range)
            cotangents = surrogate_cotangents(*surrogate)
            value_losses, value_cotangents = value_errors(networks.values, batch.old_values, batch.returns, clip_range_vf)
            losses = th.cat([clipped_surrogates(*surrogate), value_losses])
        gramian = networks.gramian(cotangents, self.gramian_samples)
        with th.no_grad():
            kl, clip_fraction = _kl_and_clip_fraction(networks.log_prob, batch.old_log_prob, clip_range)
            scalars = th.stack([networks.entropy_loss(), clip_fraction, kl, kappa.to(kl.device)])
            host = th.cat([gramian.flatten(), losses, scalars]).cpu().double().numpy()
        statistics = self._resolve_minibatch(host)
        if self.target_kl is not None and statistics.approx_kl > 1.5 * self.target_kl:
            self.logger.info(f"Early stopping due to reaching max kl: {statistics.approx_kl:.2f}")
            return statistics, False
        if self.desired_kl is not None and not is_first:  # before the first step the KL divergence is 0 and says nothing
            self._set_learning_rate(adapt_learning_rate(self._learning_rate, statistics.approx_kl, self.desired_kl))
        weights = th.as_tensor(statistics.weights, dtype=cotangents.dtype, device=cotangents.device)
        networks.backward(cotangents @ weights, self.vf_coef * value_cotangents, self.ent_coef)
        norm = networks.clip_gradients(self.max_grad_norm).item()
        if not np.isfinite(norm):
            raise ValueError(self._not_finite_message("gradient norm", norm))
        self.policy.optimizer.step()
        return statistics, True

    def _resolve_minibatch(self, host: NDArray[np.float64]) -> MinibatchStatistics:
        """Unpack the one transfer of a minibatch and let the resolver weigh its components."""
        n = self.n_objectives
        if not np.isfinite(host).all():
            names = ["gradient Gramian"] * n * n + [f"{kind} loss" for kind in ("policy", "value") for _ in range(n)]
            name = [*names, "entropy loss", "clip fraction", "KL divergence", "κ"][int(np.argmin(np.isfinite(host)))]
            raise ValueError(self._not_finite_message(name, host[~np.isfinite(host)][0]))
        gramian, losses, scalars = host[: n * n].reshape(n, n), host[n * n : -4].reshape(2, n), host[-4:]
        assert self._resolver_rng is not None
        weights = self._weigh(gramian, self._resolver_rng)
        return MinibatchStatistics(0, gramian, weights, losses[0], losses[1], *scalars)

    def _weigh(self, gramian: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Call the resolver and check what it returns."""
        assert self.reward_spec is not None
        weights = np.asarray(self._resolve(gramian, np.array(self.reward_spec.levels), rng), dtype=float)
        if weights.shape != (self.n_objectives,):
            raise ValueError(
                f"Parameter `resolver` must return weights of shape ({self.n_objectives},), found shape {weights.shape}."
            )
        if not np.isfinite(weights).all():
            raise ValueError(f"Parameter `resolver` must return finite weights, found {weights}.")
        return weights

    def _not_finite_message(self, name: str, value: float) -> str:
        return (
            f"The {name} must be finite, found {value} in the update at timestep {self.num_timesteps}. The weights are those "
            "of the last good step; a smaller `learning_rate`, or scaled returns (VecNormalize), may help."
        )

    @property
    def _learning_rate(self) -> float:
        """The rate of the next step."""
        return float(self.policy.optimizer.param_groups[0]["lr"])

    def _set_learning_rate(self, learning_rate: float) -> None:
        self._adaptive_learning_rate = learning_rate
        update_learning_rate(self.policy.optimizer, learning_rate)

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        super()._update_learning_rate(optimizers)
        if self.desired_kl is not None and self._adaptive_learning_rate is not None:
            self._set_learning_rate(self._adaptive_learning_rate)

    # ---------------------------------------------------------------- logging

    def _log_update(self, minibatches: list[MinibatchStatistics], clip_range: float, clip_range_vf: float | None) -> None:
        """Record the means over all minibatches of the update under PPO's keys and ours."""
        assert self.reward_spec is not None
        scalars, by_component = summarise(minibatches, self.reward_spec)
        values, returns = self.rollout_buffer.values, self.rollout_buffer.returns
        for index, name in enumerate(self.reward_spec.names):
            by_component[f"train/explained_variance/{name}"] = explained_variance(
                values[..., index].flatten(), returns[..., index].flatten()
            )
        last = minibatches[-1]
        scalars["train/loss"] = (
            last.weights @ last.policy_losses + self.ent_coef * last.entropy_loss + self.vf_coef * last.value_losses.sum()
        )
        scalars["train/explained_variance"] = explained_variance(values.sum(-1).flatten(), returns.sum(-1).flatten())
        if hasattr(self.policy, "log_std"):
            scalars["train/std"] = th.exp(self.policy.log_std).mean().item()
        scalars["train/clip_range"] = clip_range
        if clip_range_vf is not None:
            scalars["train/clip_range_vf"] = clip_range_vf
        if self.desired_kl is not None:
            scalars["train/learning_rate"] = self._learning_rate
        for key, value in scalars.items():
            self.logger.record(key, value)
        for key, value in by_component.items():  # SB3's table raises when two keys are cut to the same 36 characters
            self.logger.record(key, value, exclude="stdout")
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self._log_cosines(mean_cosines(minibatches))

    def _log_cosines(self, matrix: NDArray[np.float64]) -> None:
        """Write the cosine matrix to its file, and every few updates to TensorBoard as a picture."""
        assert self.reward_spec is not None
        if self.n_objectives == 1 or self.logger.get_dir() is None:
            return
        append_cosines(self.logger.get_dir(), self.reward_spec, self.num_timesteps, matrix)
        updates = self._n_updates // self.n_epochs
        if updates % FIGURE_INTERVAL == 1 and any(isinstance(f, TensorBoardOutputFormat) for f in self.logger.output_formats):
            figure = Figure(cosine_figure(self.reward_spec, {f"{self.num_timesteps} steps": matrix}), close=False)
            self.logger.record("gcr/cosines", figure, exclude=("stdout", "log", "json", "csv"))

    def dump_logs(self, iteration: int = 0) -> None:
        """Write SB3's log, with the return of each component, and our own table of components.

        :param iteration: current logging iteration
        """
        if self.n_objectives == 1:
            super().dump_logs(iteration)
            return
        assert self.reward_spec is not None
        if self.ep_component_buffer:
            means = np.mean(self.ep_component_buffer, axis=0)
            for name, value in zip(self.reward_spec.names, means, strict=True):
                self.logger.record(f"rollout/ep_rew/{name}", float(value), exclude="stdout")
        table = component_table(self.reward_spec, self.logger.name_to_value)
        super().dump_logs(iteration)
        self.logger.info(table)

    def learn(
        self: SelfGCRPPO,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "GCRPPO",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfGCRPPO:
        """Train, as SB3's PPO does.

        :param total_timesteps: number of env steps
        :param callback: called at every step
        :param log_interval: log every so many rollouts
        :param tb_log_name: name of the run in TensorBoard
        :param reset_num_timesteps: whether to start counting from 0
        :param progress_bar: show a progress bar (needs tqdm and rich)
        :return: the model
        """
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)


def _bind_resolver(resolver: str | Resolver, resolver_kwargs: dict[str, Any] | None) -> Resolver:
    """The callable behind a resolver's name, with its keyword arguments bound."""
    if isinstance(resolver, str):
        if resolver not in RESOLVERS:
            raise ValueError(
                f"Parameter `resolver` must be one of {sorted(RESOLVERS)} or a callable "
                f"(gramian, levels, rng) -> weights, found {resolver!r}."
            )
        resolver = RESOLVERS[resolver]
    if not callable(resolver):
        raise TypeError(
            f"Parameter `resolver` must be one of {sorted(RESOLVERS)} or a callable "
            f"(gramian, levels, rng) -> weights, found {resolver!r}."
        )
    try:
        inspect.signature(resolver).bind(None, None, None, **(resolver_kwargs or {}))
    except TypeError as error:
        raise TypeError(
            f"Parameter `resolver_kwargs` must fit the resolver's signature (gramian, levels, rng, ...), "
            f"found {resolver_kwargs!r}: {error}."
        ) from None
    return partial(resolver, **(resolver_kwargs or {}))


def _wrong_policy_message(name: str) -> str:
    return (
        f"Parameter `policy` must be one of {sorted(GCRPPO.policy_aliases)} or a subclass of MultiHeadActorCriticPolicy, "
        f"found {name!r}. Recurrent and maskable policies are not supported."
    )


def _kl_and_clip_fraction(log_prob: th.Tensor, old_log_prob: th.Tensor, clip_range: float) -> tuple[th.Tensor, th.Tensor]:
    """KL(old ‖ current) by the estimator mean((ρ - 1) - log ρ), and the share of samples with abs(ρ - 1) > ε."""
    log_ratio = log_prob - old_log_prob
    excess = th.exp(log_ratio) - 1
    return (excess - log_ratio).mean(), (excess.abs() > clip_range).float().mean()

"""GCRPPO: PPO that keeps the components of a reward apart and resolves the conflicts between their
gradients.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Figure, TensorBoardOutputFormat
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import explained_variance, update_learning_rate

from sb3_gcr.advantages import joint_scale, normalize_jointly
from sb3_gcr.gradients.by_autograd import ManyBackwards
from sb3_gcr.gradients.by_hand import OneBackward
from sb3_gcr.logs.figures import (
    EpochStatistics,
    Minibatch,
    Samples,
    join,
    mean_cosines,
    measure_epoch,
    summarise,
)
from sb3_gcr.logs.shown import append_cosines, cosine_figure
from sb3_gcr.losses import kl_estimates, surrogate_cotangents, value_cotangents
from sb3_gcr.multi_head_ppo import MultiHeadPPO
from sb3_gcr.resolvers import Resolver, bind_resolver
from sb3_gcr.rewards.decomposition import GYMNASIUM_ENVS, RewardDecomposition
from sb3_gcr.saving.model import Saving
from sb3_gcr.schedules import adapt_learning_rate

SelfGCRPPO = TypeVar("SelfGCRPPO", bound="GCRPPO")

#: Every how many updates the cosine matrix goes to TensorBoard as a picture.
FIGURE_INTERVAL = 10


class GCRPPO(Saving, MultiHeadPPO):
    """PPO with gradient conflict resolution (GCR-PPO, arXiv:2509.14816): a critic head, advantage
    and gradient per component.

    The env must report its reward components (see
    :class:`~sb3_gcr.components.RewardDecomposition`); an id of Gymnasium's MuJoCo envs such as
        ``"Humanoid-v5"`` is taken apart by itself. Without components it is SB3's PPO. All
        parameters of
    SB3's PPO keep their names, order and defaults; these are added:

    :param resolver: name in ``RESOLVERS``, or a callable ``(gramian (K, K), levels (K,), rng) ->
        weights (K,)``
    :param resolver_kwargs: keyword arguments bound to the resolver
    :param advantage_scope: over what advantages are normalised jointly, "rollout" or "minibatch";
        None is "rollout" for more than one component and "minibatch", as in PPO, for one
    :param kappa_max: bound of κ · max_k std(A^(k)), for components that cancel each other
    :param desired_kl: target of the learning rate that follows the KL divergence; None keeps
        ``learning_rate``
    :param gramian_method: "one_backward" for actors of linear layers, "passes" (K backward passes)
        for any network; "auto" takes the first where it fits. Both give the same numbers
    :param gramian_samples: number of samples of each minibatch that the weights are taken from, for
        large networks and batches; the step takes all of them. None is exact
    :raises ValueError: for an unknown resolver or scope, a wrong policy class, a spec that does not
        match a loaded model
    """

    saved_numbers = ("_n_rollouts_learned", "_adaptive_learning_rate")
    unsaved = ("_resolve", "_networks")
    followers = (("_adaptive_learning_rate", "learning_rate"), ("_resolver_rng", "seed"))

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
        self._resolver_rng: np.random.Generator | None = None
        self._adaptive_learning_rate: float | None = None
        self._n_rollouts_learned = 0
        if isinstance(env, str) and env in GYMNASIUM_ENVS:
            env = RewardDecomposition(maybe_make_env(env, verbose))  # type: ignore[arg-type]
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

    def _setup_model(self) -> None:
        self._check_parameters()
        self._resolve = bind_resolver(self.resolver, self.resolver_kwargs)
        loaded_rng = self._resolver_rng
        super()._setup_model()
        self._resolver_rng = loaded_rng or self._resolver_rng or np.random.default_rng()

    def _check_parameters(self) -> None:
        if self.advantage_scope not in (None, "rollout", "minibatch"):
            raise ValueError(
                "Parameter `advantage_scope` must be 'rollout', 'minibatch' or None, found "
                f"{self.advantage_scope!r}."
            )
        if not self.kappa_max > 0:
            raise ValueError(
                f"Parameter `kappa_max` must be a number > 0, found {self.kappa_max!r}."
            )
        if self.gramian_method not in ("auto", "one_backward", "passes"):
            raise ValueError(
                "Parameter `gramian_method` must be 'auto', 'one_backward' or 'passes', found "
                f"{self.gramian_method!r}."
            )
        samples = self.gramian_samples
        if samples is not None and not (isinstance(samples, int | np.integer) and samples > 0):
            raise ValueError(
                "Parameter `gramian_samples` must be an integer > 0 or None, found "
                f"{self.gramian_samples!r}."
            )
        if self.desired_kl is not None and not self.desired_kl > 0:
            raise ValueError(
                f"Parameter `desired_kl` must be a number > 0 or None, found {self.desired_kl!r}."
            )

    @property
    def _is_plain_ppo(self) -> bool:
        return (
            super()._is_plain_ppo
            and self.desired_kl is None
            and self.advantage_scope in (None, "minibatch")
        )

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed all generators of SB3, and the one that the resolver draws from.

        :param seed: None leaves them as they are
        """
        super().set_random_seed(seed)
        if seed is not None:
            self._resolver_rng = np.random.default_rng(seed)

    def _setup_lr_schedule(self) -> None:
        super()._setup_lr_schedule()
        self._adaptive_learning_rate = None  # it has followed the schedule before

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        if not self._is_plain_ppo:  # a wrong resolver fails before the first rollout
            self._weigh(np.eye(self.n_objectives), np.random.default_rng(0))
        result = super()._setup_learn(*args, **kwargs)
        if not self._is_plain_ppo:
            networks = self._choose_networks()
            way = "one backward pass" if isinstance(networks, OneBackward) else "K backward passes"
            library = (
                "NumPy" if isinstance(networks, OneBackward) and networks.in_numpy else "PyTorch"
            )
            self.logger.info(f"Gradients of the components: {way} in {library}")
        return result

    @th.no_grad()
    @np.errstate(
        over="ignore", invalid="ignore"
    )  # what is not finite is refused with an error of its own
    def train(self) -> None:
        """Update the policy from the current rollout: the paper's method, minibatch by minibatch.

        :raises ValueError: if a gradient is not finite, before it reaches the weights
        """
        self._check_rollout_is_finite()
        if self._is_plain_ppo:
            with th.enable_grad():
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
        epochs: list[EpochStatistics] = []
        continue_training = True
        with self._networks.one_thread():
            while continue_training and len(epochs) < self.n_epochs:
                minibatches: list[Minibatch] = []
                for batch in self.rollout_buffer.get(self.batch_size):
                    is_first = not (epochs or minibatches)
                    minibatch, continue_training = self._train_minibatch(
                        batch, kappa, clip_range, clip_range_vf, is_first
                    )
                    minibatches.append(minibatch)
                    if not continue_training:
                        break
                epochs.append(measure_epoch(minibatches, clip_range, clip_range_vf))
        self._n_updates += len(epochs)
        self._n_rollouts_learned += 1
        self._log_update(epochs, clip_range, clip_range_vf)

    def _choose_networks(self) -> OneBackward | ManyBackwards:
        """The cheapest way through the policy that gives the exact Gramian."""
        fits = OneBackward.fits(self.policy)
        if self.gramian_method == "one_backward" and not fits:
            raise ValueError(
                "Parameter `gramian_method` must be 'auto' or 'passes' for this policy, found "
                "'one_backward', which needs an "
                "actor and a critic of linear layers and common activations, a flat features "
                "extractor and no gSDE."
            )
        self.logger.record("gcr/one_backward", int(fits and self.gramian_method != "passes"))
        if self.gramian_method == "passes" or not fits:
            return ManyBackwards(self.policy)
        return OneBackward(self.policy, self.batch_size)

    def _check_rollout_is_finite(self) -> None:
        """Refuse a rollout with NaN or infinity, which rewards, observations or the networks may
        have brought in.
        """
        for name in ("log_probs", "values", "advantages"):
            if not np.isfinite(getattr(self.rollout_buffer, name)).all():
                raise ValueError(
                    f"The rollout's `{name}` must be finite, found NaN or infinity before the "
                    "update at timestep "
                    f"{self.num_timesteps}. The policy is as it was; check rewards and "
                    "observations, e.g. with VecCheckNan."
                )

    @property
    def _scope(self) -> str | None:
        if not self.normalize_advantage:
            return None
        return self.advantage_scope or ("rollout" if self.n_objectives > 1 else "minibatch")

    def _normalize_rollout(self) -> th.Tensor | None:
        """Normalise the whole rollout's advantages, if that is the scope, and return κ; None if
        minibatches have theirs.
        """
        if self._scope == "minibatch":
            return None
        kappa = 1.0
        if self._scope == "rollout":
            advantages = self.rollout_buffer.advantages
            kappa = joint_scale(advantages.reshape(-1, self.n_objectives), kappa_max=self.kappa_max)
            self.rollout_buffer.advantages = normalize_jointly(advantages, kappa_max=self.kappa_max)
        return th.tensor(kappa, dtype=th.float32, device=self.device)

    def _train_minibatch(
        self,
        batch: Any,
        kappa: th.Tensor | None,
        clip_range: float,
        clip_range_vf: float | None,
        is_first: bool,
    ) -> tuple[Minibatch, bool]:
        """One optimiser step; returns what is logged of it and whether ``target_kl`` lets training
        go on.
        """
        actions = (
            batch.actions.long().flatten()
            if isinstance(self.action_space, spaces.Discrete)
            else batch.actions
        )
        networks = self._networks.evaluate(batch.observations, actions)
        tensors = batch.old_log_prob, batch.old_values, batch.returns, batch.advantages
        old_log_prob, old_values, returns, advantages = (
            networks.array(tensor) for tensor in tensors
        )
        if kappa is None:
            kappa = th.as_tensor(
                joint_scale(advantages, kappa_max=self.kappa_max), device=self.device
            )
            advantages = normalize_jointly(advantages, kappa_max=self.kappa_max)
        cotangents = surrogate_cotangents(networks.log_prob, old_log_prob, advantages, clip_range)
        needed = [networks.gramian(cotangents, self.gramian_samples).reshape(-1)]
        if self.target_kl is not None or self.desired_kl is not None:
            needed.append(kl_estimates(networks.log_prob, old_log_prob).mean().reshape(1))
        host = join(needed).cpu().numpy().astype(float)
        n = self.n_objectives
        gramian = host[: n * n].reshape(n, n)
        arrays = networks.log_prob, old_log_prob, advantages, networks.values, old_values, returns
        samples = Samples(*arrays, networks.entropy_loss(), kappa)
        if not np.isfinite(gramian).all():
            raise ValueError(
                self._not_finite_message(
                    Minibatch(samples, gramian, np.ones(n)), clip_range, clip_range_vf
                )
            )
        assert self._resolver_rng is not None
        minibatch = Minibatch(samples, gramian, self._weigh(gramian, self._resolver_rng))
        if self.target_kl is not None and host[-1] > 1.5 * self.target_kl:
            self.logger.info(f"Early stopping due to reaching max kl: {host[-1]:.2f}")
            return minibatch, False
        if (
            self.desired_kl is not None and not is_first
        ):  # before the first step the KL divergence is 0 and says nothing
            self._set_learning_rate(
                adapt_learning_rate(self._learning_rate, float(host[-1]), self.desired_kl)
            )
        weights = networks.array(
            th.from_numpy(minibatch.weights.astype(np.float32)).to(self.device)
        )
        value_gradients = value_cotangents(networks.values, old_values, returns, clip_range_vf)
        value_gradients *= self.vf_coef
        networks.backward(cotangents @ weights, value_gradients, self.ent_coef)
        norm = networks.clip_gradients(self.max_grad_norm)
        if not np.isfinite(norm):
            raise ValueError(self._not_finite_message(minibatch, clip_range, clip_range_vf, norm))
        self.policy.optimizer.step()
        return minibatch, True

    def _weigh(self, gramian: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Call the resolver and check what it returns."""
        weights = np.asarray(
            self._resolve(gramian, np.array(self.reward_spec.levels), rng), dtype=float
        )
        if weights.shape != (self.n_objectives,):
            raise ValueError(
                f"Parameter `resolver` must return weights of shape ({self.n_objectives},), found "
                f"shape {weights.shape}."
            )
        if not np.isfinite(weights).all():
            raise ValueError(f"Parameter `resolver` must return finite weights, found {weights}.")
        return weights

    def _not_finite_message(
        self,
        minibatch: Minibatch,
        clip_range: float,
        clip_range_vf: float | None,
        norm: float = np.inf,
    ) -> str:
        figures = measure_epoch([minibatch], clip_range, clip_range_vf)
        by_name = {
            "gradient Gramian": figures.gramians,
            "policy loss": figures.policy_losses,
            "value loss": figures.value_losses,
            "gradient norm": np.array(norm),
        }
        name, found = next(
            (name, found) for name, found in by_name.items() if not np.isfinite(found).all()
        )
        return (
            f"The {name} must be finite, found {found[~np.isfinite(found)][0]} in the update at "
            "timestep "
            f"{self.num_timesteps}. The weights are those of the last good step; a smaller "
            "`learning_rate`, or scaled "
            "returns (VecNormalize), may help."
        )

    @property
    def _learning_rate(self) -> float:
        """The rate of the next step."""
        return float(self.policy.optimizer.param_groups[0]["lr"])

    def _set_learning_rate(self, learning_rate: float) -> None:
        self._adaptive_learning_rate = learning_rate
        update_learning_rate(self.policy.optimizer, learning_rate)

    def _update_learning_rate(
        self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer
    ) -> None:
        super()._update_learning_rate(optimizers)
        if self.desired_kl is not None and self._adaptive_learning_rate is not None:
            self._set_learning_rate(self._adaptive_learning_rate)

    def _log_update(
        self, epochs: list[EpochStatistics], clip_range: float, clip_range_vf: float | None
    ) -> None:
        """Record the means over all minibatches of the update under PPO's keys and ours."""
        scalars, by_component = summarise(epochs, self.reward_spec)
        values, returns = self.rollout_buffer.values, self.rollout_buffer.returns
        for index, name in enumerate(self.reward_spec.names):
            by_component[f"train/explained_variance/{name}"] = explained_variance(
                values[..., index].flatten(), returns[..., index].flatten()
            )
        last = epochs[-1]
        policy_loss, value_loss = (
            last.weights[-1] @ last.policy_losses[-1],
            last.value_losses[-1].sum(),
        )
        scalars["train/loss"] = (
            policy_loss + self.ent_coef * last.entropy_losses[-1] + self.vf_coef * value_loss
        )
        scalars["train/explained_variance"] = explained_variance(
            values.sum(-1).flatten(), returns.sum(-1).flatten()
        )
        if hasattr(self.policy, "log_std"):
            scalars["train/std"] = th.exp(self.policy.log_std).mean().item()
        scalars["train/clip_range"] = clip_range
        if clip_range_vf is not None:
            scalars["train/clip_range_vf"] = clip_range_vf
        if self.desired_kl is not None:
            scalars["train/learning_rate"] = self._learning_rate
        for key, value in scalars.items():
            self.logger.record(key, value)
        for (
            key,
            value,
        ) in (
            by_component.items()
        ):  # SB3's table raises when two keys are cut to the same 36 characters
            self.logger.record(key, value, exclude="stdout")
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self._log_cosines(mean_cosines(epochs))

    def _log_cosines(self, matrix: NDArray[np.float64]) -> None:
        """Write the cosine matrix to its file, and every few updates to TensorBoard as a
        picture.
        """
        folder = self.logger.get_dir()
        if self.n_objectives == 1 or folder is None:
            return
        append_cosines(folder, self.reward_spec, self.num_timesteps, matrix)
        if self._n_rollouts_learned % FIGURE_INTERVAL == 1 and any(
            isinstance(f, TensorBoardOutputFormat) for f in self.logger.output_formats
        ):
            figure = Figure(
                cosine_figure(self.reward_spec, {f"{self.num_timesteps} steps": matrix}),
                close=False,
            )
            self.logger.record("gcr/cosines", figure, exclude=("stdout", "log", "json", "csv"))

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
        return super().learn(
            total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar
        )

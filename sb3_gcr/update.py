"""The update of GCR-PPO: one gradient per component, conflicts resolved, one step; for flat and
recurrent policies alike.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import update_learning_rate

from sb3_gcr.arguments import check_arguments
from sb3_gcr.averaging import GramianAverage
from sb3_gcr.checks import check_choice
from sb3_gcr.gradients import METHODS, ActorCritic
from sb3_gcr.gradients.by_hand import ByHand
from sb3_gcr.gradients.memory import Array, Weights
from sb3_gcr.logs.figures import Record, Samples, by_key, join, mean_cosines, of_rollout, unbiased
from sb3_gcr.logs.shown import CosineTable, log_cosines
from sb3_gcr.losses import CLIPPINGS, Clip, kl_estimates, surrogate_cotangents, value_cotangents
from sb3_gcr.minibatches import (
    SCOPES,
    Minibatch,
    Normalisation,
    minibatches,
    refuse_infinite_rollout,
)
from sb3_gcr.multi_head import MultiHead
from sb3_gcr.resolvers import Resolver, bind_resolver
from sb3_gcr.rewards.decomposition import GYMNASIUM_ENVS, RewardDecomposition
from sb3_gcr.schedules import adapt_learning_rate

#: Every how many updates the cosine matrix goes to TensorBoard as a picture.
FIGURE_INTERVAL = 10


class Update(NamedTuple):
    """What the minibatches of one update share; it ends with the update."""

    actor_critic: ActorCritic[Any]
    clip: Clip
    record: Record


class ConflictResolution(MultiHead):
    """The update of GCR-PPO, as a base before a PPO with K heads: parameters, gradients, resolver,
    step and log, for every kind of policy.

    Subclasses say what the parameters mean and which are their defaults; see
    :class:`~sb3_gcr.GCRPPO`.

    :param policy: name or class of the policy
    :param env: an env with reward components, or the id of one
    :param args: further arguments of the PPO
    :param kwargs: keyword arguments of the PPO
    :raises ValueError: for an unknown resolver or scope, a wrong policy class, a spec that does not
        match a loaded model
    """

    #: Kept in every file, see :class:`~sb3_gcr.saving.model.Saving`.
    saved_numbers: ClassVar[tuple[str, ...]] = ("_n_rollouts_learned", "_adaptive_learning_rate")
    unsaved: ClassVar[tuple[str, ...]] = ("_resolve", "_average")
    followers: ClassVar[tuple[tuple[str, str], ...]] = (
        ("_adaptive_learning_rate", "learning_rate"),
        ("_resolver_rng", "seed"),
    )

    #: Arguments of the PPO that may be None, though GCRPPO's may not.
    optional_arguments: ClassVar[tuple[str, ...]] = ()

    batch_size: int
    n_epochs: int
    clip_range: float | Schedule
    clip_range_vf: float | Schedule | None
    normalize_advantage: bool
    target_kl: float | None

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        *args: Any,
        resolver: str | Resolver,
        resolver_kwargs: dict[str, Any] | None,
        advantage_scope: str | None,
        kappa_max: float,
        desired_kl: float | None,
        gramian_method: str,
        gramian_samples: int | None,
        surrogate_clipping: str,
        gramian_average: int | None = None,
        **kwargs: Any,
    ):
        self.resolver = resolver
        self.resolver_kwargs = resolver_kwargs
        self.advantage_scope = advantage_scope
        self.kappa_max = kappa_max
        self.desired_kl = desired_kl
        self.gramian_method = gramian_method
        self.gramian_samples = gramian_samples
        self.surrogate_clipping = surrogate_clipping
        self.gramian_average = gramian_average
        self._average: GramianAverage | None = None
        self._resolver_rng: np.random.Generator | None = None
        self._adaptive_learning_rate: float | None = None
        self._n_rollouts_learned = 0
        if isinstance(env, str) and env in GYMNASIUM_ENVS:
            env = RewardDecomposition(maybe_make_env(env, kwargs.get("verbose", 0)))  # type: ignore[arg-type]
        super().__init__(policy, env, *args, **kwargs)

    def _setup_model(self) -> None:
        self._check_parameters()
        self._resolve = bind_resolver(self.resolver, self.resolver_kwargs)
        n_averaged = self.gramian_average
        self._average = None if n_averaged is None else GramianAverage(n_averaged)
        loaded_rng = self._resolver_rng
        super()._setup_model()
        self._resolver_rng = loaded_rng or self._resolver_rng or np.random.default_rng()

    def _check_parameters(self) -> None:
        check_choice("advantage_scope", self.advantage_scope, SCOPES, optional=True)
        check_choice("gramian_method", self.gramian_method, METHODS)
        check_choice("surrogate_clipping", self.surrogate_clipping, CLIPPINGS)
        check_arguments(vars(self), self.optional_arguments)  # of a loaded model, too

    @property
    def _is_scalar_ppo(self) -> bool:
        like_ppo = self.desired_kl is None and self.advantage_scope in (None, "minibatch")
        return super()._is_scalar_ppo and like_ppo

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed all generators of SB3, and the one that the resolver draws from.

        :param seed: None leaves them as they are
        """
        super().set_random_seed(None if seed is None else int(seed))  # NumPy's integers, too
        if seed is not None:
            self._resolver_rng = np.random.default_rng(seed)

    def _setup_lr_schedule(self) -> None:
        super()._setup_lr_schedule()
        self._adaptive_learning_rate = None  # it has followed the schedule before

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        if not self._is_scalar_ppo:  # a wrong resolver fails before the first rollout
            self._weigh(np.eye(self.n_components), np.random.default_rng(0))
        result = super()._setup_learn(*args, **kwargs)
        if not self._is_scalar_ppo:
            CosineTable.of(self.logger, self.reward_spec)
            way = self._choose_actor_critic().way
            self.logger.info(f"Gradients of the components: {way}")
        return result

    @th.no_grad()
    @np.errstate(over="ignore", invalid="ignore")  # what is not finite is refused by name
    def train(self) -> None:
        """Update the policy from the current rollout: the paper's method, minibatch by minibatch.

        :raises ValueError: if a gradient is not finite, before it reaches the weights; if the
            policy can give no distribution of actions
        """
        refuse_infinite_rollout(self.rollout_buffer, self.num_timesteps)
        with self._in_plain_words():
            if not self._is_scalar_ppo:
                self._train_components()
                return
            with th.enable_grad():
                super().train()

    def _train_components(self) -> None:
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        clip = self._clip()
        # Anew for each update: a callback may have frozen or replaced layers.
        actor_critic = self._choose_actor_critic()
        update = Update(actor_critic, clip, Record(clip))
        normalisation = Normalisation(self._scope, self.kappa_max).of_rollout(self.rollout_buffer)
        with actor_critic.session():
            for _ in range(self.n_epochs):
                actor_critic.begin_epoch()
                goes_on = self._train_epoch(update, normalisation)
                update.record.end_epoch()
                if not goes_on:
                    break
        self._n_updates += len(update.record.epochs)
        self._n_rollouts_learned += 1
        self._log_update(update)

    def _choose_actor_critic(self) -> ActorCritic[Any]:
        """How the policy, as it is now, is evaluated and differentiated."""
        raise NotImplementedError

    def _clip(self) -> Clip:
        """PPO's clip ranges now."""
        progress = self._current_progress_remaining
        clip_range: float = self.clip_range(progress)  # type: ignore[operator]
        clip_range_vf: float | None = None
        if self.clip_range_vf is not None:
            clip_range_vf = self.clip_range_vf(progress)  # type: ignore[operator]
        return Clip(clip_range, clip_range_vf, self.surrogate_clipping)

    @property
    def _scope(self) -> str | None:
        """Over what advantages are normalised."""
        if not self.normalize_advantage:
            return None
        return self.advantage_scope or ("rollout" if self.n_components > 1 else "minibatch")

    def _train_epoch(self, update: Update, normalisation: Normalisation) -> bool:
        """One pass over the rollout; False where ``target_kl`` ends the update before its end."""
        epoch = minibatches(
            self.rollout_buffer,
            self.batch_size,
            normalisation,
            update.actor_critic,
            discrete=isinstance(self.action_space, spaces.Discrete),
        )
        return all(self._train_minibatch(update, batch) for batch in epoch)

    def _train_minibatch(self, update: Update, batch: Minibatch) -> bool:
        """One optimiser step of the paper's method; False where ``target_kl`` ends the update."""
        actor_critic, clip, record = update
        values, log_prob = actor_critic.evaluate(batch.observations, batch.actions)  # V, log π
        cotangents = surrogate_cotangents(  # c (B, K)
            log_prob, batch.old_log_prob, batch.advantages, clip
        )
        gramian, kl = self._to_host(  # G (K, K)
            actor_critic.gramian(cotangents, self.gramian_samples), log_prob, batch.old_log_prob
        )
        weights = self._weigh(self._seen(gramian, actor_critic), self._resolver_rng)  # w (K,)
        # Later epochs have the same samples, and so nothing new to say.
        unbiased_gramian = None if record.epochs else actor_critic.unbiased_gramian()
        record.add(
            _samples(batch, values, log_prob),
            actor_critic.entropy_loss(),
            batch.kappa,
            gramian,
            weights,
            unbiased_gramian,
        )
        if self._leaves_target(kl):
            return False
        self._follow(kl, is_first=len(record) == 1)
        value_gradients = self.vf_coef * value_cotangents(
            values, batch.old_values, batch.returns, clip.values
        )
        actor_critic.backward(cotangents, weights, value_gradients, self.ent_coef)  # d = Jᵀ w
        self._refuse_infinite(record, actor_critic.clip_gradients(self.max_grad_norm))
        self.policy.optimizer.step()
        return True

    def _seen(
        self, gramian: NDArray[np.float64], actor_critic: ActorCritic[Any]
    ) -> NDArray[np.float64]:
        """What the resolver sees: the minibatch's own G, or an average of unbiased ones."""
        if self._average is None:
            return gramian
        found = actor_critic.unbiased_gramian()
        host = None if found is None else join([found]).cpu().numpy().astype(float)
        average = self._average.add(host)
        return gramian if average is None else average

    def _to_host(
        self, gramian: Array, log_prob: Array, old_log_prob: Array
    ) -> tuple[NDArray[np.float64], float | None]:
        """One transfer from the device: G, and the KL divergence where a rule needs it.

        :raises ValueError: if G is not finite
        """
        parts = [gramian.reshape(-1)]
        needs_kl = self.target_kl is not None or self.desired_kl is not None
        if needs_kl:
            parts.append(kl_estimates(log_prob, old_log_prob).mean().reshape(1))
        host = join(parts).cpu().numpy().astype(float)
        gramian = host[: self.n_components**2].reshape(self.n_components, self.n_components)
        if not np.isfinite(gramian).all():
            raise ValueError(self._not_finite_message("gradient Gramian", gramian))
        return gramian, float(host[-1]) if needs_kl else None

    def _weigh(self, gramian: NDArray[np.float64], rng: np.random.Generator | None) -> Weights:
        """Call the resolver and check what it returns."""
        assert rng is not None
        levels = np.array(self.reward_spec.levels)
        weights = np.asarray(self._resolve(gramian, levels, rng), dtype=float)
        if weights.shape != (self.n_components,):
            raise ValueError(
                "Parameter `resolver` must return weights of shape "
                f"({self.n_components},), found shape {weights.shape}."
            )
        if not np.isfinite(weights).all():
            raise ValueError(f"Parameter `resolver` must return finite weights, found {weights}.")
        if not all(self._has_paid):
            return np.where(self.has_paid, weights, 1.0)
        return weights

    def _leaves_target(self, kl: float | None) -> bool:
        """Whether the policy has moved further than ``target_kl`` allows, as in SB3's PPO."""
        if self.target_kl is None or kl is None or kl <= 1.5 * self.target_kl:
            return False
        self.logger.info(f"Early stopping due to reaching max kl: {kl:.2f}")
        return True

    def _follow(self, kl: float | None, is_first: bool) -> None:
        """Let the learning rate follow the KL divergence, which says nothing before a step."""
        if self.desired_kl is None or kl is None or is_first:
            return
        rate = float(self.policy.optimizer.param_groups[0]["lr"])
        self._set_learning_rate(adapt_learning_rate(rate, kl, self.desired_kl))

    def _set_learning_rate(self, learning_rate: float) -> None:
        self._adaptive_learning_rate = learning_rate
        update_learning_rate(self.policy.optimizer, learning_rate)

    def _update_learning_rate(
        self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer
    ) -> None:
        super()._update_learning_rate(optimizers)
        if self.desired_kl is not None and self._adaptive_learning_rate is not None:
            self._set_learning_rate(self._adaptive_learning_rate)

    def _refuse_infinite(self, record: Record, norm: float) -> None:
        """Refuse a gradient that is not finite, and say which loss made it so."""
        if np.isfinite(norm):
            return
        record.end_epoch()
        figures = record.epochs[-1]
        suspects = {
            "policy loss": figures.policy_losses[-1],
            "value loss": figures.value_losses[-1],
        }
        for name, found in suspects.items():
            if not np.isfinite(found).all():
                raise ValueError(self._not_finite_message(name, found))
        raise ValueError(self._not_finite_message("gradient norm", np.array([norm])))

    def _not_finite_message(self, name: str, found: NDArray[np.float64]) -> str:
        return (
            f"The {name} must be finite, found {found[~np.isfinite(found)][0]} in the update at "
            f"timestep {self.num_timesteps}. The weights are those of the last good step; a "
            "smaller `learning_rate`, or scaled returns (VecNormalize), may help."
        )

    def _log_update(self, update: Update) -> None:
        """Record the means over all minibatches of the update under PPO's keys and ours."""
        scalars, components = by_key(update.record, self.reward_spec)
        buffer_scalars, buffer_components = of_rollout(self.rollout_buffer, self.reward_spec)
        scalars |= buffer_scalars
        components |= buffer_components
        scalars["train/loss"] = update.record.last_loss(self.ent_coef, self.vf_coef)
        if hasattr(self.policy, "log_std"):
            scalars["train/std"] = th.exp(self.policy.log_std).mean().item()
        scalars["train/clip_range"] = update.clip.policy
        if update.clip.values is not None:
            scalars["train/clip_range_vf"] = update.clip.values
        if self.desired_kl is not None:
            scalars["train/learning_rate"] = self.policy.optimizer.param_groups[0]["lr"]
        scalars["gcr/one_backward"] = float(isinstance(update.actor_critic, ByHand))
        for key, value in scalars.items():
            self.logger.record(key, value)
        for key, value in components.items():  # SB3's table raises when two cut keys are the same
            self.logger.record(key, value, exclude="stdout")
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if self.n_components > 1:
            as_picture = self._n_rollouts_learned % FIGURE_INTERVAL == 1
            log_cosines(
                self.logger,
                self.reward_spec,
                self.num_timesteps,
                mean_cosines(update.record),
                unbiased(update.record),
                as_picture,
            )


def _samples(batch: Minibatch, values: Array, log_prob: Array) -> Samples:
    """What the record keeps of a minibatch."""
    return Samples(
        log_prob=log_prob,
        old_log_prob=batch.old_log_prob,
        advantages=batch.advantages,
        values=values,
        old_values=batch.old_values,
        returns=batch.returns,
    )

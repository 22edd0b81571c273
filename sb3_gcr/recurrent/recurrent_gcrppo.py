"""RecurrentGCRPPO: GCR-PPO for policies with memory."""

from __future__ import annotations

from typing import Any, TypeVar

import torch as th
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_gcr.arguments import check_arguments
from sb3_gcr.gradients import ActorCritic
from sb3_gcr.recurrent.by_autograd import RecurrentByAutograd
from sb3_gcr.recurrent.multi_head_ppo import MultiHeadRecurrentPPO
from sb3_gcr.recurrent.sequences import Sequences
from sb3_gcr.resolvers import Resolver
from sb3_gcr.saving.model import Saving
from sb3_gcr.update import ConflictResolution

SelfRecurrentGCRPPO = TypeVar("SelfRecurrentGCRPPO", bound="RecurrentGCRPPO")


class RecurrentGCRPPO(Saving, ConflictResolution, MultiHeadRecurrentPPO):  # type: ignore[misc]
    """GCR-PPO for policies with an LSTM: sb3-contrib's ``RecurrentPPO`` with a critic head,
    advantage and gradient per reward component.

    The env must report its reward components, as for :class:`~sb3_gcr.GCRPPO`. Without components
    it is sb3-contrib's ``RecurrentPPO``. All parameters of that class keep their names, order and
    defaults; these are added, with the meaning that they have for GCRPPO:

    :param resolver: name in ``RESOLVERS``, or a callable ``(gramian (K, K), levels (K,), rng) ->
        weights (K,)``
    :param resolver_kwargs: keyword arguments bound to the resolver
    :param advantage_scope: over what advantages are normalised jointly, "rollout" or "minibatch";
        None is "rollout" for more than one component and "minibatch", as in PPO, for one
    :param kappa_max: bound of κ · max_k std(A^(k)), for components that cancel each other
    :param desired_kl: target of the learning rate that follows the KL divergence; None keeps
        ``learning_rate``
    :param gramian_method: "auto" or "passes": K backward passes through the sequences
    :param gramian_samples: number of steps of each minibatch that the weights are taken from, in
        whole sequences drawn at random; the step takes all of them. None is exact
    :param surrogate_clipping: what decides whether a sample is clipped: "joint", the summed
        advantage as in PPO, or "component", each component's own as in the paper
    :raises ValueError: for an unknown resolver or scope, a wrong policy class, a spec that does not
        match a loaded model
    """

    optional_arguments = ("batch_size",)  # None is the whole rollout

    def __init__(
        self,
        policy: str | type[RecurrentActorCriticPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        n_steps: int = 128,
        batch_size: int | None = 128,
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
        surrogate_clipping: str = "joint",
    ):
        check_arguments(locals(), self.optional_arguments)
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
            target_kl=target_kl,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
            resolver=resolver,
            resolver_kwargs=resolver_kwargs,
            advantage_scope=advantage_scope,
            kappa_max=kappa_max,
            desired_kl=desired_kl,
            gramian_method=gramian_method,
            gramian_samples=gramian_samples,
            surrogate_clipping=surrogate_clipping,
        )

    def _check_parameters(self) -> None:
        super()._check_parameters()
        if self.gramian_method == "one_backward":
            raise ValueError(
                "Parameter `gramian_method` must be 'auto' or 'passes' for a recurrent policy, "
                "found 'one_backward': the steps of a sequence share their past, and one backward "
                "pass does not tell them apart."
            )

    def _choose_actor_critic(self) -> ActorCritic[Sequences]:
        assert self._resolver_rng is not None
        return RecurrentByAutograd(self.policy, self._resolver_rng)

    def learn(
        self: SelfRecurrentGCRPPO,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "RecurrentGCRPPO",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfRecurrentGCRPPO:
        """Train, as sb3-contrib's ``RecurrentPPO`` does.

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

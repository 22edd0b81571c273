"""GCRPPO: PPO that keeps the components of a reward apart and resolves the conflicts between their
gradients.
"""

from __future__ import annotations

from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, PyTorchObs, Schedule

from sb3_gcr.arguments import check_arguments
from sb3_gcr.gradients import ActorCritic, choose
from sb3_gcr.multi_head_ppo import MultiHeadPPO
from sb3_gcr.resolvers import Resolver
from sb3_gcr.saving.model import Saving
from sb3_gcr.update import ConflictResolution

SelfGCRPPO = TypeVar("SelfGCRPPO", bound="GCRPPO")


class GCRPPO(Saving, ConflictResolution, MultiHeadPPO):
    """PPO with gradient conflict resolution (GCR-PPO, arXiv:2509.14816): a critic head, advantage
    and gradient per component.

    The env must report its reward components (see
    :class:`~sb3_gcr.rewards.decomposition.RewardDecomposition`); an id of Gymnasium's MuJoCo envs
    such as ``"Humanoid-v5"`` is taken apart by itself. Without components it is SB3's PPO. All
    parameters of SB3's PPO keep their names, order and defaults; these are added:

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
    :param surrogate_clipping: what decides whether a sample is clipped: "joint", the summed
        advantage as in PPO, or "component", each component's own as in the paper, which holds the
        policy back wherever components disagree
    :param gramian_average: an experiment: resolvers see unbiased Gramians, averaged over about so
        many minibatches, in place of the minibatch's own; None is the paper's
    :raises ValueError: for an unknown resolver or scope, a wrong policy class, a spec that does not
        match a loaded model
    """

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
        surrogate_clipping: str = "joint",
        gramian_average: int | None = None,
    ):
        check_arguments(locals())
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
            resolver=resolver,
            resolver_kwargs=resolver_kwargs,
            advantage_scope=advantage_scope,
            kappa_max=kappa_max,
            desired_kl=desired_kl,
            gramian_method=gramian_method,
            gramian_samples=gramian_samples,
            surrogate_clipping=surrogate_clipping,
            gramian_average=gramian_average,
        )

    def _choose_actor_critic(self) -> ActorCritic[PyTorchObs]:
        return choose(self.policy, self.gramian_method, self.batch_size)

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

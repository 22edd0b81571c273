"""Actor-critic policies whose value head has one output per reward component."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch as th
from gymnasium.vector.utils import create_empty_array
from stable_baselines3.common.policies import (
    ActorCriticCnnPolicy,
    ActorCriticPolicy,
    MultiInputActorCriticPolicy,
)
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_gcr.optimisers import FusedAdam


def check_value_heads(
    policy: ActorCriticPolicy,
    n_components: int,
    value_of: Callable[[PyTorchObs], th.Tensor],
) -> None:
    """Refuse a critic that does not give one value per reward component.

    A single one would be taken for the value of every component without a word.

    :param policy: its training mode and all generators stay as they are
    :param n_components: number K of reward components
    :param value_of: the critic: V of observations
    :raises ValueError: names the shape that was found
    """
    observations: Any = create_empty_array(policy.observation_space, 2, np.zeros)
    was_training = policy.training
    policy.set_training_mode(False)
    with th.random.fork_rng(devices=[]), th.no_grad():
        values = value_of(policy.obs_to_tensor(observations)[0])
    policy.set_training_mode(was_training)
    if values.shape == (2, n_components):
        return
    found = ", ".join(["B", *map(str, values.shape[1:])])
    raise ValueError(
        "Parameter `policy` must have a critic with one value per reward component, shape "
        f"(B, {n_components}), found shape ({found}{',' if values.ndim == 1 else ''}). Give the "
        "last layer `self.n_components` outputs."
    )


class MultiHeadActorCriticPolicy(ActorCriticPolicy):
    """SB3's ``ActorCriticPolicy`` with V_φ(s) ∈ R^K: ``predict_values``, ``forward`` and
    ``evaluate_actions`` return (B, K).

    With ``n_components=1`` it is SB3's policy, weight for weight.

    :param args: the arguments of SB3's policy
    :param n_components: number K of value heads; ``GCRPPO`` sets it, it does not belong in
        ``policy_kwargs``
    :param kwargs: the keyword arguments of SB3's policy
    """

    def __init__(self, *args: Any, n_components: int = 1, **kwargs: Any):
        # Policies saved before the first release call it n_objectives.
        n_components = kwargs.pop("n_objectives", n_components)
        self.n_components = n_components
        self._fuse_optimizer = (
            n_components > 1
            and kwargs.get("optimizer_class") is None
            and kwargs.get("optimizer_kwargs") is None
        )
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        if self.n_components == 1:
            return
        self.value_net = nn.Linear(self.mlp_extractor.latent_dim_vf, self.n_components)
        if self.ortho_init:
            self.value_net.apply(partial(self.init_weights, gain=1))
        self._make_optimizer(lr_schedule(1))

    def _make_optimizer(self, learning_rate: float) -> None:
        """Anew, for the K heads; the fused Adam takes the same steps up to rounding, and is taken
        only where the user chose no optimiser of their own.
        """
        optimizer_class: Any = FusedAdam if self._fuse_optimizer else self.optimizer_class
        self.optimizer = optimizer_class(
            self.parameters(), lr=learning_rate, **self.optimizer_kwargs
        )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        # SB3 leaves share_features_extractor out, and a saved policy would come back with another
        # architecture.
        return {
            **data,
            "n_components": self.n_components,
            "share_features_extractor": self.share_features_extractor,
        }


class MultiHeadActorCriticCnnPolicy(MultiHeadActorCriticPolicy, ActorCriticCnnPolicy):
    """:class:`MultiHeadActorCriticPolicy` for images: SB3's ``CnnPolicy`` with K value heads."""


class MultiHeadMultiInputActorCriticPolicy(MultiHeadActorCriticPolicy, MultiInputActorCriticPolicy):
    """:class:`MultiHeadActorCriticPolicy` for dictionary observations: SB3's ``MultiInputPolicy``
    with K value heads.
    """


MlpPolicy = MultiHeadActorCriticPolicy
CnnPolicy = MultiHeadActorCriticCnnPolicy
MultiInputPolicy = MultiHeadMultiInputActorCriticPolicy

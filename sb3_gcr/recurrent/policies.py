"""Recurrent actor-critic policies whose value head has one output per reward component."""

from __future__ import annotations

from typing import Any

from sb3_contrib.common.recurrent.policies import (
    RecurrentActorCriticCnnPolicy,
    RecurrentActorCriticPolicy,
    RecurrentMultiInputActorCriticPolicy,
)

from sb3_gcr.policies import MultiHeadActorCriticPolicy


class MultiHeadRecurrentActorCriticPolicy(MultiHeadActorCriticPolicy, RecurrentActorCriticPolicy):
    """sb3-contrib's ``RecurrentActorCriticPolicy`` with V_φ(s) ∈ R^K: ``predict_values``,
    ``forward`` and ``evaluate_actions`` return (B, K).

    With ``n_components=1`` it is sb3-contrib's policy, weight for weight. The critic has an LSTM of
    its own, shares the actor's (``shared_lstm``), or has none (``enable_critic_lstm=False``).

    :param args: the arguments of sb3-contrib's policy
    :param n_components: number K of value heads; ``RecurrentGCRPPO`` sets it, it does not belong in
        ``policy_kwargs``
    :param kwargs: the keyword arguments of sb3-contrib's policy
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        if self.n_components > 1:  # sb3-contrib has made one after the LSTMs
            self._make_optimizer(self.optimizer.param_groups[0]["lr"])

    def _get_constructor_parameters(self) -> dict[str, Any]:
        # sb3-contrib leaves the LSTM out, and a saved policy would come back with another.
        return {
            **super()._get_constructor_parameters(),
            "lstm_hidden_size": self.lstm_actor.hidden_size,
            "n_lstm_layers": self.lstm_actor.num_layers,
            "shared_lstm": self.shared_lstm,
            "enable_critic_lstm": self.enable_critic_lstm,
            "lstm_kwargs": self.lstm_kwargs,
        }


class MultiHeadRecurrentActorCriticCnnPolicy(
    MultiHeadRecurrentActorCriticPolicy, RecurrentActorCriticCnnPolicy
):
    """:class:`MultiHeadRecurrentActorCriticPolicy` for images: sb3-contrib's ``CnnLstmPolicy`` with
    K value heads.
    """


class MultiHeadRecurrentMultiInputActorCriticPolicy(
    MultiHeadRecurrentActorCriticPolicy, RecurrentMultiInputActorCriticPolicy
):
    """:class:`MultiHeadRecurrentActorCriticPolicy` for dictionary observations: sb3-contrib's
    ``MultiInputLstmPolicy`` with K value heads.
    """


MlpLstmPolicy = MultiHeadRecurrentActorCriticPolicy
CnnLstmPolicy = MultiHeadRecurrentActorCriticCnnPolicy
MultiInputLstmPolicy = MultiHeadRecurrentMultiInputActorCriticPolicy

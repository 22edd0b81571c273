"""sb3-contrib's RecurrentPPO on reward vectors: everything around the update."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import obs_as_tensor

from sb3_gcr.multi_head import MultiHead
from sb3_gcr.recurrent.buffers import (
    VectorRecurrentDictRolloutBuffer,
    VectorRecurrentRolloutBuffer,
)
from sb3_gcr.recurrent.policies import (
    CnnLstmPolicy,
    MlpLstmPolicy,
    MultiHeadRecurrentActorCriticPolicy,
    MultiInputLstmPolicy,
)
from sb3_gcr.recurrent.sequences import States


class MultiHeadRecurrentPPO(MultiHead, RecurrentPPO):
    """sb3-contrib's ``RecurrentPPO`` with a critic head and a return per reward component; the
    update is left to a subclass.

    With one component, and nothing that asks for more, sb3-contrib's own code runs.

    :param args: the arguments of ``RecurrentPPO``
    :param kwargs: the keyword arguments of ``RecurrentPPO``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpLstmPolicy": MlpLstmPolicy,
        "CnnLstmPolicy": CnnLstmPolicy,
        "MultiInputLstmPolicy": MultiInputLstmPolicy,
    }
    multi_head_policy = MultiHeadRecurrentActorCriticPolicy
    policy_kind = "recurrent"

    policy: RecurrentActorCriticPolicy
    #: States of the LSTMs before the next step of the rollout.
    _last_lstm_states: RNNStates  # type: ignore[assignment]
    #: The same after it.
    _next_lstm_states: RNNStates

    def _setup_model(self) -> None:
        super()._setup_model()
        if not self._is_scalar_ppo:
            self.rollout_buffer = self._make_buffer()

    def _make_buffer(self) -> VectorRecurrentRolloutBuffer | VectorRecurrentDictRolloutBuffer:
        """A buffer for K components in place of sb3-contrib's."""
        is_dict = isinstance(self.observation_space, spaces.Dict)
        lstm = self.policy.lstm_actor
        return (VectorRecurrentDictRolloutBuffer if is_dict else VectorRecurrentRolloutBuffer)(
            self.n_steps,
            self.observation_space,
            self.action_space,
            (self.n_steps, lstm.num_layers, self.n_envs, lstm.hidden_size),
            self.device,
            gamma=self.gamma,
            gae_lambda=self.gae_lambda,
            n_envs=self.n_envs,
            n_components=self.n_components,
        )

    def _act(self) -> tuple[NDArray[Any], th.Tensor, th.Tensor]:
        observations = obs_as_tensor(self._last_obs, self.device)  # type: ignore[arg-type]
        actions, values, log_probs, self._next_lstm_states = self.policy(
            observations,
            self._last_lstm_states,
            self._starts(self._last_episode_starts),  # type: ignore[arg-type]
        )
        return actions.cpu().numpy(), values, log_probs

    def _add_step(
        self,
        rollout_buffer: RolloutBuffer,
        actions: NDArray[Any],
        reward_components: NDArray[Any],
        values: th.Tensor,
        log_probs: th.Tensor,
    ) -> None:
        rollout_buffer.add(  # type: ignore[call-arg]
            self._last_obs,  # type: ignore[arg-type]
            actions,
            reward_components,
            self._last_episode_starts,  # type: ignore[arg-type]
            values,
            log_probs,
            lstm_states=self._last_lstm_states,
        )
        self._last_lstm_states = self._next_lstm_states

    def _value_of(self, observations: PyTorchObs, dones: NDArray[np.bool_]) -> th.Tensor:
        return self._evaluate(observations, self._last_lstm_states.vf, dones)

    def _terminal_value_of(self, observations: PyTorchObs, indices: NDArray[np.int_]) -> th.Tensor:
        # The critic has seen the episode up to the step before its terminal observation.
        states: States = tuple(state[:, indices] for state in self._next_lstm_states.vf)
        return self._evaluate(observations, states, np.zeros(len(indices)))

    def _first_value_of(self, observations: PyTorchObs) -> th.Tensor:
        arrays = observations.values() if isinstance(observations, dict) else [observations]
        n_observations = len(next(iter(arrays)))
        n_layers, _, n_units = self.policy.lstm_hidden_state_shape
        zeros = th.zeros(n_layers, n_observations, n_units, device=self.device)
        return self._evaluate(observations, (zeros, zeros), np.ones(n_observations))

    def _evaluate(
        self, observations: PyTorchObs, states: States, starts: NDArray[Any]
    ) -> th.Tensor:
        """V of observations that come after states of the critic's LSTM."""
        return self.policy.predict_values(
            observations,  # type: ignore[arg-type]
            states,  # type: ignore[arg-type]
            self._starts(starts),
        )

    def _starts(self, starts: NDArray[Any]) -> th.Tensor:
        return th.tensor(starts, dtype=th.float32, device=self.device)

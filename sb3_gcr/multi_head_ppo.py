"""SB3's PPO on reward vectors: what a policy without memory needs around the update."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import obs_as_tensor

from sb3_gcr.buffers import VectorDictRolloutBuffer, VectorRolloutBuffer
from sb3_gcr.multi_head import MultiHead
from sb3_gcr.policies import CnnPolicy, MlpPolicy, MultiHeadActorCriticPolicy, MultiInputPolicy


class MultiHeadPPO(MultiHead, PPO):
    """SB3's PPO with a critic head and a return per reward component; the update is left to a
    subclass.

    With one component, and nothing that asks for more, SB3's own code runs.

    :param args: the arguments of SB3's PPO
    :param kwargs: the keyword arguments of SB3's PPO
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    multi_head_policy = MultiHeadActorCriticPolicy
    policy_kind = "flat"

    def _choose_vector_classes(self) -> None:
        """Let SB3's setup build a policy and a buffer with K heads."""
        super()._choose_vector_classes()
        if self.rollout_buffer_class is None:
            is_dict = isinstance(self.observation_space, spaces.Dict)
            self.rollout_buffer_class = VectorDictRolloutBuffer if is_dict else VectorRolloutBuffer
        elif not issubclass(self.rollout_buffer_class, VectorRolloutBuffer):
            raise ValueError(
                "Parameter `rollout_buffer_class` must be a subclass of VectorRolloutBuffer for "
                "more than one reward "
                f"component, found {self.rollout_buffer_class.__name__}."
            )
        self.rollout_buffer_kwargs = {
            **self.rollout_buffer_kwargs,
            "n_components": self.n_components,
        }

    def _maybe_recommend_cpu(self, mlp_class_name: str = MlpPolicy.__name__) -> None:
        super()._maybe_recommend_cpu(mlp_class_name)

    def _act(self) -> tuple[NDArray[Any], th.Tensor, th.Tensor]:
        observations = obs_as_tensor(self._last_obs, self.device)  # type: ignore[arg-type]
        actions, values, log_probs = self.policy(observations)
        return actions.cpu().numpy(), values, log_probs

    def _add_step(
        self,
        rollout_buffer: RolloutBuffer,
        actions: NDArray[Any],
        reward_components: NDArray[Any],
        values: th.Tensor,
        log_probs: th.Tensor,
    ) -> None:
        rollout_buffer.add(
            self._last_obs,  # type: ignore[arg-type]
            actions,
            reward_components,
            self._last_episode_starts,  # type: ignore[arg-type]
            values,
            log_probs,
        )

    def _value_of(self, observations: PyTorchObs, dones: NDArray[np.bool_]) -> th.Tensor:
        return self.policy.predict_values(observations)

    def _terminal_value_of(self, observations: PyTorchObs, indices: NDArray[np.int_]) -> th.Tensor:
        return self.policy.predict_values(observations)

    def _first_value_of(self, observations: PyTorchObs) -> th.Tensor:
        return self.policy.predict_values(observations)

"""Small policies of all kinds, with observations for them, for tests."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_gcr.gradients.layers import ACTIVATIONS
from sb3_gcr.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from tests.envs import ACTIONS, OBSERVATIONS

#: Samples of a minibatch, and components.
B, K = 24, 5


class Dropping(BaseFeaturesExtractor):
    """Has parameters, batch normalisation and dropout."""

    def __init__(self, observation_space: gym.Space[Any]):
        super().__init__(observation_space, 6)
        self.net = nn.Sequential(nn.Linear(4, 6), nn.BatchNorm1d(6), nn.Dropout(0.1))

    def forward(self, x: th.Tensor) -> th.Tensor:
        return self.net(x)  # type: ignore[no-any-return]


class OwnForward(MlpPolicy):
    """A user's policy with its own way through the networks."""

    def evaluate_actions(self, obs: Any, actions: th.Tensor) -> Any:
        values, log_prob, entropy = super().evaluate_actions(obs, actions)
        return values, 0.5 * log_prob, entropy


def make_policy(
    policy_class: Any = MlpPolicy, observation: str = "Box", action: str = "Box", **kwargs: Any
) -> Any:
    """A policy with K heads, and B observations for it."""
    th.manual_seed(0)
    policy = policy_class(
        OBSERVATIONS[observation], ACTIONS[action], lambda _: 1e-3, n_components=K, **kwargs
    )
    with th.no_grad():  # SB3 starts the action head close to zero, where nothing would be tested
        policy.action_net.weight.normal_(0, 0.5)
    space = OBSERVATIONS[observation]
    space.seed(0)
    samples = [space.sample() for _ in range(B)]
    if isinstance(space, gym.spaces.Dict):
        stacked: Any = {
            key: np.stack([np.asarray(sample[key]) for sample in samples]) for key in space
        }
    else:
        stacked = np.stack(samples)
    return policy, policy.obs_to_tensor(stacked)[0]


#: Arguments of :func:`make_policy` for policies that are computed by hand.
FITTING: dict[str, dict[str, Any]] = {
    "default": {},
    "no hidden layer": {"net_arch": []},
    "uneven": {"net_arch": {"pi": [7], "vf": [5, 6, 4]}},
    "separate extractors": {"share_features_extractor": False},
    "discrete": {"action": "Discrete"},
    "multi-discrete": {"action": "MultiDiscrete"},
    "multi-binary": {"action": "MultiBinary"},
    "discrete observations": {"observation": "Discrete"},
    "multi-discrete observations": {"observation": "MultiDiscrete"},
    "dictionary": {"observation": "Dict", "policy_class": MultiInputPolicy},
    **{activation.__name__: {"activation_fn": activation} for activation in ACTIVATIONS},
}
#: The same for those that autograd computes.
OTHERS: dict[str, dict[str, Any]] = {
    "batch norm and dropout": {"features_extractor_class": Dropping},
    "gSDE": {"use_sde": True},
    "images": {"observation": "Image", "policy_class": CnnPolicy},
    "dictionary with image": {"observation": "DictImage", "policy_class": MultiInputPolicy},
    "own forward": {"policy_class": OwnForward},
    "random activation": {"activation_fn": nn.RReLU},
    "activation with parameters": {"activation_fn": nn.PReLU},
    "activation across features": {"activation_fn": nn.Softmax},
}

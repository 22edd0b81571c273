"""A synthetic rollout with K reward components, and models that hold it in their own buffer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.logger import configure
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from benchmarks.measuring import Contestant, timed
from sb3_gcr import RewardSpec

Array = NDArray[Any]

SEED = 0
#: Shared random signals that the component advantages are mixed from; even, so that a pair can also
#: be orthogonal.
SIGNALS = 4
#: Draws of the sign pattern, of which the one with nearest to one half of conflicting pairs is
#: taken.
DRAWS = 500
#: Standard deviation of each component's own noise, in units of that of its mixture.
NOISE = 0.5


@dataclass(frozen=True)
class Setting:
    """Shapes and sizes of an update."""

    net: tuple[int, ...] | dict[str, list[int]]
    batch_size: int
    n_samples: int = 2048
    n_epochs: int = 2
    obs_size: int = 348
    action_size: int = 17
    device: str = "cpu"

    def __str__(self) -> str:
        net = "×".join(map(str, self.net)) if isinstance(self.net, tuple) else str(self.net)
        return f"{net} B={self.batch_size}" + (
            "" if self.obs_size == 348 else f" obs {self.obs_size}"
        )


class StubEnv(gym.Env[Array, Array]):
    """Spaces and names only: what a model needs to be made, no physics.

    :param setting: sizes of observation and action
    :param n_components: number K of reward components, the first half of them tasks, the others
        regularisers
    """

    def __init__(self, setting: Setting, n_components: int):
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (setting.obs_size,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (setting.action_size,), np.float32)
        self.reward_spec = RewardSpec(
            tuple(f"term_{k}" for k in range(n_components)),
            tuple(int(2 * k >= n_components) for k in range(n_components)),
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """An observation of zeros."""
        return np.zeros(self.observation_space.shape or (), np.float32), {}


def mixed_signals(n_samples: int, n_components: int, rng: np.random.Generator) -> Array:
    """Random signals, one per component, of which half of the pairs point against each other, shape
    (n_samples, K).

    Two components with sign patterns p, q over shared signals agree where ⟨p, q⟩ > 0, clash where
    it is < 0, and do either, minibatch by minibatch, where it is 0. The pattern is drawn so that
    clashes make up one half; one pair gets ⟨p, q⟩ = 0.
    """
    patterns = rng.choice([-1.0, 1.0], (DRAWS, SIGNALS, n_components))
    first, second = np.triu_indices(n_components, 1)
    inner = (
        np.einsum("dsi,dsi->di", patterns[..., first], patterns[..., second])
        if n_components > 1
        else np.zeros((DRAWS, 1))
    )
    share = (inner < 0).mean(1) + (inner == 0).mean(1) / 2
    pattern = patterns[np.argmin(np.abs(share - 0.5))] / np.sqrt(SIGNALS)
    shared = rng.standard_normal((n_samples, SIGNALS)) @ pattern
    return np.asarray(shared + NOISE * rng.standard_normal((n_samples, n_components)), np.float32)


@dataclass(frozen=True)
class Rollout:
    """What all models learn from."""

    observations: Array  # (n, obs)
    actions: Array  # (n, act)
    advantages: Array  # (n, K)


def make_rollout(setting: Setting, n_components: int) -> Rollout:
    """The same rollout for the same arguments."""
    rng = np.random.default_rng(SEED)
    return Rollout(
        rng.standard_normal((setting.n_samples, setting.obs_size), np.float32),
        rng.standard_normal((setting.n_samples, setting.action_size), np.float32),
        mixed_signals(setting.n_samples, n_components, rng),
    )


def fill_buffer(buffer: Any, rollout: Rollout, values: Array, log_probs: Array) -> None:
    """Put a rollout into a model's buffer, whole: a scalar algorithm gets the sum of the
    components' advantages.
    """
    advantages = rollout.advantages.reshape(len(values), -1)
    if values.shape[1] == 1:
        advantages = advantages.sum(1, keepdims=True)
    arrays = {
        "observations": rollout.observations,
        "actions": rollout.actions,
        "log_probs": log_probs,
        "values": values,
        "advantages": advantages,
        "returns": advantages + values,
    }
    buffer.reset()  # SB3 flattens the arrays in place when it is first read
    for name, array in arrays.items():
        target = getattr(buffer, name)
        target[...] = array.reshape(target.shape)
    buffer.pos, buffer.full = buffer.buffer_size, True


def make_model(
    algorithm: Callable[..., OnPolicyAlgorithm], setting: Setting, n_components: int, **kwargs: Any
) -> Any:
    """A model of SB3's constructor arguments with SB3's defaults, but for sizes, seed and a silent
    logger.
    """
    net = list(setting.net) if isinstance(setting.net, tuple) else setting.net
    model = algorithm(
        "MlpPolicy",
        StubEnv(setting, n_components),
        n_steps=setting.n_samples,
        batch_size=setting.batch_size,
        n_epochs=setting.n_epochs,
        policy_kwargs={"net_arch": net},
        seed=SEED,
        device=setting.device,
        **kwargs,
    )
    model.set_logger(configure(None, []))
    return model


def evaluate(policy: Any, rollout: Rollout) -> tuple[Array, Array]:
    """Values, shape (n, K), and log π, shape (n,), of a PyTorch policy on the rollout."""
    with th.no_grad():
        observations = th.as_tensor(rollout.observations, device=policy.device)
        values, log_probs, _ = policy.evaluate_actions(
            observations, th.as_tensor(rollout.actions, device=policy.device)
        )
    return values.reshape(len(log_probs), -1).cpu().numpy(), log_probs.cpu().numpy()


def torch_update(
    label: str,
    algorithm: Callable[..., OnPolicyAlgorithm],
    setting: Setting,
    n_components: int,
    **kwargs: Any,
) -> Contestant:
    """``train()`` of a PyTorch algorithm on the synthetic rollout, always from the same weights,
    with the same minibatches.
    """
    model = make_model(algorithm, setting, n_components, **kwargs)
    rollout = make_rollout(setting, n_components)
    values, log_probs = evaluate(model.policy, rollout)
    weights = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}

    def prepare() -> None:
        model.policy.load_state_dict(weights)
        fill_buffer(model.rollout_buffer, rollout, values, log_probs)
        np.random.seed(SEED)

    def conflict_rate() -> float | None:
        rate = model.logger.name_to_value.get("gcr/conflict_rate")
        return None if rate is None else float(rate)

    return Contestant(label, timed(model.train, prepare, device=setting.device), conflict_rate)

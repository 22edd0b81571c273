"""The update as a whole: its reductions to SB3's PPO, minibatch by minibatch."""

from __future__ import annotations

from typing import Any

import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gcr import GCRPPO
from tests.envs import Env

#: Plain gradient descent with steps so long that ratios leave the clip range at once.
FAR: dict[str, Any] = {
    "n_steps": 64,
    "batch_size": 16,
    "n_epochs": 10,
    "learning_rate": 0.2,
    "vf_coef": 0.0,
    "max_grad_norm": 1e9,
    "seed": 0,
    "device": "cpu",
    "policy_kwargs": {"optimizer_class": th.optim.SGD, "net_arch": [8]},
}


def trained_actor(algorithm: Any, action: str, **kwargs: Any) -> tuple[th.Tensor, th.Tensor, Any]:
    """The actor before and after one update, with critics that say 0; and the model."""
    model = algorithm("MlpPolicy", DummyVecEnv([lambda: Env(action=action)]), **FAR, **kwargs)
    with th.no_grad():
        model.policy.value_net.weight.zero_()
        model.policy.value_net.bias.zero_()
    th.manual_seed(0)  # the wider head drew more numbers
    actor = [p for name, p in model.policy.named_parameters() if "value" not in name]
    before = th.cat([p.detach().flatten().clone() for p in actor])
    model.learn(64)
    return before, th.cat([p.detach().flatten() for p in actor]), model


@pytest.mark.parametrize("action", ["Box", "Discrete"])
@pytest.mark.parametrize("method", ["one_backward", "passes"])
def test_heads_alone_are_ppo_at_every_minibatch_and_ratio(action: str, method: str) -> None:
    """`sum` with joint clipping follows PPO on the summed reward, far outside the clip range."""
    before, expected, ppo = trained_actor(PPO, action)
    assert ppo.logger.name_to_value["train/clip_fraction"] > 0.2
    kwargs = {"resolver": "sum", "advantage_scope": "minibatch", "gramian_method": method}
    _, actual, model = trained_actor(GCRPPO, action, **kwargs)
    assert float((actual - expected).norm()) < 1e-5 * float((expected - before).norm())
    assert model.logger.name_to_value["gcr/brake"] > 0
    _, braked, _ = trained_actor(GCRPPO, action, surrogate_clipping="component", **kwargs)
    assert float((braked - expected).norm()) > 0.1 * float((expected - before).norm())


@pytest.mark.parametrize("clipping", ["joint", "component"])
def test_logged_losses_add_up_to_ppos(clipping: str) -> None:
    """With joint clipping the component losses are parts of PPO's loss; else they are above it."""
    _, _, ppo = trained_actor(PPO, "Box")
    kwargs = {"resolver": "sum", "advantage_scope": "minibatch", "surrogate_clipping": clipping}
    _, _, model = trained_actor(GCRPPO, "Box", **kwargs)
    key = "train/policy_gradient_loss"
    found, expected = (m.logger.name_to_value[key] for m in (model, ppo))
    assert bool(abs(found - expected) < 1e-5) is (clipping == "joint")
    assert found >= expected - 1e-5


def test_an_unknown_clipping_is_refused() -> None:
    message = "Parameter `surrogate_clipping` must be 'joint' or 'component', found 'each'."
    with pytest.raises(ValueError, match=message):
        GCRPPO("MlpPolicy", DummyVecEnv([Env]), surrogate_clipping="each")

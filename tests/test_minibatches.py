"""From a rollout to minibatches: what they hold, how they are normalised, what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gcr import GCRPPO, VectorRolloutBuffer
from sb3_gcr.buffers import VectorDictRolloutBuffer
from sb3_gcr.gradients.by_autograd import ByAutograd
from sb3_gcr.gradients.by_hand import ByHand
from sb3_gcr.minibatches import Normalisation, minibatches, refuse_infinite_rollout
from tests.envs import ACTIONS, OBSERVATIONS, SPEC, Env
from tests.networks import make_policy
from tests.training import SMALL, exactly, learned, parameters

T, N, K = 6, 2, 3


def rollout(observation: str = "Box", action: str = "Box") -> Any:
    """A buffer in which every number says where it comes from."""
    is_dict = observation == "Dict"
    buffer_class = VectorDictRolloutBuffer if is_dict else VectorRolloutBuffer
    space = OBSERVATIONS[observation]
    buffer = buffer_class(T, space, ACTIONS[action], "cpu", n_envs=N, n_components=K)
    steps = np.arange(T * N, dtype=np.float32).reshape(T, N)
    buffer.log_probs[:] = -steps
    if is_dict:
        buffer.observations["a"][:] = steps[:, :, None]
    else:
        buffer.observations[:] = steps[:, :, None]
    buffer.actions[:] = (steps % 3)[:, :, None]
    for sign, name in ((1, "advantages"), (2, "returns"), (3, "values")):
        getattr(buffer, name)[:] = sign * steps[:, :, None] + [0.0, 0.1, 0.2]
    buffer.pos, buffer.full = T, True
    return buffer


NO_NORMALISATION = Normalisation(None, np.inf)


@pytest.mark.parametrize("way", [ByAutograd, lambda policy: ByHand(policy, 5)])
def test_each_sample_is_in_one_minibatch_with_all_that_is_its_own(way: Any) -> None:
    networks = way(make_policy()[0])
    batches = list(minibatches(rollout(), 5, NO_NORMALISATION, networks, discrete=False))
    assert [len(batch.old_log_prob) for batch in batches] == [5, 5, 2]
    seen = []
    for batch in batches:
        samples = -np.asarray(batch.old_log_prob)
        seen += samples.tolist()
        np.testing.assert_array_equal(batch.observations[:, 3], samples)
        np.testing.assert_array_equal(batch.actions[:, 0], samples % 3)
        for sign, array in ((1, batch.advantages), (2, batch.returns), (3, batch.old_values)):
            expected = sign * samples[:, None] + np.array([0.0, 0.1, 0.2])
            np.testing.assert_allclose(np.asarray(array), expected, rtol=1e-6)
        assert batch.kappa == 1
    assert sorted(seen) == list(range(T * N))
    assert seen != sorted(seen)


def test_the_order_is_sb3s_and_another_each_epoch() -> None:
    networks = ByAutograd(make_policy()[0])
    buffer = rollout()
    orders = []
    np.random.seed(3)
    for _ in range(2):
        (batch,) = minibatches(buffer, 100, NO_NORMALISATION, networks, discrete=False)
        orders.append((-batch.old_log_prob).tolist())
    np.random.seed(3)
    for found in orders:  # SB3 swaps and flattens: env by env, all steps of each
        flat = np.arange(T * N).reshape(T, N).T.ravel()
        assert found == flat[np.random.permutation(T * N)].tolist()
    assert orders[0] != orders[1]


def test_choices_are_whole_numbers_in_one_axis() -> None:
    networks = ByAutograd(make_policy(action="Discrete")[0])
    for batch in minibatches(rollout(action="Discrete"), 5, NO_NORMALISATION, networks, True):
        assert batch.actions.dtype == th.long
        assert batch.actions.tolist() == (-batch.old_log_prob % 3).tolist()
    assert isinstance(ACTIONS["Discrete"], spaces.Discrete)


def test_dictionaries_stay_dictionaries() -> None:
    networks = ByAutograd(make_policy()[0])
    for batch in minibatches(rollout("Dict"), 5, NO_NORMALISATION, networks, discrete=False):
        assert isinstance(batch.observations, dict)
        assert batch.observations["a"][:, 0].tolist() == (-batch.old_log_prob).tolist()


def test_the_rollouts_scope_normalises_once() -> None:
    """Two components, 0 … 3 and 0: the sum's deviation is √(5/3)."""
    buffer = rollout()
    buffer.advantages = np.zeros((2, 2, 2), dtype=np.float32)
    buffer.advantages[..., 0] = [[0, 1], [2, 3]]
    normalisation = Normalisation("rollout", np.inf).of_rollout(buffer)
    assert normalisation.kappa == pytest.approx((3 / 5) ** 0.5)
    expected = (np.array([[0, 1], [2, 3]]) - 1.5) * (3 / 5) ** 0.5
    np.testing.assert_allclose(buffer.advantages[..., 0], expected, rtol=1e-6)
    assert not buffer.advantages[..., 1].any()
    part = buffer.advantages[0]
    advantages, kappa = normalisation.of_minibatch(part)
    assert advantages is part
    assert kappa == normalisation.kappa


def test_the_minibatchs_scope_normalises_each() -> None:
    buffer = rollout()
    before = buffer.advantages.copy()
    normalisation = Normalisation("minibatch", np.inf).of_rollout(buffer)
    np.testing.assert_array_equal(buffer.advantages, before)
    advantages, kappa = normalisation.of_minibatch(th.tensor([[0.0, 1.0], [2.0, 3.0]]))
    # sums 1 and 5, deviation √8
    assert float(kappa) == pytest.approx(8**-0.5)
    expected = [[-(8**-0.5), -(8**-0.5)], [8**-0.5, 8**-0.5]]
    np.testing.assert_allclose(advantages, expected, rtol=1e-6)


@pytest.mark.parametrize("name", ["log_probs", "values", "advantages", "observations"])
@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_rollout_that_is_not_finite_names_array_and_env(name: str, number: float) -> None:
    buffer = rollout()
    refuse_infinite_rollout(buffer, 77)
    getattr(buffer, name)[4, 1] = number
    suspects = "observations and `log_std`" if name == "log_probs" else "rewards and observations"
    message = (
        f"The rollout's `{name}` must be finite, found NaN or infinity for env index 1 before the "
        f"update at timestep 77. The policy is as it was; check {suspects}, e.g. with VecCheckNan."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        refuse_infinite_rollout(buffer, 77)


def test_the_env_that_came_last_is_named() -> None:
    """An advantage reaches back, to the steps before the one that is to blame."""
    buffer = rollout("Dict")
    buffer.advantages[:2, 1] = np.nan
    buffer.advantages[:5, 0] = np.nan
    with pytest.raises(ValueError, match=r"`advantages` must be finite, .* for env index 0"):
        refuse_infinite_rollout(buffer, 0)
    buffer.observations["a"][3, 1] = np.inf
    with pytest.raises(ValueError, match=r"`observations\['a'\]` must be finite, .* env index 1"):
        refuse_infinite_rollout(buffer, 0)


@pytest.mark.parametrize("spec", [SPEC, None])
def test_a_rollout_that_is_not_finite_leaves_the_policy(spec: Any) -> None:
    model = GCRPPO("MlpPolicy", DummyVecEnv([lambda: Env(spec)]), **SMALL)
    model.learn(32)
    before = parameters(model).clone()
    model.rollout_buffer.advantages[3] = np.nan
    message = (
        "The rollout's `advantages` must be finite, found NaN or infinity for env index 0 before "
        "the update at timestep 32. The policy is as it was; check rewards and observations, e.g. "
        "with VecCheckNan."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        model.train()
    assert th.equal(parameters(model), before)


@pytest.mark.parametrize("batch_size", [31, 63, 64, 100])
@pytest.mark.parametrize("scope", ["rollout", "minibatch"])
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_minibatches_that_do_not_divide_the_rollout(batch_size: int, scope: str) -> None:
    """64 samples: a last minibatch of 2, of 1, none, and a minibatch larger than the rollout."""
    model = GCRPPO(
        "MlpPolicy",
        make_vec_env(Env, 2),
        n_steps=32,
        batch_size=batch_size,
        advantage_scope=scope,
        n_epochs=2,
    )
    learned(model)

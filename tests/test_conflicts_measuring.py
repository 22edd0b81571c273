"""Conflicts of a policy: against its own gradients, and without a trace."""

from __future__ import annotations

import io
import random
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from sb3_gcr import GCRPPO, RewardSpec, measure_conflicts
from sb3_gcr.conflicts.estimators import Estimate
from sb3_gcr.conflicts.heads import Rollout, fit_heads
from sb3_gcr.conflicts.measuring import rollout_gradients
from sb3_gcr.conflicts.result import Conflicts
from tests.envs import SPEC, Env, Valley

KWARGS: dict[str, Any] = {
    "n_steps": 32,
    "batch_size": 16,
    "n_epochs": 2,
    "seed": 0,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [8]},
}


def make_env(normalise: bool = False, **kwargs: Any) -> VecEnv:
    env: VecEnv = DummyVecEnv([lambda: Env(**kwargs)] * 2)
    return VecNormalize(env) if normalise else env


def valley() -> VecEnv:
    return DummyVecEnv([Valley] * 8)


@pytest.mark.parametrize("algorithm", [GCRPPO, PPO])
def test_a_task_and_the_effort_against_it(algorithm: Any) -> None:
    """One step to x = 0: the task pulls up, the effort is at rest there and pulls y alone. At
    x = 0.5 they pull in opposite directions, four times as hard.
    """
    model = algorithm("MlpPolicy", valley(), n_steps=64, seed=0, device="cpu")
    with th.no_grad():
        model.policy.action_net.bias.copy_(th.tensor([0.5, 0.5]))
        model.policy.log_std.fill_(-1.0)
    found = measure_conflicts(model, valley(), n_rollouts=12, seed=1)
    assert found.names == ("task", "effort")
    assert found.cosines[0, 1] < -0.6
    assert found.z[0, 1] < -5
    assert (found.signal > 0.3).all()
    assert found.sentences()[0].startswith("task and effort really conflict: −0.")
    assert "task" in found.table()
    assert list(found.to_frame()["first"]) == ["task", "task", "effort"]
    assert len(found.figure().axes) == 3


@pytest.mark.parametrize("normalise", [False, True])
@pytest.mark.parametrize("algorithm", [GCRPPO, PPO])
def test_training_goes_on_as_if_nothing_had_been_measured(algorithm: Any, normalise: bool) -> None:
    parameters = [trained(algorithm, normalise, measures) for measures in (False, True)]
    assert parameters[0].equal(parameters[1])


def trained(algorithm: Any, normalise: bool, measures: bool) -> th.Tensor:
    model = algorithm("MlpPolicy", make_env(normalise), **KWARGS)
    model.learn(128)
    if measures:
        before = whole_state(model)
        other = make_env(normalise)
        statistics = None if not normalise else (other.training, other.obs_rms.mean.copy())
        measure_conflicts(model, other, n_rollouts=3)
        after = whole_state(model)
        assert before == after
        if statistics is not None:
            assert other.training is statistics[0]
            np.testing.assert_array_equal(other.obs_rms.mean, statistics[1])
    model.learn(128, reset_num_timesteps=False)
    return th.nn.utils.parameters_to_vector(model.policy.parameters())


def whole_state(model: Any) -> list[Any]:
    """Parameters, optimiser, counters, statistics and generators, as bytes and numbers."""
    stream = io.BytesIO()
    th.save([model.policy.state_dict(), model.policy.optimizer.state_dict()], stream)
    env = model.get_vec_normalize_env()
    statistics = [] if env is None else [env.obs_rms.mean.tolist(), env.ret_rms.count, env.training]
    generators = [random.getstate(), np.random.get_state()[1].tolist(), th.get_rng_state().tolist()]  # type: ignore[union-attr]
    counters = [model.num_timesteps, model._n_updates, model.policy.training]
    return [stream.getvalue(), statistics, generators, counters, model._last_obs.tolist()]


@pytest.mark.parametrize(("z", "verb"), [(-3.5, "really conflict"), (-2.5, "may conflict")])
def test_a_sentence_for_each_pair_that_matters(z: float, verb: str) -> None:
    gramian = np.array([[1.0, -0.5, 0.0], [-0.5, 1.0, 0.0], [0.0, 0.0, 1.0]])
    errors = np.array([[0.1, -0.5 / z, 0.1], [-0.5 / z, 0.1, 0.1], [0.1, 0.1, 0.9]])
    found = Conflicts(SPEC, Estimate(gramian, errors, np.ones(3)), gramian, 24)
    assert found.sentences() == [
        f"go and stay {verb}: −0.50, z = −{-z}.",
        "save has no signal yet.",
    ]
    assert [pair.second for pair in found.pairs()] == ["stay", "save", "save"]


def test_a_pair_that_may_be_one_term() -> None:
    gramian = np.array([[1.0, 0.95], [0.95, 1.0]])
    spec = RewardSpec(("walk", "run"), (0, 0))
    found = Conflicts(spec, Estimate(gramian, gramian / 9.5, np.ones(2)), gramian, 24)
    assert found.sentences() == ["walk and run want the same: 0.95, z = 9.5."]


@pytest.mark.parametrize(
    ("policy", "observation", "action", "kwargs"),
    [
        ("MlpPolicy", "Box", "Discrete", {}),
        ("MlpPolicy", "Box", "MultiDiscrete", {}),
        ("MultiInputPolicy", "Dict", "Box", {}),
        ("CnnPolicy", "Image", "Box", {}),
        ("MlpPolicy", "Box", "Box", {"use_sde": True}),
    ],
)
def test_every_policy_is_measured(
    policy: str, observation: str, action: str, kwargs: dict[str, Any]
) -> None:
    spaces = {"observation": observation, "action": action}
    model = GCRPPO(policy, make_env(**spaces), **{**KWARGS, **kwargs})
    found = measure_conflicts(model, make_env(**spaces), n_rollouts=3)
    assert found.cosines.shape == (3, 3)
    assert np.isfinite(found.z).all()


def test_a_policy_with_memory_is_measured() -> None:
    pytest.importorskip("sb3_contrib")
    from sb3_gcr.recurrent import RecurrentGCRPPO

    kwargs = {**KWARGS, "policy_kwargs": {"net_arch": [8], "lstm_hidden_size": 4}}
    model = RecurrentGCRPPO("MlpLstmPolicy", make_env(), **kwargs)
    found = measure_conflicts(model, make_env(), n_rollouts=3)
    assert np.isfinite(found.z).all()
    assert (found.estimate.squared_norms > 0).all()


def test_a_loaded_model_needs_no_env_of_its_own(tmp_path: Any) -> None:
    model = GCRPPO("MlpPolicy", make_env(normalise=True), **KWARGS)
    model.learn(64)
    model.save(tmp_path / "model")
    loaded = GCRPPO.load(tmp_path / "model", device="cpu")
    from_file = measure_conflicts(loaded, make_env(normalise=True), n_rollouts=3, seed=5)
    from_memory = measure_conflicts(model, make_env(normalise=True), n_rollouts=3, seed=5)
    np.testing.assert_allclose(from_file.estimate.gramian, from_memory.estimate.gramian, rtol=1e-5)


def test_an_evaluation_env_is_seen_as_in_training() -> None:
    """Value heads have the units of normalised rewards, and an evaluation env does without."""
    model = GCRPPO("MlpPolicy", make_env(normalise=True), **KWARGS)
    model.learn(64)
    other = VecNormalize(make_env(), training=False, norm_reward=False)
    evaluation = measure_conflicts(model, other, n_rollouts=3, seed=5)
    training = measure_conflicts(model, make_env(normalise=True), n_rollouts=3, seed=5)
    np.testing.assert_allclose(evaluation.estimate.gramian, training.estimate.gramian, rtol=1e-5)
    assert not other.norm_reward


def test_gradients_of_a_rollout_are_those_of_its_samples() -> None:
    """Chunk by chunk, against one backward pass for each term over all samples."""
    model = GCRPPO("MlpPolicy", make_env(), **KWARGS)
    _, callback = model._setup_learn(64)
    model.collect_rollouts(model.env, callback, model.rollout_buffer, 32)  # type: ignore[arg-type]
    buffer = model.rollout_buffer
    observations = th.as_tensor(buffer.observations.reshape(64, -1))
    actions = th.as_tensor(buffer.actions.reshape(64, -1))
    advantages = th.as_tensor(buffer.advantages.reshape(64, 3).copy())
    found = rollout_gradients(model, chunk=20)
    for k in range(3):
        _, log_prob, _ = model.policy.evaluate_actions(observations, actions)
        model.policy.zero_grad()
        centred = advantages[:, k] - advantages[:, k].mean()
        (log_prob * centred).mean().backward()
        grads = [p.grad.flatten() for p in model.policy.parameters() if p.grad is not None]
        np.testing.assert_allclose(found[k], th.cat(grads).numpy(), rtol=1e-3, atol=1e-5)


def test_heads_find_the_values_of_a_chain() -> None:
    """Reward 1 and 2 for ever: V = 1 / (1 - γ) and 2 / (1 - γ) wherever one is."""
    rng = np.random.default_rng(0)
    features = rng.normal(size=(50, 4, 3))
    rollout = Rollout(
        features,
        rng.normal(size=(4, 3)),
        np.tile([1.0, 2.0], (50, 4, 1)),
        np.zeros((50, 4)),
        np.zeros(4, dtype=bool),
    )
    heads = fit_heads([rollout], gamma=0.9, gae_lambda=0.95)
    values = heads.values(features).reshape(-1, 2)
    np.testing.assert_allclose(values.mean(0), [10, 20], rtol=0.02)


def test_what_cannot_be_measured_is_refused() -> None:
    model = GCRPPO("MlpPolicy", make_env(), **KWARGS)
    message = "Parameter `n_rollouts` must be an integer ≥ 3, found 1."
    with pytest.raises(ValueError, match=message):
        measure_conflicts(model, make_env(), n_rollouts=1)
    with pytest.raises(ValueError, match="must report reward components, found none"):
        measure_conflicts(model, make_env(spec=None))
    one = RewardSpec(("all",), (0,))
    with pytest.raises(ValueError, match="at least two reward components, found only 'all'"):
        measure_conflicts(model, make_env(spec=one))
    others = RewardSpec(("go", "stay", "other"), (0, 0, 1))
    with pytest.raises(ValueError, match="The env's reward components must be those of the model"):
        measure_conflicts(model, make_env(spec=others))
    with pytest.raises(ValueError, match="must be another env than the model's own"):
        measure_conflicts(model, model.get_env())  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="a RecurrentGCRPPO or SB3's PPO, found A2C"):
        measure_conflicts(A2C("MlpPolicy", make_env()), make_env())  # type: ignore[arg-type]


def test_a_vec_normalize_without_statistics_is_refused() -> None:
    model = PPO("MlpPolicy", make_env(), **KWARGS)
    with pytest.raises(ValueError, match="must have the statistics that the model has learned"):
        measure_conflicts(model, make_env(normalise=True))

"""Sequences and their gradients: padding changes nothing, subsets are of whole sequences, and the
Gramian is that of the sequences one by one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env

from tests.envs import Env

pytest.importorskip("sb3_contrib")
from sb3_contrib.common.recurrent.type_aliases import RNNStates

from sb3_gcr.gradients.by_autograd import ByAutograd
from sb3_gcr.recurrent import RecurrentGCRPPO
from sb3_gcr.recurrent.by_autograd import RecurrentByAutograd, leaves_of
from sb3_gcr.recurrent.sequences import Sequences, draw_sequences, lay_out, take_sequences

LSTM: dict[str, Any] = {"lstm_hidden_size": 6, "net_arch": [5]}
SEPARATE = LSTM
SHARED = {**LSTM, "shared_lstm": True, "enable_critic_lstm": False}
ACTOR_ONLY = {**LSTM, "enable_critic_lstm": False}


class Idle(RecurrentGCRPPO):
    """Collects rollouts, and learns nothing."""

    def train(self) -> None:
        pass


def rollout(policy_kwargs: Any = SEPARATE, observation: str = "Box", **kwargs: Any) -> Any:
    """A model with a full buffer: episodes that end at random, three envs of 20 steps."""
    env = make_vec_env(lambda: Env(observation=observation, p_end=0.15, limit=9), 3, seed=0)
    name = "MultiInputLstmPolicy" if observation == "Dict" else "MlpLstmPolicy"
    model = Idle(name, env, n_steps=20, seed=1, device="cpu", policy_kwargs=policy_kwargs, **kwargs)
    return model.learn(120)


def minibatch(model: Any, size: int = 23) -> Any:
    np.random.seed(5)
    return next(model.rollout_buffer.get(size))


def actor_critic(model: Any) -> RecurrentByAutograd:
    return RecurrentByAutograd(model.policy, np.random.default_rng(0))


def cotangents_of(batch: Any) -> th.Tensor:
    generator = th.Generator().manual_seed(2)
    return th.randn(*batch.returns.shape, generator=generator) / len(batch.returns)


def run(model: Any, sequences: Sequences, actions: th.Tensor, batch: Any) -> list[th.Tensor]:
    """All that an update takes from a minibatch: values, log π, entropy, G and the gradients."""
    networks = actor_critic(model)
    cotangents = cotangents_of(batch)
    values, log_prob = networks.evaluate(sequences, actions)
    gramian = networks.gramian(cotangents)
    networks.backward(cotangents, np.array([1.0, 0.5, 2.0]), cotangents, 0.01)
    gradients = [p.grad.clone() for p in model.policy.parameters() if p.grad is not None]
    return [values, log_prob, networks.entropy_loss(), gramian, *gradients]


@settings(max_examples=15, deadline=None)
@given(
    size=st.integers(2, 60),
    garbage=st.integers(0, 2**31),
    scale=st.sampled_from([0.1, 10.0, 1e4]),
    longer=st.integers(0, 3),
)
def test_a_padded_step_changes_nothing_whatever_stands_in_it(
    size: int, garbage: int, scale: float, longer: int
) -> None:
    model = MODELS[garbage % len(MODELS)]
    batch = minibatch(model, size)
    sequences: Any = batch.observations
    expected = run(model, sequences, batch.actions, batch)
    generator = th.Generator().manual_seed(garbage)
    n_sequences = len(sequences.lengths)

    def spoil(steps: th.Tensor) -> th.Tensor:
        noise = scale * th.randn(steps.shape, generator=generator)
        return th.where(sequences.valid[:, None], steps, noise)

    def lengthen(steps: th.Tensor, value: float) -> th.Tensor:
        by_sequence = steps.reshape(n_sequences, -1, *steps.shape[1:])
        more = th.full((n_sequences, longer, *steps.shape[1:]), value, dtype=steps.dtype)
        return th.cat([by_sequence, more], 1).flatten(0, 1)

    spoilt = sequences._replace(
        observations=lengthen(spoil(sequences.observations), scale),
        valid=lengthen(sequences.valid, 0),
    )
    found = run(model, spoilt, lengthen(spoil(batch.actions), scale), batch)
    for one, other in zip(expected, found, strict=True):
        th.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)


MODELS = [rollout(kwargs) for kwargs in (SEPARATE, SHARED, ACTOR_ONLY)]


@pytest.mark.parametrize("model", MODELS, ids=["separate", "shared", "actor alone"])
def test_gramian_and_step_are_those_of_the_sequences_one_by_one(model: Any) -> None:
    """Each sequence alone, step by step, without padding, through sb3-contrib's policy."""
    batch = minibatch(model, 37)
    cotangents = cotangents_of(batch)
    weights = th.tensor([1.0, 0.5, 2.0])
    sequences: Any = batch.observations
    n_sequences, policy = len(sequences.lengths), model.policy
    by_sequence = sequences.observations.reshape(n_sequences, -1, 4)
    actions = batch.actions.reshape(n_sequences, by_sequence.shape[1], -1)
    log_probs, entropies = [], []
    for index, length in enumerate(sequences.lengths.tolist()):
        states = tuple(state[:, index : index + 1] for state in sequences.actor_states)
        for t in range(length):
            distribution, states = policy.get_distribution(
                by_sequence[index, t : t + 1], states, th.zeros(1)
            )
            log_probs.append(distribution.log_prob(actions[index, t : t + 1]))
            entropies.append(distribution.entropy())
    log_prob = th.cat(log_probs)
    parameters = [p for name, p in policy.named_parameters() if "pi" in name or is_actor(name)]
    rows = [
        th.cat(
            [
                g.flatten()
                for g in th.autograd.grad(
                    log_prob, parameters, cotangents[:, k], retain_graph=True, allow_unused=True
                )
                if g is not None
            ]
        )
        for k in range(3)
    ]
    expected = th.stack([th.stack([a @ b for b in rows]) for a in rows])
    networks = actor_critic(model)
    _, found_log_prob = networks.evaluate(sequences, batch.actions)
    th.testing.assert_close(found_log_prob, log_prob.detach(), rtol=1e-4, atol=1e-5)
    th.testing.assert_close(networks.gramian(cotangents), expected, rtol=1e-4, atol=1e-8)
    networks.backward(cotangents, weights.numpy(), th.zeros_like(cotangents), 0.0)
    step = th.cat([p.grad.flatten() for p in parameters if p.grad is not None])
    th.testing.assert_close(step, sum(w * r for w, r in zip(weights, rows, strict=True)))
    assert networks.entropy_loss() == pytest.approx(
        -float(th.cat(entropies).detach().mean()), rel=1e-5
    )


def is_actor(name: str) -> bool:
    return name.startswith(("lstm_actor", "mlp_extractor.policy_net", "action_net", "log_std"))


@pytest.mark.parametrize("model", MODELS, ids=["separate", "shared", "actor alone"])
def test_values_and_their_gradients_are_sb3_contribs(model: Any) -> None:
    batch = minibatch(model, 37)
    sequences: Any = batch.observations
    values, _, _ = model.policy.evaluate_actions(
        sequences.observations,
        batch.actions,
        RNNStates(sequences.actor_states, sequences.critic_states),
        th.zeros(len(sequences.valid)),
    )
    cotangents = cotangents_of(batch)
    model.policy.zero_grad()
    values[sequences.valid].backward(cotangents)
    names = [name for name, p in model.policy.named_parameters() if p.grad is not None]
    expected = {n: p.grad.clone() for n, p in model.policy.named_parameters() if n in names}
    networks = actor_critic(model)
    networks.evaluate(sequences, batch.actions)
    networks.gramian(th.zeros_like(cotangents))
    networks.backward(th.zeros_like(cotangents), np.ones(3), cotangents, 0.0)
    for name, parameter in model.policy.named_parameters():
        if name in expected:
            th.testing.assert_close(parameter.grad, expected[name], rtol=1e-4, atol=1e-7)
        elif parameter.grad is not None:
            assert not parameter.grad.any()


@pytest.mark.parametrize("ent_coef", [0.0, 0.1])
def test_rows_that_are_there_already_make_the_same_step_as_another_pass(ent_coef: float) -> None:
    model = rollout({**SEPARATE, "share_features_extractor": False})
    batch = minibatch(model, 31)
    cotangents, weights = cotangents_of(batch), np.array([1.0, 3.0, 0.5])
    found = []
    for networks in (actor_critic(model), actor_critic(model)):
        networks.evaluate(batch.observations, batch.actions)
        if not found:
            networks.gramian(cotangents)
            networks.backward(cotangents, weights, cotangents, ent_coef)
        else:
            ByAutograd.backward(networks, cotangents, weights, cotangents, ent_coef)
        found.append([p.grad.clone() for p in model.policy.parameters()])
    for one, other in zip(*found, strict=True):
        th.testing.assert_close(one, other, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("observation", ["Box", "Dict"])
def test_a_subset_is_the_gramian_of_its_sequences(observation: str) -> None:
    model = rollout(observation=observation)
    batch = minibatch(model, 60)
    cotangents = cotangents_of(batch)
    networks = actor_critic(model)
    networks.evaluate(batch.observations, batch.actions)
    found = networks.gramian(cotangents, 11)
    lengths = batch.observations.lengths
    drawn = draw_sequences(lengths, 11, np.random.default_rng(0))
    assert 0 < len(drawn) < len(lengths)
    ends = lengths.cumsum(0)
    alone = th.zeros_like(cotangents)
    for index in drawn.tolist():
        rows = slice(int(ends[index] - lengths[index]), int(ends[index]))
        alone[rows] = cotangents[rows]
    th.testing.assert_close(found, networks.gramian(alone), rtol=1e-4, atol=1e-9)
    networks.backward(cotangents, np.ones(3), cotangents, 0.0)


def test_a_hook_sees_the_gradient_of_the_step_once() -> None:
    model = rollout()
    batch = minibatch(model)
    cotangents = cotangents_of(batch)
    seen: list[th.Tensor] = []
    parameter = model.policy.lstm_actor.weight_hh_l0
    handle = parameter.register_hook(lambda gradient: seen.append(gradient.clone()))
    networks = actor_critic(model)
    networks.evaluate(batch.observations, batch.actions)
    networks.gramian(cotangents)
    networks.gramian(cotangents, 3)
    networks.backward(cotangents, np.ones(3), cotangents, 0.0)
    handle.remove()
    assert len(seen) == 1
    th.testing.assert_close(seen[0], parameter.grad)


def test_a_frozen_actor_has_no_gradient_and_the_critic_learns_on() -> None:
    model = rollout()
    batch = minibatch(model)
    for name, parameter in model.policy.named_parameters():
        parameter.requires_grad_(not is_actor(name))
    cotangents = cotangents_of(batch)
    networks = actor_critic(model)
    networks.evaluate(batch.observations, batch.actions)
    assert not networks.gramian(cotangents).any()
    networks.backward(cotangents, np.ones(3), cotangents, 0.0)
    assert model.policy.lstm_actor.weight_hh_l0.grad is None
    assert model.policy.value_net.weight.grad.any()


def test_minibatches_hold_each_step_of_the_rollout_once_and_in_order() -> None:
    model = rollout()
    buffer = model.rollout_buffer
    all_returns = buffer.returns.swapaxes(0, 1).reshape(60, 3).copy()
    batches = list(buffer.get(23))
    returns = th.cat([batch.returns for batch in batches]).numpy()
    first = int(np.flatnonzero((all_returns == returns[0]).all(1))[0])
    np.testing.assert_array_equal(np.roll(all_returns, -first, 0), returns)
    assert [len(batch.advantages) for batch in batches] == [23, 23, 14]
    for batch in batches:
        assert int(batch.observations.valid.sum()) == len(batch.old_log_prob)


def test_a_sequence_that_begins_an_episode_begins_without_memory() -> None:
    model = rollout()
    buffer = model.rollout_buffer
    batch = next(buffer.get())
    states = batch.observations.actor_states[0][0]
    assert (states == 0).all(1).any()  # an episode that begins inside the rollout
    assert (states != 0).any()  # one that began before


def lengths_of(*lengths: int) -> th.Tensor:
    return th.tensor(lengths)


@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=8),
    n_samples=st.integers(1, 50),
    seed=st.integers(0, 1000),
)
def test_as_few_whole_sequences_are_drawn_as_have_the_steps(
    lengths: list[int], n_samples: int, seed: int
) -> None:
    drawn = draw_sequences(lengths_of(*lengths), n_samples, np.random.default_rng(seed)).tolist()
    assert drawn == sorted(set(drawn))
    steps = [lengths[index] for index in drawn]
    if sum(lengths) <= n_samples:
        assert len(drawn) == len(lengths)
    else:
        assert sum(steps) >= n_samples
        assert any(sum(steps) - last < n_samples for last in steps)  # without the last, too few


def test_each_sequence_is_drawn_as_often_as_the_others() -> None:
    rng = np.random.default_rng(0)
    counts = np.zeros(4)
    for _ in range(4000):
        counts[draw_sequences(lengths_of(5, 5, 5, 5), 5, rng).numpy()] += 1
    assert counts.sum() == 4000
    assert (abs(counts - 1000) < 130).all()  # over four standard deviations


def test_sequences_are_taken_and_cut_to_the_longest() -> None:
    steps = th.arange(12)  # three sequences of four steps
    found = take_sequences(steps, 3, th.tensor([0, 2]), 2)
    assert found.tolist() == [0, 1, 8, 9]
    sequences = Sequences(
        observations={"a": steps[:, None], "b": -steps},
        actor_states=(th.tensor([[[1.0], [2.0], [3.0]]]),),
        critic_states=(th.tensor([[[4.0], [5.0], [6.0]]]),),
        valid=th.tensor([1, 1, 1, 0, 1, 1, 1, 1, 1, 1, 0, 0], dtype=th.bool),
    )
    assert sequences.lengths.tolist() == [3, 4, 2]
    taken = sequences.take(th.tensor([0, 2]))
    assert taken.valid.tolist() == [True, True, True, True, True, False]
    assert taken.observations["a"][:, 0].tolist() == [0, 1, 2, 8, 9, 10]  # type: ignore[index]
    assert taken.actor_states[0].flatten().tolist() == [1.0, 3.0]
    assert taken.critic_states[0].flatten().tolist() == [4.0, 6.0]
    assert sequences.steps_of(th.tensor([1])).tolist() == [0, 0, 0, 1, 1, 1, 1, 0, 0]


def test_a_minibatch_is_cut_where_sequences_begin() -> None:
    begins = np.array([False, False, True, False, False, True])
    layout = lay_out(begins)
    assert layout.firsts.tolist() == [0, 2, 5]
    assert layout.steps.tolist() == [[0, 1, 1], [2, 3, 4], [5, 5, 5]]
    assert layout.valid.tolist() == [[True, True, False], [True] * 3, [True, False, False]]
    alone = lay_out(np.array([False]))
    assert (alone.firsts.tolist(), alone.steps.tolist()) == ([0], [[0]])


def test_the_leaves_of_an_output_are_what_it_depends_on() -> None:
    one, two, three = (th.ones(2, requires_grad=True) for _ in range(3))
    output = (one * two.detach() + (one + three) ** 2).sum()
    assert leaves_of(output) == {one, three}

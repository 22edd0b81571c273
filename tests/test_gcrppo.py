"""GCRPPO itself: its reductions to PPO, its arguments, what an update refuses."""

from __future__ import annotations

import copy
import inspect
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gcr import GCRPPO, RESOLVERS, RewardSpec, VectorRolloutBuffer
from tests.envs import Env, Late
from tests.training import SMALL, exactly, learned, parameters


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"clip_range_vf": 0.1, "ent_coef": 0.01, "target_kl": 0.01},
        {"use_sde": True, "sde_sample_freq": 4},
        {
            "policy_kwargs": {"share_features_extractor": False, "net_arch": [8]},
            "normalize_advantage": False,
        },
        {"batch_size": 13},
    ],
)
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_one_objective_is_sb3s_ppo_bit_for_bit(kwargs: Any) -> None:
    for spec in (None, RewardSpec(("only",), (0,))):
        models = []
        for algorithm in (PPO, GCRPPO):
            env = make_vec_env(
                lambda spec=spec: Env(spec or RewardSpec(("only",), (0,))), n_envs=2, seed=0
            )
            models.append(algorithm("MlpPolicy", env, **{**SMALL, **kwargs}).learn(256))
        assert th.equal(parameters(models[0]), parameters(models[1]))
        assert models[0].predict(np.ones(4), deterministic=True)[0].tolist() == (
            models[1].predict(np.ones(4), deterministic=True)[0].tolist()
        )


@pytest.mark.parametrize("method", ["one_backward", "passes"])
def test_sum_with_minibatch_scope_takes_ppos_first_step(method: str) -> None:
    """The first minibatch's actor gradient is PPO's on the summed reward, if the critics agree: V =
    Σ V^(k).
    """
    gradients = []
    for algorithm, kwargs in (
        (PPO, {}),
        (GCRPPO, {"resolver": "sum", "advantage_scope": "minibatch", "gramian_method": method}),
    ):
        env = DummyVecEnv([Env])
        model = algorithm(
            "MlpPolicy",
            env,
            n_steps=32,
            batch_size=32,
            n_epochs=1,
            seed=0,
            max_grad_norm=1e9,
            **kwargs,
        )
        with th.no_grad():
            model.policy.value_net.weight.zero_()
            model.policy.value_net.bias.zero_()
        th.manual_seed(0)  # the wider head drew more numbers
        model.learn(32)
        actor = [
            p.grad.flatten() for name, p in model.policy.named_parameters() if "value" not in name
        ]
        gradients.append(th.cat(actor))
    th.testing.assert_close(gradients[1], gradients[0], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    "kwargs", [{}, {"clip_range_vf": 0.2, "ent_coef": 0.02}, {"target_kl": 0.02}]
)
def test_all_ways_to_the_gramian_train_alike(kwargs: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """One backward pass in NumPy and in PyTorch, and K of them."""
    models = []
    for method, limit in (("passes", 0), ("one_backward", 2**25), ("one_backward", 0)):
        for name in ("SMALL", "SMALL_FOR_THREADS"):
            monkeypatch.setattr(f"sb3_gcr.gradients.memory.{name}", limit)
        model = GCRPPO(
            "MlpPolicy", make_vec_env(Env, 2, seed=0), gramian_method=method, **SMALL, **kwargs
        ).learn(128)
        models.append(model)
    for model in models[1:]:
        th.testing.assert_close(parameters(models[0]), parameters(model), rtol=1e-3, atol=1e-5)


def test_general_path_with_one_objective_is_ppo_to_rounding() -> None:
    """``desired_kl`` makes our own loop run with K = 1; with a target that the KL never leaves it
    takes PPO's steps.
    """
    models = []
    for algorithm, kwargs in ((PPO, {}), (GCRPPO, {"desired_kl": 1e-3})):
        env = make_vec_env(lambda: Env(None), n_envs=2, seed=0)
        models.append(
            algorithm(
                "MlpPolicy", env, n_steps=32, batch_size=64, n_epochs=1, seed=0, **kwargs
            ).learn(64)
        )
    th.testing.assert_close(parameters(models[0]), parameters(models[1]), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("method", ["one_backward", "passes"])
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_logged_figures_are_ppos(method: str) -> None:
    """Our own loop, which an ``advantage_scope`` asks for, with one component, uneven minibatches
    and clipping logs what SB3's PPO logs.
    """
    settings: dict[str, Any] = {
        "n_steps": 32,
        "batch_size": 24,
        "n_epochs": 3,
        "seed": 0,
        "learning_rate": 0.01,
        "ent_coef": 0.01,
        "clip_range_vf": 0.05,
        "normalize_advantage": False,
    }
    logs = []
    ours = {"gramian_method": method, "advantage_scope": "rollout"}
    for algorithm, kwargs in ((PPO, {}), (GCRPPO, ours)):
        env = make_vec_env(lambda: Env(None), n_envs=2, seed=0)
        model = algorithm("MlpPolicy", env, **settings, **kwargs).learn(64)
        logs.append(model.logger.name_to_value)
    assert "gcr/one_backward" in logs[1]
    keys = [key for key in logs[0] if key.startswith("train/")]
    assert logs[0]["train/clip_fraction"] > 0
    assert {
        "train/approx_kl",
        "train/loss",
        "train/value_loss",
        "train/policy_gradient_loss",
        "train/entropy_loss",
    } <= {*keys}
    assert {key: logs[1][key] for key in keys} == pytest.approx(
        {key: logs[0][key] for key in keys}, rel=1e-3, abs=1e-5
    )


def test_every_resolver_and_a_users_own() -> None:
    def mine(gramian: Any, levels: Any, rng: Any, *, factor: float = 1.0) -> Any:
        assert gramian.shape == (3, 3)
        assert gramian.dtype == np.float64
        assert levels.tolist() == [0, 0, 1]
        assert isinstance(rng, np.random.Generator)
        return factor * np.ones(3)

    for resolver in RESOLVERS:
        learned(GCRPPO("MlpPolicy", make_vec_env(Env, 2), resolver=resolver, **SMALL))
    model = learned(
        GCRPPO(
            "MlpPolicy",
            make_vec_env(Env, 2),
            resolver=mine,
            resolver_kwargs={"factor": 2.0},
            **SMALL,
        )
    )
    assert model.logger.name_to_value["gcr/weight/go"] == 2


def test_the_signature_begins_with_ppos() -> None:
    theirs = list(inspect.signature(PPO.__init__).parameters.values())
    ours = list(inspect.signature(GCRPPO.__init__).parameters.values())
    assert [(p.name, p.default) for p in ours[: len(theirs)]] == [
        (p.name, p.default) for p in theirs
    ]
    assert all(p.default is not inspect.Parameter.empty for p in ours[len(theirs) :])


@pytest.mark.parametrize(
    ("kwargs", "scale"),
    [
        ({"normalize_advantage": False}, "none"),
        ({"advantage_scope": "minibatch"}, "minibatch"),
        ({}, "rollout"),
    ],
)
def test_scope_of_the_normalisation(kwargs: Any, scale: str) -> None:
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 2, seed=0), **SMALL, **kwargs).learn(64)
    total = model.rollout_buffer.advantages.sum(-1)
    assert bool(abs(total.std(ddof=1) - 1) < 1e-4) is (scale == "rollout")
    kappa = model.logger.name_to_value["gcr/kappa"]
    assert bool(kappa == 1) is (scale == "none")
    if scale == "minibatch":
        assert kappa == pytest.approx(1 / total.std(ddof=1), rel=0.3)


def test_seed_decides_everything() -> None:
    def train(seed: int) -> Any:
        model = GCRPPO("MlpPolicy", make_vec_env(Env, 2, seed=seed), **{**SMALL, "seed": seed})
        return parameters(model.learn(128))

    assert th.equal(train(1), train(1))
    assert not th.equal(train(1), train(2))


@pytest.mark.parametrize("method", ["one_backward", "passes"])
@pytest.mark.parametrize("scope", ["rollout", "minibatch"])
@pytest.mark.parametrize("resolver", ["gcr", "guaranteed", "levels", "gcr_authors"])
def test_a_term_that_never_pays_is_harmless(method: str, scope: str, resolver: str) -> None:
    """It has no advantage, no gradient and weight 1, until it pays; a file remembers."""
    env = make_vec_env(Late, 2, seed=0)
    kwargs: dict[str, Any] = {"gramian_method": method, "advantage_scope": scope}
    model = GCRPPO("MlpPolicy", env, resolver=resolver, **kwargs, **SMALL).learn(256)
    logged = model.logger.name_to_value
    assert logged["gcr/weight/late"] == 1
    assert logged["gcr/grad_norm/late"] == 0
    assert logged["gcr/in_conflict/late"] == 0
    assert not model.rollout_buffer.advantages[..., 2].any()
    assert model.rollout_buffer.advantages[..., :2].any()


def test_a_term_joins_when_it_first_pays_and_stays(tmp_path: Path) -> None:
    env = make_vec_env(lambda: Late(33), 1, seed=0)
    model = GCRPPO("MlpPolicy", env, **SMALL).learn(32)
    assert model.has_paid.tolist() == [True, True, False]
    model.learn(32, reset_num_timesteps=False)
    assert model.has_paid.tolist() == [True, True, True]
    assert model.rollout_buffer.advantages[..., 2].all()
    model.save(tmp_path / "model")
    silent = make_vec_env(Late, 1, seed=0)
    for weights_only in (False, True):
        loaded = GCRPPO.load(tmp_path / "model", env=silent, weights_only=weights_only)
        assert loaded.has_paid.tolist() == [True, True, True]
    loaded.learn(32, reset_num_timesteps=False)
    assert loaded.rollout_buffer.advantages[..., 2].any()


def test_adaptive_learning_rate_takes_over_after_the_first_minibatch() -> None:
    model = GCRPPO(
        "MlpPolicy",
        make_vec_env(Env, 1),
        desired_kl=1e6,
        learning_rate=1e-4,
        n_steps=32,
        batch_size=32,
        n_epochs=1,
    )
    model.learn(32)
    assert model.policy.optimizer.param_groups[0]["lr"] == 1e-4
    model = GCRPPO(
        "MlpPolicy",
        make_vec_env(Env, 1),
        desired_kl=1e6,
        learning_rate=1e-4,
        n_steps=32,
        batch_size=8,
        n_epochs=1,
    )
    model.learn(32)
    assert model.policy.optimizer.param_groups[0]["lr"] == pytest.approx(1e-4 * 1.5**3)
    model.learn(32, reset_num_timesteps=False)
    assert model.policy.optimizer.param_groups[0]["lr"] == pytest.approx(1e-4 * 1.5**6)
    assert model.logger.name_to_value["train/learning_rate"] == pytest.approx(1e-4 * 1.5**6)


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        (
            {"resolver": "pcgrad"},
            ValueError,
            "Parameter `resolver` must be one of ['gcr', 'gcr_authors', 'guaranteed', "
            "'levels', 'no_priority', 'sum'] or a callable "
            "(gramian, levels, rng) -> weights, found 'pcgrad'.",
        ),
        (
            {"resolver": 3},
            TypeError,
            "Parameter `resolver` must be one of ['gcr', 'gcr_authors', 'guaranteed', "
            "'levels', 'no_priority', 'sum'] or a callable "
            "(gramian, levels, rng) -> weights, found 3.",
        ),
        (
            {"resolver_kwargs": {"colour": 1}},
            TypeError,
            "Parameter `resolver_kwargs` must fit the resolver's signature (gramian, levels, rng, "
            "...), "
            "found {'colour': 1}: got an unexpected keyword argument 'colour'.",
        ),
        (
            {"advantage_scope": "batch"},
            ValueError,
            "Parameter `advantage_scope` must be 'rollout', 'minibatch' or None, found 'batch'.",
        ),
        ({"kappa_max": 0}, ValueError, "Parameter `kappa_max` must be a number > 0, found 0."),
        (
            {"desired_kl": -1.0},
            ValueError,
            "Parameter `desired_kl` must be a number > 0 or None, found -1.0.",
        ),
        (
            {"gramian_method": "two"},
            ValueError,
            "Parameter `gramian_method` must be 'auto', 'one_backward' or 'passes', found 'two'.",
        ),
        *(
            (
                {"gramian_samples": samples},
                ValueError,
                f"Parameter `gramian_samples` must be an integer ≥ 1 or None, found {samples}.",
            )
            for samples in (0, 512.0)
        ),
        (
            {"rollout_buffer_class": RolloutBuffer},
            ValueError,
            "Parameter `rollout_buffer_class` must be a subclass of VectorRolloutBuffer for more "
            "than one reward component, "
            "found RolloutBuffer.",
        ),
    ],
)
def test_bad_arguments(kwargs: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=exactly(message)):
        GCRPPO("MlpPolicy", make_vec_env(Env, 1), **kwargs)


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (np.ones(2), "Parameter `resolver` must return weights of shape (3,), found shape (2,)."),
        (
            np.ones((3, 1)),
            "Parameter `resolver` must return weights of shape (3,), found shape (3, 1).",
        ),
        (
            np.full(3, np.nan),
            "Parameter `resolver` must return finite weights, found [nan nan nan].",
        ),
    ],
)
def test_wrong_weights_fail_before_the_first_rollout(weights: Any, message: str) -> None:
    model = GCRPPO(
        "MlpPolicy", make_vec_env(Env, 1), resolver=lambda gramian, levels, rng: weights, **SMALL
    )
    with pytest.raises(ValueError, match=exactly(message)):
        model.learn(64)
    assert model.num_timesteps == 0


def test_one_backward_cannot_be_forced_on_a_network_that_does_not_fit() -> None:
    model = GCRPPO(
        "MlpPolicy", make_vec_env(Env, 1), use_sde=True, gramian_method="one_backward", **SMALL
    )
    message = (
        "Parameter `gramian_method` must be 'auto' or 'passes' for this policy, found "
        "'one_backward', which needs an "
        "actor and a critic of linear layers and common activations, a flat features extractor and "
        "no gSDE."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        model.learn(32)


class Spoil(BaseCallback):
    """Spoils the returns of a rollout, which only the update looks at."""

    def __init__(self, number: float):
        super().__init__()
        self.number = number
        self.before: Any = None

    def _on_rollout_end(self) -> None:
        self.model.rollout_buffer.returns[:, 0, 1] = self.number
        self.before = parameters(self.model)

    def _on_step(self) -> bool:
        return True


@pytest.mark.parametrize("method", ["one_backward", "passes"])
@pytest.mark.parametrize(("number", "found"), [(np.nan, "nan"), (1e30, "inf")])
def test_nan_in_training_raises_before_it_reaches_the_weights(
    method: str, number: float, found: str
) -> None:
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 1), gramian_method=method, **SMALL)
    model.learn(32)
    message = (
        f"The value loss must be finite, found {found} in the update at timestep 64. The weights "
        "are those of the last good step; a smaller `learning_rate`, or scaled returns "
        "(VecNormalize), may help."
    )
    spoil = Spoil(number)
    with pytest.raises(ValueError, match=exactly(message)):
        model.learn(32, callback=spoil, reset_num_timesteps=False)
    assert th.equal(parameters(model), spoil.before)


def can(action: Any) -> str:
    """What comes of it: "yes", or the error's type."""
    try:
        action()
    except Exception as error:
        return type(error).__name__
    return "yes"


@pytest.mark.parametrize("method", ["one_backward", "passes"])
@pytest.mark.parametrize("timesteps", [0, 32, 64])
def test_pickling_and_copying_work_wherever_they_work_with_ppo(method: str, timesteps: int) -> None:
    """Before training, after it, and between two."""
    ppo = PPO("MlpPolicy", DummyVecEnv([lambda: Env(None)]), **SMALL)
    model = GCRPPO("MlpPolicy", DummyVecEnv([Env]), gramian_method=method, **SMALL)
    for algorithm in (ppo, model):
        if timesteps:
            algorithm.learn(timesteps)
    for action in (pickle.dumps, copy.deepcopy, copy.copy):
        if can(lambda action=action: action(ppo)) == "yes":
            action(model)


@pytest.mark.parametrize("method", ["one_backward", "passes"])
def test_a_pickled_model_goes_on_as_the_model_itself(method: str) -> None:
    model = GCRPPO("MlpPolicy", DummyVecEnv([Env]), gramian_method=method, **SMALL).learn(64)
    clone = pickle.loads(pickle.dumps(model))
    assert th.equal(parameters(clone), parameters(model))
    states = [one.policy.optimizer.state_dict()["state"] for one in (clone, model)]
    assert [float(state["step"]) for state in states[0].values()] == [8.0] * 13
    for mine, its in zip(states[0].values(), states[1].values(), strict=True):
        assert all(th.equal(mine[name], its[name]) for name in its)
    ends = []
    for one in (model, clone):
        th.manual_seed(1)
        np.random.seed(1)
        ends.append(parameters(one.learn(64, reset_num_timesteps=False)))
    assert th.equal(*ends)


def test_a_copied_model_is_apart() -> None:
    model = GCRPPO("MlpPolicy", DummyVecEnv([Env]), **SMALL).learn(64)
    clone = copy.deepcopy(model)
    before = parameters(model)
    learned(clone, 64)
    assert th.equal(parameters(model), before)


def test_env_ids_of_the_table_are_taken_apart_and_others_are_not() -> None:
    model = GCRPPO("MlpPolicy", "Humanoid-v5", **SMALL)
    assert str(model.reward_spec) == (
        "reward_forward (task), reward_survive (task), reward_ctrl (regulariser), reward_contact "
        "(regulariser)"
    )
    learned(model, 32)
    assert isinstance(model.rollout_buffer, VectorRolloutBuffer)
    assert GCRPPO("MlpPolicy", "Pendulum-v1").n_components == 1


def test_verbose_says_what_runs(capsys: pytest.CaptureFixture[str]) -> None:
    GCRPPO("MlpPolicy", make_vec_env(lambda: Env(None), 1), verbose=1, **SMALL).learn(32)
    assert (
        "One reward component: training is SB3's PPO with one objective." in capsys.readouterr().out
    )
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), verbose=1, **SMALL).learn(32)
    out = capsys.readouterr().out
    assert "3 reward components: go (task), stay (task), save (regulariser)" in out
    assert "| go        | task        |" in out
    assert "Gradients of the components: one backward pass in NumPy" in out
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), verbose=1, use_sde=True, **SMALL).learn(32)
    assert "Gradients of the components: K backward passes in PyTorch" in capsys.readouterr().out

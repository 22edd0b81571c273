"""A warm start keeps the actor, the critic's hidden layers and the value heads of the same name,
and nothing else.
"""

from __future__ import annotations

import re
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import A2C, PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import HumanOutputFormat, Logger
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_gcr import GCRPPO, MlpPolicy, RewardSpec
from sb3_gcr.saving.warm_start import merge_parameters
from tests.envs import SPEC, Env

SMALL: dict[str, Any] = {"n_steps": 32, "batch_size": 16, "n_epochs": 2, "seed": 0, "device": "cpu"}
OTHER = RewardSpec(("save", "shine", "go"), (0, 1, 2))


def exactly(message: str) -> str:
    return f"^{re.escape(message)}$"


def values(model: Any, env: Any) -> Any:
    with th.no_grad():
        return model.policy.predict_values(model.policy.obs_to_tensor(env.reset())[0])


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "model.zip"


KINDS = [
    ("MlpPolicy", "Box", {}),
    (
        "MlpPolicy",
        "Box",
        {
            "share_features_extractor": False,
            "net_arch": {"pi": [8], "vf": [9, 7]},
            "activation_fn": nn.ELU,
        },
    ),
    ("MultiInputPolicy", "Dict", {"net_arch": [8]}),
    ("MultiInputPolicy", "DictImage", {"share_features_extractor": False, "net_arch": [8]}),
    ("CnnPolicy", "ImageChannelsLast", {"features_extractor_kwargs": {"features_dim": 16}}),
    (
        "CnnPolicy",
        "Image",
        {"features_extractor_kwargs": {"features_dim": 16}, "share_features_extractor": False},
    ),
]


@pytest.mark.parametrize(
    ("algorithm", "weights_only"), [(PPO, False), (GCRPPO, False), (GCRPPO, True)]
)
@pytest.mark.parametrize(("policy", "observation", "policy_kwargs"), KINDS)
def test_kept_is_what_can_be_kept(
    path: Path,
    algorithm: Any,
    weights_only: bool,
    policy: str,
    observation: str,
    policy_kwargs: Any,
) -> None:
    old_env = make_vec_env(lambda: Env(observation=observation), 2, seed=0)
    settings = {
        "policy_kwargs": policy_kwargs,
        "ent_coef": 0.01,
        "clip_range": 0.3,
        "learning_rate": 0.01,
    }
    old = algorithm(policy, old_env, **SMALL, **settings).learn(64)
    old.save(path)
    env = make_vec_env(lambda: Env(OTHER, observation=observation), 3, seed=1)
    model = GCRPPO.warm_start(path, env, device="cpu", weights_only=weights_only, ent_coef=0.02)
    assert model.reward_spec == OTHER
    assert (model.num_timesteps, model._n_updates, model.n_envs) == (0, 0, 3)
    assert (model.ent_coef, model.learning_rate, model.policy_kwargs) == (0.02, 0.01, policy_kwargs)
    assert model.clip_range(1.0) == 0.3  # type: ignore[operator]
    assert model.rollout_buffer_class is None
    assert not model.policy.optimizer.state
    new, before = model.policy.state_dict(), old.policy.state_dict()
    heads = {"value_net.weight", "value_net.bias"}
    assert set(new) == set(before)
    for key in set(new) - heads:
        assert th.equal(new[key], before[key])
    observations = old_env.reset()
    expected = old.predict(observations, deterministic=True)[0]
    np.testing.assert_array_equal(model.predict(observations, deterministic=True)[0], expected)
    untrained = GCRPPO(policy, env, **SMALL, policy_kwargs=policy_kwargs).policy.state_dict()
    is_ours = algorithm is GCRPPO
    origins = (
        [(before, 2), (untrained, 1), (before, 0)]
        if is_ours
        else [(untrained, k) for k in range(3)]
    )
    for row, (origin, index) in enumerate(origins):
        for key in heads:
            assert th.equal(new[key][row], origin[key][index])
    lists = (
        "save, go; new: shine; left behind: stay"
        if is_ours
        else "none; new: save, shine, go; left behind: reward"
    )
    assert model.warm_start_report == (
        f"Warm start from {path}: actor and critic kept; value heads kept: {lists}; VecNormalize: "
        "no statistics in the file."
    )
    assert model.learn(96).num_timesteps == 96


def test_kept_heads_predict_what_they_did(path: Path) -> None:
    env = make_vec_env(Env, 2, seed=0)
    old = GCRPPO("MlpPolicy", env, **SMALL).learn(64)
    old.save(path)
    model = GCRPPO.warm_start(path, make_vec_env(lambda: Env(OTHER), 2), device="cpu")
    env.seed(0)
    before = values(old, env)
    env.seed(0)
    th.testing.assert_close(values(model, env)[:, [0, 2]], before[:, [2, 0]])


@pytest.mark.parametrize("action", ["Discrete", "MultiDiscrete", "MultiBinary"])
def test_other_actions(path: Path, action: str) -> None:
    old = PPO("MlpPolicy", make_vec_env(lambda: Env(None, action=action), 1), **SMALL).learn(32)
    old.save(path)
    model = GCRPPO.warm_start(
        path, make_vec_env(lambda: Env(action=action), 1), device="cpu"
    ).learn(32)
    assert model.num_timesteps == 32


def test_gsde_and_its_deviations(path: Path) -> None:
    old = GCRPPO("MlpPolicy", make_vec_env(Env, 1), use_sde=True, **SMALL).learn(32)
    nn.init.constant_(old.policy.log_std, 5.0)
    old.save(path)
    models = [
        GCRPPO.warm_start(path, make_vec_env(lambda: Env(OTHER), 1), device="cpu"),
        GCRPPO.warm_start(
            path, make_vec_env(lambda: Env(OTHER), 1), device="cpu", weights_only=True
        ),
        GCRPPO.load(path, make_vec_env(Env, 1), device="cpu", weights_only=True),
    ]
    for model in models:
        assert th.equal(model.policy.log_std, old.policy.log_std)
        assert model.policy.action_dist.exploration_mat.std() > 50  # drawn anew: exp(5) = 148
        model.learn(32)


def test_from_one_objective_to_one(path: Path) -> None:
    """PPO's head is kept where there still is one reward."""
    env = make_vec_env(lambda: Env(None), 1)
    old = PPO("MlpPolicy", env, **SMALL).learn(32)
    old.save(path)
    model = GCRPPO.warm_start(path, env, device="cpu")
    assert all(map(th.equal, model.policy.parameters(), old.policy.parameters()))
    assert model.warm_start_report == (
        f"Warm start from {path}: actor and critic kept; value heads kept: reward; new: none; left "
        "behind: none; "
        "VecNormalize: no statistics in the file."
    )
    model.learn(32)


def test_an_env_id_and_a_stream(path: Path) -> None:
    with path.open("w+b") as file:
        PPO("MlpPolicy", "Reacher-v5", **SMALL).save(file)
        model = GCRPPO.warm_start(file, "Reacher-v5", device="cpu")
    assert model.reward_spec.names == ("reward_dist", "reward_ctrl")


def test_the_report_is_logged_and_saved(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL).save(path)
    model = GCRPPO.warm_start(path, make_vec_env(Env, 1), device="cpu")
    model.set_logger(Logger(None, [HumanOutputFormat(str(path.with_name("log.txt")))]))
    model.learn(32).save(path)
    model.logger.close()
    assert model.warm_start_report is not None
    assert model.warm_start_report in path.with_name("log.txt").read_text().splitlines()
    assert GCRPPO.load(path).warm_start_report == model.warm_start_report
    assert GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL).warm_start_report is None
    assert capsys.readouterr() == ("", "")


# === VecNormalize ===


@pytest.mark.parametrize(
    ("spec", "seen", "ending"),
    [
        (OTHER, False, "VecNormalize's statistics of observations and returns kept."),
        (
            RewardSpec(("shine", "rain"), (0, 1)),
            False,
            "VecNormalize's statistics of observations kept.",
        ),
        (OTHER, True, "VecNormalize keeps its own statistics."),
        (OTHER, None, "VecNormalize: none, though the file has statistics."),
    ],
)
@pytest.mark.parametrize("weights_only", [False, True])
def test_statistics(
    path: Path, spec: RewardSpec, seen: bool | None, ending: str, weights_only: bool
) -> None:
    old_env = VecNormalize(make_vec_env(Env, 2, seed=0))
    GCRPPO("MlpPolicy", old_env, **SMALL).learn(64).save(path)
    env: Any = make_vec_env(lambda: Env(spec), 2, seed=1)
    env = env if seen is None else VecNormalize(env)
    if seen:
        env.reset()
    expected = pytest.warns(match="the env has none") if seen is None else nullcontext()
    with expected:
        model = GCRPPO.warm_start(path, env, device="cpu", weights_only=weights_only)
    assert model.warm_start_report is not None
    assert model.warm_start_report.endswith(f"; {ending}")
    if seen is not None:
        assert np.array_equal(env.obs_rms.mean, old_env.obs_rms.mean) == (not seen)  # type: ignore[union-attr]
        assert (env.ret_rms.var == old_env.ret_rms.var) == ("returns" in ending)
    model.learn(64)


# === Other networks ===


def test_another_critic_begins_anew(path: Path) -> None:
    old = GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL).learn(32)
    old.save(path)
    larger = {"net_arch": {"pi": [64, 64], "vf": [128]}}
    model = GCRPPO.warm_start(
        path, make_vec_env(lambda: Env(OTHER), 1), device="cpu", policy_kwargs=larger
    )
    assert model.warm_start_report == (
        f"Warm start from {path}: actor kept, critic new (its layers differ); value heads kept: "
        "none; new: save, shine, go; "
        "left behind: go, stay, save; VecNormalize: no statistics in the file."
    )
    assert th.equal(model.policy.action_net.weight, old.policy.action_net.weight)
    model.learn(32)


def test_another_actor_is_refused(path: Path) -> None:
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), policy_kwargs={"net_arch": [8]}, **SMALL).save(path)
    message = (
        "Parameter `policy_kwargs` must leave the actor as it was, found other layers: "
        "mlp_extractor.policy_net.0.weight is "
        "(8, 4) in the file and (9, 4) in the new model; mlp_extractor.policy_net.0.bias is (8,) "
        "in the file and (9,) in the "
        "new model; action_net.weight is (2, 8) in the file and (2, 9) in the new model."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        GCRPPO.warm_start(
            path, make_vec_env(Env, 1), policy_kwargs={"net_arch": {"pi": [9], "vf": [8]}}
        )


def test_sharing_or_not_the_actor_keeps_its_features() -> None:
    """A critic that had features of its own gives them up; one that shared them begins with a
    copy.
    """

    def network(offset: float, shared: bool) -> dict[str, th.Tensor]:
        names = ("features_extractor.w", "pi_features_extractor.w", "vf_features_extractor.w")
        features = {
            name: th.full((2, 2), offset + (2 if name.startswith("vf") and not shared else 1))
            for name in names
        }
        return {
            **features,
            "action_net.w": th.ones(1),
            "value_net.weight": th.ones(1, 2),
            "value_net.bias": th.ones(1),
        }

    for shared in (True, False):
        merged, kept = merge_parameters(
            network(10, shared), network(20, not shared), ["a"], ["a"], shared
        )
        assert kept.critic
        for name in ("features_extractor.w", "pi_features_extractor.w", "vf_features_extractor.w"):
            assert (merged[name] == 21).all()
    old = {**network(20, False), "mlp_extractor.value_net.w": th.ones(3)}
    merged, kept = merge_parameters(network(10, False), old, ["a"], ["a"], False)
    assert not kept.critic  # and its features are its own, so they are new with it
    assert (merged["pi_features_extractor.w"] == 21).all()
    assert (merged["vf_features_extractor.w"] == 12).all()


def test_a_policy_of_your_own(path: Path) -> None:
    class Policy(MlpPolicy):
        pass

    GCRPPO(Policy, make_vec_env(Env, 1), **SMALL).save(path)
    assert (
        GCRPPO.warm_start(
            path, make_vec_env(lambda: Env(OTHER), 1), device="cpu"
        ).policy_class.__name__
        == "Policy"
    )
    assert (
        GCRPPO.warm_start(path, make_vec_env(Env, 1), device="cpu", policy="MlpPolicy").policy_class
        is MlpPolicy
    )


# === What does not fit ===


def test_other_algorithms_are_refused(path: Path) -> None:
    env = make_vec_env(lambda: Env(None), 1)
    for model in (
        SAC("MlpPolicy", env, buffer_size=8, device="cpu"),
        A2C("MlpPolicy", env, device="cpu"),
    ):
        model.save(path)
        message = (
            "Parameter `path` must be the file of a PPO or a GCRPPO, found another's, with a "
            f"policy of {model.policy_class.__module__}."
        )
        for load in (GCRPPO.warm_start, GCRPPO.load):
            with pytest.raises(ValueError, match=exactly(message)):
                load(path, env=make_vec_env(Env, 1))


def test_names_decide(path: Path) -> None:
    """Even where the number of components is the same."""
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL).save(path)
    same = GCRPPO.warm_start(path, make_vec_env(Env, 1), device="cpu")
    others = GCRPPO.warm_start(
        path, make_vec_env(lambda: Env(RewardSpec(("a", "b", "c"), (0, 0, 1))), 1), device="cpu"
    )
    assert same.warm_start_report is not None
    assert others.warm_start_report is not None
    assert (
        f"value heads kept: {', '.join(SPEC.names)}; new: none; left behind: none;"
        in same.warm_start_report
    )
    assert (
        "value heads kept: none; new: a, b, c; left behind: go, stay, save;"
        in others.warm_start_report
    )

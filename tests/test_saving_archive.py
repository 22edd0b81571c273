"""``load(weights_only=True)`` runs nothing that is in the file, and says what it cannot do
without.
"""

from __future__ import annotations

import base64
import io
import json
import pickle
import re
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import ConstantSchedule, LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

from sb3_gcr import GCRPPO, MlpPolicy, RewardSpec, VectorRolloutBuffer
from sb3_gcr.saving.settings import collect_settings, find_settings, to_plain
from tests.envs import SPEC, Env

SMALL: dict[str, Any] = {"n_steps": 32, "batch_size": 16, "n_epochs": 2, "seed": 0, "device": "cpu"}

_unpickled: list[str] = []
_watching = False


def _audit(event: str, args: Any) -> None:
    if _watching and event == "pickle.find_class":
        _unpickled.append(".".join(args))


sys.addaudithook(
    _audit
)  # raised by every Unpickler of the standard library; it cannot be taken off again


@pytest.fixture
def unpickled() -> Iterator[list[str]]:
    """Names of the classes and functions that pickle has looked up during the test."""
    global _watching
    _unpickled.clear()
    _watching = True
    yield _unpickled
    _watching = False


class Bomb:
    """What a stranger may have put into a file."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self) -> Any:
        return exec, (f"import pathlib; pathlib.Path({str(self.path)!r}).touch()",)


class Policy(MlpPolicy):
    pass


class Extractor(FlattenExtractor):
    pass


class Buffer(VectorRolloutBuffer):
    pass


def my_resolver(gramian: Any, levels: Any, rng: Any) -> Any:
    return np.ones(len(levels))


def exactly(message: str) -> str:
    return f"^{re.escape(message)}$"


def parameters(model: Any) -> Any:
    return th.cat([parameter.detach().flatten() for parameter in model.policy.parameters()])


def rewrite(path: Path, **entries: Any) -> None:
    """Replace or add entries of a zip file; the name may leave out its suffix."""
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, value in {**content, **entries}.items():
            if value is not None:
                archive.writestr(name, value)


def edit(path: Path, **changes: Any) -> None:
    """Change keys of our JSON."""
    with zipfile.ZipFile(path) as archive:
        description = json.loads(archive.read("sb3_gcr.json"))
    rewrite(path, **{"sb3_gcr.json": json.dumps({**description, **changes})})


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "model.zip"


# === Nothing runs ===


def test_no_code_of_the_file_runs(path: Path, tmp_path: Path, unpickled: list[str]) -> None:
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL).learn(32).save(path)
    bombs = {
        name: tmp_path / f"exploded_{index}"
        for index, name in enumerate(("data", "other", "variables"))
    }
    pickled = {name: pickle.dumps(Bomb(bomb)) for name, bomb in bombs.items()}
    with zipfile.ZipFile(path) as archive:
        data = json.loads(archive.read("data"))
    data["extra"] = {":type:": "float", ":serialized:": base64.b64encode(pickled["data"]).decode()}
    entries = {
        "data": json.dumps(data),
        "other.pth": pickled["other"],
        "pytorch_variables.pth": pickled["variables"],
    }
    rewrite(path, **entries)
    assert not unpickled
    for load in (GCRPPO.load, GCRPPO.warm_start):
        load(path, env=make_vec_env(Env, 1), device="cpu", weights_only=True).learn(32)
    assert not unpickled
    assert list(tmp_path.iterdir()) == [path]
    rewrite(path, **{name: None for name in entries if name != "data"})
    GCRPPO.load(path, make_vec_env(Env, 1))  # the same data, as SB3 loads it
    assert bombs["data"].exists()
    assert "builtins.exec" in unpickled


@pytest.mark.parametrize("name", ["policy.pth", "policy.optimizer.pth"])
@pytest.mark.parametrize("kind", ["pickle", "torch", "legacy"])
@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
def test_weights_that_are_more_than_tensors_are_refused(
    path: Path, tmp_path: Path, name: str, kind: str, unpickled: list[str]
) -> None:
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL).save(path)
    state = {"log_std": Bomb(tmp_path / "exploded")}
    stream = io.BytesIO(pickle.dumps(state) if kind == "pickle" else b"")
    if kind != "pickle":
        th.save(state, stream, _use_new_zipfile_serialization=kind == "torch")
    rewrite(path, **{name: stream.getvalue()})
    with pytest.raises(
        ValueError, match=rf"^The entry '{name}' must hold tensors and nothing else: "
    ):
        GCRPPO.load(path, make_vec_env(Env, 1), weights_only=True)
    assert not unpickled
    assert list(tmp_path.iterdir()) == [path]


# === Everything plain comes back ===


@pytest.mark.parametrize(
    ("policy", "observation", "kwargs"),
    [
        (
            "MlpPolicy",
            "Box",
            {"resolver": "guaranteed", "desired_kl": 0.01, "clip_range_vf": 0.3, "target_kl": 1.0},
        ),
        (
            "MlpPolicy",
            "Box",
            {
                "use_sde": True,
                "policy_kwargs": {"activation_fn": nn.ELU, "net_arch": {"pi": [8], "vf": [9]}},
            },
        ),
        (
            "MlpPolicy",
            "Box",
            {
                "policy_kwargs": {
                    "optimizer_class": th.optim.AdamW,
                    "share_features_extractor": False,
                }
            },
        ),
        (
            "MlpPolicy",
            "Box",
            {"policy_kwargs": {"optimizer_kwargs": {"betas": (0.8, 0.9)}}, "stats_window_size": 7},
        ),
        (
            "MultiInputPolicy",
            "DictImage",
            {"gramian_samples": 8, "advantage_scope": "minibatch", "kappa_max": 3.0},
        ),
        (
            "CnnPolicy",
            "ImageChannelsLast",
            {"policy_kwargs": {"features_extractor_kwargs": {"features_dim": 16}}},
        ),
        (
            "MlpPolicy",
            "Box",
            {
                "learning_rate": ConstantSchedule(0.001),
                "n_steps": np.int64(16),
                "gamma": np.float32(0.5),
            },
        ),
    ],
)
def test_plain_models_come_back(
    path: Path, policy: str, observation: str, kwargs: Any, unpickled: list[str]
) -> None:
    env = make_vec_env(lambda: Env(observation=observation), 2, seed=0)
    model = GCRPPO(policy, env, **{**SMALL, "seed": None, **kwargs}).learn(64)
    model.save(path)
    loaded = GCRPPO.load(path, env, device="cpu", weights_only=True)
    assert not unpickled
    full = GCRPPO.load(path, env, device="cpu")
    assert th.equal(parameters(loaded), parameters(full))
    settings = [
        to_plain(collect_settings({**one.__dict__, "policy_kwargs": None}, find_settings(GCRPPO)))
        for one in (loaded, full)
    ]
    assert settings[0] == settings[1]
    assert loaded.reward_spec == full.reward_spec
    for name in ("num_timesteps", "_n_updates", "_adaptive_learning_rate", "_n_rollouts_learned"):
        assert getattr(loaded, name) == getattr(full, name)
    assert repr(loaded.policy.optimizer) == repr(full.policy.optimizer)
    steps = [
        optimizer.state_dict()["state"]
        for optimizer in (loaded.policy.optimizer, full.policy.optimizer)
    ]
    assert all(
        th.equal(steps[0][i][key], steps[1][i][key]) for i in steps[0] for key in steps[0][i]
    )
    for one in (loaded, full):
        one.set_random_seed(1)
        env.seed(1)
        np.random.seed(1)
        one.learn(64, reset_num_timesteps=False)
    assert loaded.num_timesteps == 128
    assert th.equal(parameters(loaded), parameters(full))  # and goes on alike


def test_vec_normalize_and_the_order_of_the_heads_come_back(
    path: Path, unpickled: list[str]
) -> None:
    model = GCRPPO("MlpPolicy", VecNormalize(make_vec_env(Env, 2, seed=0)), **SMALL).learn(64)
    model.save(path)
    permuted = RewardSpec(SPEC.names[::-1], SPEC.levels[::-1])
    env = VecNormalize(DummyVecEnv([lambda: Env(permuted)]))
    loaded = GCRPPO.load(path, env, weights_only=True)
    assert loaded.reward_spec == SPEC
    assert th.equal(parameters(loaded), parameters(model))
    np.testing.assert_array_equal(env.obs_rms.mean, model.get_env().obs_rms.mean)  # type: ignore[union-attr]
    assert not unpickled


def test_one_objective(path: Path) -> None:
    for policy in ("MlpPolicy", PPO.policy_aliases["MlpPolicy"]):
        env = make_vec_env(lambda: Env(None), 1)
        model = GCRPPO(policy, env, **SMALL).learn(32)
        model.save(path)
        assert th.equal(
            parameters(GCRPPO.load(path, env, weights_only=True).learn(0)), parameters(model)
        )


def test_arguments_can_be_changed_and_logs_go_nowhere(path: Path, tmp_path: Path) -> None:
    GCRPPO(
        "MlpPolicy", make_vec_env(Env, 1), tensorboard_log=str(tmp_path / "theirs"), **SMALL
    ).save(path)
    loaded = GCRPPO.load(path, make_vec_env(Env, 1), weights_only=True, resolver="sum", n_steps=16)
    assert (loaded.resolver, loaded.n_steps, loaded.tensorboard_log) == ("sum", 16, None)
    assert "theirs" not in zipfile.ZipFile(path).read("sb3_gcr.json").decode()


# === What is not plain is refused ===


@pytest.mark.parametrize(
    ("policy", "kwargs", "listed"),
    [
        (Policy, {}, "policy (class Policy)"),
        ("MlpPolicy", {"resolver": my_resolver}, "resolver (function my_resolver)"),
        (
            "MlpPolicy",
            {"learning_rate": LinearSchedule(1e-3, 0.0, 1.0)},
            "learning_rate (LinearSchedule object)",
        ),
        ("MlpPolicy", {"rollout_buffer_class": Buffer}, "rollout_buffer_class (class Buffer)"),
        (
            "MlpPolicy",
            {
                "clip_range": my_resolver.__get__(1),
                "policy_kwargs": {"features_extractor_class": Extractor, "net_arch": [8]},
            },
            "clip_range (function my_resolver), policy_kwargs['features_extractor_class'] (class "
            "Extractor)",
        ),
        (
            "MlpPolicy",
            {"policy_kwargs": {"activation_fn": nn.PReLU}},
            "policy_kwargs['activation_fn'] (class PReLU)",
        ),
    ],
)
def test_what_a_file_needs_is_named_and_can_be_given(
    path: Path, policy: Any, kwargs: Any, listed: str
) -> None:
    env = make_vec_env(Env, 1)
    model = GCRPPO(policy, env, **SMALL, **kwargs)
    model.save(path)
    message = (
        f"Parameter `weights_only` must be False for this file, found True: it needs {listed}. "
        "Give what is missing as "
        "keyword arguments, or load it without, if you trust it."
    )
    for load in (GCRPPO.load, GCRPPO.warm_start):
        with pytest.raises(ValueError, match=exactly(message)):
            load(path, env=env, weights_only=True)
    given = kwargs if isinstance(policy, str) else {"policy": policy}
    loaded = GCRPPO.load(path, env, weights_only=True, **given)
    assert th.equal(parameters(loaded), parameters(model))
    assert type(loaded.policy) is type(model.policy)


def test_files_without_plain_settings_are_refused(path: Path) -> None:
    PPO("MlpPolicy", make_vec_env(lambda: Env(None), 1), **SMALL).save(path)
    message = (
        "Parameter `weights_only` must be False for this file, found True: it has no entry "
        "'sb3_gcr.json', which "
        "`GCRPPO.save` writes. Load it without, if you trust it."
    )
    with pytest.raises(ValueError, match=exactly(message)):
        GCRPPO.load(path, make_vec_env(Env, 1), weights_only=True)
    with pytest.raises(
        ValueError,
        match=exactly(
            "Parameter `env` must be an environment for `weights_only=True`, found None."
        ),
    ):
        GCRPPO.load(path, weights_only=True)
    path.write_text("no zip")
    with pytest.raises(
        ValueError,
        match=exactly(
            f"Parameter `path` must be a zip file, found {path}: File is not a zip file."
        ),
    ):
        GCRPPO.load(path, make_vec_env(Env, 1), weights_only=True)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": 2}, "The entry 'sb3_gcr.json' must have format 1, found 2."),
        (
            {"settings": {"env": "x"}},
            "The settings in a file must be arguments of GCRPPO, found ['env'].",
        ),
        (
            {"settings": {"tensorboard_log": "x", "rollout_buffer_class": "y"}},
            "The settings in a file must be arguments of GCRPPO, found ['rollout_buffer_class', "
            "'tensorboard_log'].",
        ),
        (
            {"settings": {"policy_kwargs": {"optimizer_class": "os.system"}}},
            "`policy_kwargs['optimizer_class']` in a file must be one of ['Adam', 'AdamW', "
            "'RMSprop', 'RMSpropTFLike', "
            "'SGD'], found 'os.system'.",
        ),
        (
            {"counters": {"policy": 3}},
            "The counters in a file must be numbers named ['_has_paid', '_n_rollouts_learned', "
            "'_adaptive_learning_rate', 'num_timesteps', '_n_updates'], found policy=3.",
        ),
        (
            {"counters": {"num_timesteps": "many"}},
            "The counters in a file must be numbers named ['_has_paid', '_n_rollouts_learned', "
            "'_adaptive_learning_rate', 'num_timesteps', '_n_updates'], found "
            "num_timesteps='many'.",
        ),
        (
            {"policy": None},
            "Parameter `policy` must be one of ['CnnPolicy', 'MlpPolicy', 'MultiInputPolicy'] or a "
            "subclass of "
            "MultiHeadActorCriticPolicy, found 'None'.",
        ),
        (
            {
                "vec_normalize": {
                    "observations": {"": {"mean": [0.0], "var": [1.0], "count": 5}},
                    "returns": {},
                }
            },
            "The saved statistics must have shape (4,), found (1,) and (1,).",
        ),
        (
            {"components": {"go": 0, "stay": 0, "shine": 1}},
            "The env's reward components must be those of the model: the model has ['go', 'stay', "
            "'shine'], found "
            "['go', 'stay', 'save'] in the env. `GCRPPO.warm_start(path, env)` begins a new model "
            "with what a saved one has learned of other components.",
        ),
    ],
)
def test_a_forged_description_is_refused(path: Path, changes: Any, message: str) -> None:
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL).save(path)
    edit(path, **changes)
    with pytest.raises(ValueError, match=exactly(message)):
        GCRPPO.load(path, VecNormalize(make_vec_env(Env, 1)), weights_only=True)


def test_saving_never_fails_for_what_is_not_plain(path: Path) -> None:
    kwargs = {
        "resolver": lambda *_, **__: np.ones(3),
        "resolver_kwargs": {"a": np.zeros(2), "b": {1: 2}},
    }
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), **SMALL, **kwargs).save(path)
    with pytest.raises(
        ValueError, match=r"resolver \(function .*<lambda>\), resolver_kwargs \(dict object\)"
    ):
        GCRPPO.load(path, make_vec_env(Env, 1), weights_only=True)

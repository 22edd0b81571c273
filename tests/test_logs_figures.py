"""The figures of an update: numbers by hand, and all keys of a training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import KVWriter, Logger, configure
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gcr import GCRPPO, RewardSpec
from sb3_gcr.envs import BatchedVecEnv
from sb3_gcr.envs.curriculum import DistanceCurriculum
from sb3_gcr.logs.figures import Record, Samples, by_key, mean_cosines, n_conflicts, n_pairs
from sb3_gcr.losses import Clip
from tests.envs import SPEC, Env
from tests.training import SMALL

TWO = RewardSpec(("go", "save"), (0, 1))


def add(
    record: Record, as_array: Any, ratios: Any, advantages: Any, values: Any, **kwargs: Any
) -> None:
    """A minibatch whose old log-probabilities, old values and returns are 0."""
    n_samples = len(ratios)
    zeros = as_array(np.zeros((n_samples, 2)))
    samples = Samples(
        log_prob=as_array(np.log(ratios)),
        old_log_prob=as_array(np.zeros(n_samples)),
        advantages=as_array(np.array(advantages)),
        values=as_array(np.array(values)),
        old_values=zeros,
        returns=zeros,
    )
    record.add(samples, **kwargs)


def to_tensor(array: Any) -> th.Tensor:
    return th.as_tensor(array, dtype=th.float32)


def to_array(array: Any) -> Any:
    return np.asarray(array, dtype=np.float32)


@pytest.mark.parametrize("as_array", [to_tensor, to_array])
def test_two_minibatches_by_hand(as_array: Any) -> None:
    """Two samples and one, of two components; ε = 0.2, values clipped at 1."""
    record = Record(Clip(0.2, 1.0, "joint"))
    add(
        record,
        as_array,
        ratios=[1.0, 2.0],
        advantages=[[1.0, -2.0], [3.0, -1.0]],
        values=[[0.5, 3.0], [-0.5, -3.0]],
        entropy_loss=as_array(np.array([-1.0])),
        kappa=2.0,
        gramian=np.array([[4.0, -2.0], [-2.0, 9.0]]),
        weights=np.array([1.5, 1.0]),
    )
    assert len(record) == 1
    record.end_epoch()
    add(
        record,
        as_array,
        ratios=[0.5],
        advantages=[[1.0, 1.0]],
        values=[[0.0, 1.0]],
        entropy_loss=as_array(np.array([-3.0])),
        kappa=4.0,
        gramian=np.array([[1.0, 3.0], [3.0, 25.0]]),
        weights=np.array([1.0, 1.0]),
    )
    record.end_epoch()
    assert len(record) == 2
    scalars, components = by_key(record, TWO)
    assert scalars == pytest.approx(
        {
            # the second sample is clipped at 1.2: L = -(1 + 3.6) / 2, (2 + 1.2) / 2; then -½, -½.
            # (1.5 · -2.3 + 1.6 - 1) / 2
            "train/policy_gradient_loss": (-3.45 + 1.6 - 1.0) / 2,
            "train/entropy_loss": -2.0,
            # (0.25 + 0.25) / 2 and 0; (1 + 1) / 2 and 1
            "train/value_loss": 0.125 + 1.0,
            "train/clip_fraction": (0.5 + 1.0) / 2,
            # of the last epoch: ½ - 1 + log 2
            "train/approx_kl": 0.19314718,
            "gcr/conflicts": 0.5,
            "gcr/conflict_rate": 0.5,
            "gcr/kappa": 3.0,
            # the second sample is clipped by PPO, and its second component pulls it back
            "gcr/brake": (0.5 + 0.0) / 2,
        },
        rel=1e-5,
    )
    assert components == pytest.approx(
        {
            "gcr/weight/go": 1.25,
            "gcr/weight/save": 1.0,
            "gcr/grad_norm/go": 1.5,
            "gcr/grad_norm/save": 4.0,
            "gcr/in_conflict/go": 0.5,
            "gcr/in_conflict/save": 0.5,
            "gcr/value_loss/go": 0.125,
            "gcr/value_loss/save": 1.0,
        },
        rel=1e-5,
    )
    # cosines -2 / (2 · 3) and 3 / 5
    np.testing.assert_allclose(mean_cosines(record), [[1, 2 / 15], [2 / 15, 1]], rtol=1e-6)
    # the last minibatch: -½ - ½ + 0.1 · -3 + 0.5 · (0 + 1)
    assert record.last_loss(ent_coef=0.1, vf_coef=0.5) == pytest.approx(-0.8)


def test_pairs_in_conflict_by_hand() -> None:
    gramians = np.array([np.eye(3), [[1, -1, 0], [-1, 4, -1], [0, -1, 1]]])
    assert n_conflicts(gramians).tolist() == [0, 2]
    assert n_pairs(gramians) == 3
    assert n_pairs(np.ones((5, 1, 1))) == 1  # no division by 0


def test_statistics_are_means_over_all_minibatches() -> None:
    """A resolver that returns 1, 2, 3, … makes the mean of the weights known."""
    calls = iter(range(1, 100))
    model = GCRPPO(
        "MlpPolicy",
        make_vec_env(Env, 1),
        resolver=lambda g, levels, rng: np.full(3, next(calls)),
        **SMALL,
    )
    model.learn(32)
    # one call when learning starts, then 2 epochs of 2 minibatches: 2, 3, 4, 5
    assert model.logger.name_to_value["gcr/weight/go"] == 3.5


def test_logged_keys(tmp_path: Path) -> None:
    model = GCRPPO("MlpPolicy", make_vec_env(Env, 2), clip_range_vf=0.5, **SMALL)
    model.set_logger(configure(str(tmp_path), ["csv", "tensorboard", "log"]))
    model.learn(192)
    model.logger.close()
    progress = pd.read_csv(tmp_path / "progress.csv")
    names = SPEC.names
    ours = {"gcr/conflicts", "gcr/conflict_rate", "gcr/kappa", "gcr/brake", "gcr/one_backward"} | {
        f"{key}/{name}"
        for key in (
            "gcr/weight",
            "gcr/grad_norm",
            "gcr/in_conflict",
            "gcr/signal",
            "rollout/ep_rew",
            "gcr/value_loss",
            "gcr/explained_variance",
        )
        for name in names
    }
    ppos = PPO("MlpPolicy", make_vec_env(lambda: Env(None), 2), clip_range_vf=0.5, **SMALL)
    ppos.set_logger(configure(str(tmp_path / "ppo"), ["csv"]))
    ppos.learn(192)
    ppos.logger.close()
    theirs = set(pd.read_csv(tmp_path / "ppo" / "progress.csv").columns)
    assert set(progress.columns) == ours | theirs
    last = progress.iloc[-1]
    assert last["train/value_loss"] == pytest.approx(
        sum(last[f"gcr/value_loss/{name}"] for name in names), rel=1e-5
    )
    assert last["rollout/ep_rew_mean"] == pytest.approx(
        sum(last[f"rollout/ep_rew/{name}"] for name in names), rel=1e-4
    )
    assert 0 <= last["gcr/conflict_rate"] <= 1
    cosines = pd.read_csv(tmp_path / "cosines.csv")
    assert list(cosines.columns) == [
        "time/total_timesteps",
        "go | stay",
        "go | save",
        "stay | save",
    ]
    assert cosines["time/total_timesteps"].tolist() == [64, 128, 192]
    assert (cosines.iloc[:, 1:].abs() <= 1).all(axis=None)
    text = (tmp_path / "log.txt").read_text()
    assert "| component | level       | return |" in text
    assert "gcr/weight" not in text
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert "gcr/weight/save" in events.Tags()["scalars"]
    assert events.Tags()["images"] == ["gcr/cosines"]


class Keys(KVWriter):
    """Keeps the keys that a logger is given."""

    def __init__(self) -> None:
        self.keys: set[str] = set()

    def write(self, key_values: Any, key_excluded: Any, step: int = 0) -> None:
        self.keys |= set(key_values)

    def close(self) -> None: ...


def keys_of(env: Any, folder: Path, callback: Any = None, **kwargs: Any) -> set[str]:
    """All keys of a training, those for a person alone and those for TensorBoard alone too."""
    model = GCRPPO("MlpPolicy", env, **{**SMALL, **kwargs})
    written = Keys()
    tensorboard = configure(str(folder), ["tensorboard"]).output_formats
    model.set_logger(Logger(str(folder), [written, *tensorboard]))
    model.learn(3 * model.n_steps * model.n_envs, callback=callback)
    model.logger.close()
    return written.keys


def trainings(folder: Path) -> dict[str, Any]:
    """Trainings that log whatever there is, by name."""
    one = RewardSpec(("only",), (0,))
    everything = {"target_kl": 0.1, "desired_kl": 0.01, "clip_range_vf": 0.2, "ent_coef": 0.01}
    throwing = make_vec_env("sb3_gcr/ThrowingMO-v0", 2, vec_env_cls=BatchedVecEnv)
    curriculum = DistanceCurriculum(0.3, 1.5, throwing=-9, stability=-9)
    return {
        "plain": lambda: keys_of(make_vec_env(Env, 2), folder),
        "everything": lambda: keys_of(VecNormalize(make_vec_env(Env, 2)), folder, **everything),
        "passes": lambda: keys_of(
            make_vec_env(Env, 2), folder, gramian_method="passes", advantage_scope="minibatch"
        ),
        "one": lambda: keys_of(make_vec_env(lambda: Env(one), 2), folder, **everything),
        "ppo": lambda: keys_of(make_vec_env(lambda: Env(None), 2), folder),
        "curriculum": lambda: keys_of(
            throwing, folder, curriculum, n_steps=64, batch_size=64, n_epochs=1, **everything
        ),
    }


@pytest.mark.parametrize("name", ["plain", "everything", "passes", "one", "ppo", "curriculum"])
def test_no_key_is_the_folder_of_another(name: str, tmp_path: Path) -> None:
    """Writers that make a file of each key, as MLflow's file store does, take all of them."""
    found = trainings(tmp_path)[name]()
    assert "train/value_loss" in found
    if name == "curriculum":
        assert "curriculum/max_distance" in found
    if name != "ppo":
        assert any(key.startswith("gcr/value_loss/") for key in found)
    folders = {key.rsplit("/", n)[0] for key in found for n in range(1, key.count("/") + 1)}
    assert not folders & found
    for key in sorted(found):  # and on a disk
        path = tmp_path / "store" / key
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()

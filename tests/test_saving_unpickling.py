"""Files of older revisions load, and what cannot be unpickled is named."""

from __future__ import annotations

import io
import pickle
import re
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gcr import GCRPPO, MlpPolicy, RewardSpec
from sb3_gcr.saving.unpickling import MOVED, Unpickler
from tests.envs import SPEC, Env

SMALL: dict[str, Any] = {"n_steps": 32, "batch_size": 16, "n_epochs": 2, "seed": 0, "device": "cpu"}
#: Saved by revision 7c8b671: 128 steps with resolver="guaranteed", desired_kl=0.01,
#: gramian_samples=8 and net_arch=[4] on two normalised envs.
OLD = Path(__file__).parent / "data/model_0.1.0.dev.zip"
#: The policy of that model, saved alone by that revision.
OLD_POLICY = OLD.with_name("policy_0.1.0.dev.pth")
#: What that revision printed for it.
ACTION = [-0.0028064020443707705, 0.06906496733427048]
#: And what it printed after 64 steps more, seeded with 5.
LATER = [0.0019930871203541756, 0.09717724472284317]


def exactly(message: str) -> str:
    return f"^{re.escape(message)}$"


def action(model: Any) -> Any:
    return model.predict(np.ones(4, np.float32), deterministic=True)[0]


# === A file of an older revision ===


@pytest.mark.parametrize("weights_only", [False, True])
def test_an_old_file_loads_and_goes_on_as_it_did(weights_only: bool) -> None:
    env = VecNormalize(make_vec_env(Env, 2))
    model = GCRPPO.load(OLD, env, device="cpu", weights_only=weights_only)
    np.testing.assert_allclose(action(model), ACTION, rtol=1e-6)
    assert model.reward_spec == SPEC
    assert (model.num_timesteps, model._n_updates) == (128, 4)
    assert (model.resolver, model.desired_kl, model.gramian_samples) == ("guaranteed", 0.01, 8)
    assert env.ret_rms.var == 14.129314762924356
    model.set_random_seed(5)
    model.learn(64, reset_num_timesteps=False)
    np.testing.assert_allclose(action(model), LATER, rtol=1e-3)
    assert (model.num_timesteps, model._n_updates) == (192, 6)
    assert model.policy.optimizer.param_groups[0]["lr"] == 0.01  # adapted, not the first 3e-4


def test_an_old_file_loads_without_an_env_and_is_saved_anew(tmp_path: Path) -> None:
    GCRPPO.load(OLD, device="cpu").save(tmp_path / "new")
    env = VecNormalize(make_vec_env(Env, 2))
    np.testing.assert_array_equal(action(GCRPPO.load(tmp_path / "new", env)), np.float32(ACTION))
    assert env.ret_rms.var == 14.129314762924356


@pytest.mark.parametrize("weights_only", [False, True])
def test_an_old_file_starts_a_new_model(weights_only: bool) -> None:
    env = VecNormalize(make_vec_env(lambda: Env(RewardSpec(("save", "shine"), (1, 0))), 2))
    model = GCRPPO.warm_start(OLD, env, device="cpu", weights_only=weights_only)
    assert model.warm_start_report == (
        f"Warm start from {OLD}: actor and critic kept; value heads kept: save; new: shine; left "
        "behind: go, stay; VecNormalize's statistics of observations and returns kept."
    )
    np.testing.assert_allclose(action(model), ACTION, rtol=1e-6)
    model.learn(64)
    assert th.isfinite(model.policy.action_net.weight).all()


def test_an_old_policy_loads_alone() -> None:
    policy = MlpPolicy.load(OLD_POLICY, device="cpu")
    np.testing.assert_allclose(action(policy), ACTION, rtol=1e-6)
    assert policy.value_net.out_features == 3


def test_old_names_are_known_only_to_the_file() -> None:
    GCRPPO.load(OLD, device="cpu")
    assert "sb3_gcr.components" not in sys.modules


def test_classes_that_have_moved_are_where_the_table_says() -> None:
    for old, new in MOVED.items():
        name = new.rpartition(".")[2]
        assert old.rpartition(".")[2] == name
        module = old.rpartition(".")[0]
        pickled = f"c{module}\n{name}\n.".encode()  # "the global of that name"
        with pytest.raises(ModuleNotFoundError):
            pickle.loads(pickled)
        found = Unpickler(io.BytesIO(pickled)).load()
        assert f"{found.__module__}.{found.__qualname__}" == new


def test_a_setting_that_an_old_file_lacks_is_what_it_was_then(tmp_path: Path) -> None:
    def env() -> VecNormalize:
        return VecNormalize(make_vec_env(Env, 2))

    for weights_only in (False, True):
        for load in (GCRPPO.load, GCRPPO.warm_start):
            old = load(OLD, env=env(), device="cpu", weights_only=weights_only)
            assert old.surrogate_clipping == "component"
            given: Any = {"surrogate_clipping": "joint", "weights_only": weights_only}
            assert load(OLD, env=env(), **given).surrogate_clipping == "joint"
    new = GCRPPO("MlpPolicy", env(), **SMALL)
    new.save(tmp_path / "new")
    assert GCRPPO.load(tmp_path / "new").surrogate_clipping == "joint"


# === What cannot be unpickled ===


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """A module of somebody else's, as long as it is there."""
    module = types.ModuleType("somebodys_module")
    monkeypatch.setitem(sys.modules, "somebodys_module", module)

    def resolver(gramian: Any, levels: Any, rng: Any) -> Any:
        return np.ones(len(levels))

    resolver.__module__, resolver.__qualname__ = "somebodys_module", "resolver"
    module.resolver = resolver  # type: ignore[attr-defined]
    return module


def test_a_module_that_is_missing_is_named(
    tmp_path: Path, module: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    GCRPPO("MlpPolicy", make_vec_env(Env, 1), resolver=module.resolver, **SMALL).save(
        tmp_path / "model"
    )
    monkeypatch.delitem(sys.modules, "somebodys_module")
    message = (
        "The file's `resolver` cannot be read here: No module named 'somebodys_module'. Install or "
        "import what it needs, or give another with `custom_objects={'resolver': …}`."
    )
    for load in (GCRPPO.load, GCRPPO.warm_start):
        with pytest.raises(ValueError, match=exactly(message)):
            load(tmp_path / "model", env=make_vec_env(Env, 1))
        loaded = load(
            tmp_path / "model", env=make_vec_env(Env, 1), custom_objects={"resolver": "sum"}
        )
        assert loaded.resolver == "sum"

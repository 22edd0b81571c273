"""sb3-contrib's methods that we override or rely on are the ones we have read."""

from __future__ import annotations

import inspect
from typing import Any

import pytest

from tests.test_upstream import fingerprint

pytest.importorskip("sb3_contrib")
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.buffers import (
    RecurrentDictRolloutBuffer,
    RecurrentRolloutBuffer,
)
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy

REVIEWED = {
    (RecurrentPPO, "__init__"): "826c0da7942f",
    (RecurrentPPO, "_setup_model"): "546ffb789fdf",
    (RecurrentPPO, "collect_rollouts"): "8a5c6a8c7a45",
    (RecurrentPPO, "train"): "0f56ee8be591",
    (RecurrentPPO, "learn"): "6c9b8bcd1d9a",
    (RecurrentPPO, "_excluded_save_params"): "e36dc96e9cd9",
    (RecurrentRolloutBuffer, "__init__"): "5f3c00793846",
    (RecurrentRolloutBuffer, "reset"): "9dd77d9e045d",
    (RecurrentRolloutBuffer, "add"): "cf1f6de7cedf",
    (RecurrentRolloutBuffer, "get"): "e0f72dbacf91",
    (RecurrentRolloutBuffer, "_get_samples"): "2358ed6af730",
    (RecurrentDictRolloutBuffer, "__init__"): "62f8e9962e8c",
    (RecurrentDictRolloutBuffer, "reset"): "9dd77d9e045d",
    (RecurrentDictRolloutBuffer, "add"): "cf1f6de7cedf",
    (RecurrentDictRolloutBuffer, "get"): "410d5d8fb431",
    (RecurrentDictRolloutBuffer, "_get_samples"): "e043a71dc0e9",
    (RecurrentActorCriticPolicy, "__init__"): "a9fbbeca2d02",
    (RecurrentActorCriticPolicy, "_process_sequence"): "aa617e180d34",
    (RecurrentActorCriticPolicy, "forward"): "3e4752ec0b35",
    (RecurrentActorCriticPolicy, "get_distribution"): "30453ebaa2b9",
    (RecurrentActorCriticPolicy, "predict_values"): "a9e9660d7126",
    (RecurrentActorCriticPolicy, "evaluate_actions"): "d11565433b9f",
}


@pytest.mark.parametrize(
    ("owner", "name"), list(REVIEWED), ids=lambda value: getattr(value, "__name__", str(value))
)
def test_upstream_is_what_we_reviewed(owner: Any, name: str) -> None:
    found = fingerprint(inspect.getattr_static(owner, name))
    if found != REVIEWED[owner, name]:
        pytest.fail(
            f"sb3-contrib has changed {owner.__name__}.{name}: review again what we override or "
            f"rely on, then put {found!r} into REVIEWED."
        )

"""What tests that train share."""

from __future__ import annotations

import re
from typing import Any

import torch as th

SMALL: dict[str, Any] = {"n_steps": 32, "batch_size": 16, "n_epochs": 2, "seed": 0, "device": "cpu"}


def exactly(message: str) -> str:
    """A pattern for these very words."""
    return f"^{re.escape(message)}$"


def parameters(model: Any) -> Any:
    """All parameters of a model's policy as one vector, a copy."""
    return th.cat([parameter.detach().flatten() for parameter in model.policy.parameters()])


def learned(model: Any, timesteps: int = 128) -> Any:
    """The model after some training, which has moved it."""
    before = parameters(model).clone()
    model.learn(timesteps)
    after = parameters(model)
    assert th.isfinite(after).all()
    assert not th.equal(before, after)
    return model

"""The table of Gymnasium's envs that report the terms of their reward."""

from __future__ import annotations

from typing import Any

_RUNNING = {"reward_forward": "task", "reward_survive": "task", "reward_ctrl": "regulariser"}


_RUNNING_WITH_CONTACT = {**_RUNNING, "reward_contact": "regulariser"}


_CRUISING = {"reward_forward": "task", "reward_ctrl": "regulariser"}


#: Arguments of :class:`RewardDecomposition` for Gymnasium's MuJoCo envs whose info reports the
#: terms of their reward.
GYMNASIUM_ENVS: dict[str, dict[str, Any]] = {
    "Ant-v5": {"components": _RUNNING_WITH_CONTACT},
    "Humanoid-v5": {"components": _RUNNING_WITH_CONTACT},
    "HalfCheetah-v5": {"components": _CRUISING},
    "Swimmer-v5": {"components": _CRUISING},
    "Hopper-v5": {"components": _RUNNING},
    "Walker2d-v5": {"components": _RUNNING},
    "Pusher-v5": {
        "components": {"reward_dist": "task", "reward_near": "task", "reward_ctrl": "regulariser"}
    },
    "Reacher-v5": {"components": {"reward_dist": "task", "reward_ctrl": "regulariser"}},
    "HumanoidStandup-v5": {
        "components": {
            "reward_linup": "task",
            "reward_quadctrl": "regulariser",
            "reward_impact": "regulariser",
        },
        "residual": "alive",
    },
    "InvertedDoublePendulum-v5": {
        "components": {
            "reward_survive": "task",
            "distance_penalty": "regulariser",
            "velocity_penalty": "regulariser",
        }
    },
    "InvertedPendulum-v5": {"components": {"reward_survive": "task"}},
}

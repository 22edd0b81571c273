"""EnvPool's MuJoCo and Playground envs, C++ threads on the CPU, as a VecEnv that reports its reward
components.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_gcr.rewards.spec import Level, RewardSpec


def _levels(task: str, regulariser: str) -> dict[str, Level]:
    """Levels by info key from the terms' names without ``reward_``."""
    names = {"task": task.split(), "regulariser": regulariser.split()}
    return {f"reward_{name}": level for level in names for name in names[level]}


_G1 = _levels(
    "tracking_lin_vel tracking_ang_vel termination alive",
    "lin_vel_z ang_vel_xy orientation base_height torques action_rate energy dof_acc "
    "feet_clearance feet_air_time feet_slip "
    "feet_height feet_phase stand_still collision contact_force joint_deviation_knee "
    "joint_deviation_hip dof_pos_limits pose",
)
_GO1 = _levels(
    "tracking_lin_vel tracking_ang_vel termination",
    "lin_vel_z ang_vel_xy orientation dof_pos_limits pose stand_still torques action_rate energy "
    "feet_clearance feet_height "
    "feet_slip feet_air_time",
)
_T1 = _levels(
    "tracking_lin_vel tracking_ang_vel termination alive",
    "lin_vel_z ang_vel_xy orientation base_height torques action_rate energy dof_acc dof_vel "
    "feet_clearance feet_air_time feet_slip feet_height feet_phase feet_distance stand_still "
    "collision joint_deviation_knee joint_deviation_hip dof_pos_limits pose",
)
_BERKELEY = _levels(
    "tracking_lin_vel tracking_ang_vel termination alive",
    "lin_vel_z ang_vel_xy orientation base_height torques action_rate energy feet_clearance "
    "feet_air_time feet_slip feet_height feet_phase stand_still joint_deviation_knee "
    "joint_deviation_hip dof_pos_limits pose",
)
_SPOT_REGULARISERS = (
    "lin_vel_z ang_vel_xy torques action_rate energy feet_slip feet_clearance feet_height "
    "feet_air_time feet_phase hip_splay "
)
# A Go1 on two legs: height and attitude are what it is to reach.
_GO1_ON_TWO_LEGS = _levels(
    "height orientation termination",
    "contact action_rate dof_pos_limits torques pose stay_still energy dof_acc",
)
_CUBE_ROTATION = _levels(
    "angvel success termination",
    "linvel pose torques energy action_rate orientation position hand_pose joint_vel",
)
#: Levels by info key of the envs whose reward is known to be the sum of these terms.
ENVPOOL_ENVS: dict[str, dict[str, Level]] = {
    "Ant-v5": _levels("forward survive", "ctrl contact"),
    "Humanoid-v5": _levels("linvel alive", "quadctrl impact"),
    "HumanoidStandup-v5": _levels("linup alive", "quadctrl impact"),
    "HalfCheetah-v5": _levels("run", "ctrl"),
    "Swimmer-v5": _levels("fwd", "ctrl"),
    "Pusher-v5": _levels("dist near", "ctrl"),
    "Reacher-v5": _levels("dist", "ctrl"),
    "G1JoystickFlatTerrain-v1": dict(_G1),
    "G1JoystickRoughTerrain-v1": dict(_G1),
    # This one's command includes the gait, so that following its phase is part of the task.
    "H1JoystickGaitTracking-v1": _levels(
        "tracking_lin_vel tracking_ang_vel feet_phase",
        "lin_vel_z ang_vel_xy feet_air_time foot_slip action_rate pose",
    ),
    "Go1JoystickFlatTerrain-v1": dict(_GO1),
    "Go1JoystickRoughTerrain-v1": dict(_GO1),
    "ApolloJoystickFlatTerrain-v1": _levels(
        "tracking termination alive",
        "lin_vel_z ang_vel_xy orientation feet_phase torques action_rate energy collision pose",
    ),
    "LeapCubeReorient-v1": _levels(
        "orientation position success termination", "hand_pose joint_vel action_rate energy"
    ),
    "T1JoystickFlatTerrain-v1": dict(_T1),
    "T1JoystickRoughTerrain-v1": dict(_T1),
    "BerkeleyHumanoidJoystickFlatTerrain-v1": dict(_BERKELEY),
    "BerkeleyHumanoidJoystickRoughTerrain-v1": dict(_BERKELEY),
    "SpotFlatTerrainJoystick-v1": _levels(
        "tracking_lin_vel tracking_ang_vel termination",
        _SPOT_REGULARISERS + "orientation posture torso_height stand_still",
    ),
    # These two are to get up: height and attitude are the task.
    "SpotGetup-v1": _levels(
        "orientation torso_height posture stand_still tracking_lin_vel tracking_ang_vel "
        "termination",
        _SPOT_REGULARISERS,
    ),
    "Go1Getup-v1": _levels(
        "orientation torso_height posture stand_still",
        "action_rate dof_pos_limits torques dof_acc dof_vel",
    ),
    "Go1Handstand-v1": dict(_GO1_ON_TWO_LEGS),
    "Go1Footstand-v1": dict(_GO1_ON_TWO_LEGS),
    "BarkourJoystick-v1": _levels(
        "tracking_lin_vel tracking_ang_vel termination",
        "lin_vel_z ang_vel_xy orientation torques action_rate stand_still feet_air_time",
    ),
    "Op3Joystick-v1": _levels(
        "tracking_lin_vel tracking_ang_vel termination",
        "lin_vel_z ang_vel_xy orientation torques action_rate zero_cmd feet_slip feet_clearance "
        "energy",
    ),
    "LeapCubeRotateZAxis-v1": dict(_CUBE_ROTATION),
    "AeroCubeRotateZAxis-v1": dict(_CUBE_ROTATION),
    "PandaPickCubeOrientation-v1": _levels(
        "gripper_box box_target lifted success",
        "no_floor_collision no_box_collision no_barrier_collision robot_target_qpos",
    ),
    "PandaPickCube-v1": _levels("gripper_box box_target", "no_floor_collision robot_target_qpos"),
    "PandaOpenCabinet-v1": _levels(
        "gripper_box box_target", "no_barrier_collision robot_target_qpos"
    ),
}
#: EnvPool's settings that are this adapter's own.
_OWN_SETTINGS = {
    "num_envs",
    "batch_size",
    "num_threads",
    "max_num_players",
    "seed",
    "env_seed",
    "gym_reset_return_info",
}


class EnvPoolVecEnv(VecEnv):
    """N EnvPool envs stepped by C++ threads, with ``reward_components`` of shape (N, K) after each
    step.

    Finished envs are reset within the step that ended them. The infos of running envs are empty;
    that of a finished one has ``terminal_observation``, ``TimeLimit.truncated``, what EnvPool
    reports, and SB3's ``episode`` statistics with the return of each component as ``r_<name>``. The
    components are what the terms of the info add to the reward: where EnvPool reports them before a
    factor (the time step, a weight), they are multiplied by it. Playground robots whose reward is
    max(Σ terms, 0) are paid Σ terms, negative too, because a clipped sum has no components. The
    pool is made at the first ``reset``, and made anew at the ``reset`` that follows ``seed``,
    because EnvPool's seeds are fixed at construction.

    :param env_id: an id of ``ENVPOOL_ENVS``, or another of EnvPool's with ``components``
    :param num_envs: number N of envs
    :param num_threads: number of C++ threads; None takes one per processor, but not more than envs
    :param seed: env i gets ``seed + i``; None draws one
    :param components: levels by info key, e.g. ``{"reward_run": "task", "reward_ctrl":
        "regulariser"}``; None looks the env up in ``ENVPOOL_ENVS`` and leaves out the terms whose
        weight is 0 in its settings
    :param residual: name of a component for the rest of EnvPool's reward, clipped or not; a task;
        ``{name: level}`` for another level
    :param envpool_kwargs: settings of the env, e.g. ``max_episode_steps=500`` or
        ``action_rate_scale=-0.01``
    :raises ImportError: if EnvPool is not installed
    """

    def __init__(
        self,
        env_id: str,
        num_envs: int,
        num_threads: int | None = None,
        seed: int | None = 0,
        components: Mapping[str, Level] | None = None,
        residual: str | Mapping[str, Level] | None = None,
        **envpool_kwargs: Any,
    ):
        _check_count("num_envs", num_envs)
        if num_threads is not None:
            _check_count("num_threads", num_threads)
        self.env_id, self.num_threads = env_id, num_threads
        self._envpool = _import_envpool()
        self._pool: Any = None
        self._waiting = False  # for the step that the threads are at
        spec = _make_spec(self._envpool, env_id, envpool_kwargs)
        self._settings, config = envpool_kwargs, spec.config._asdict()
        _check_count("max_episode_steps", config["max_episode_steps"])
        self.max_episode_steps: int = config["max_episode_steps"]
        levels = _choose_components(env_id, components, spec)
        self._keys = list(levels)
        self._factors = np.array([_factor(key, config) for key in levels])
        self._is_clipped, self._has_residual = "ctrl_dt" in config, residual is not None
        rest = {residual: "task"} if isinstance(residual, str) else residual or {}
        if not isinstance(rest, Mapping) or (self._has_residual and len(rest) != 1):
            raise ValueError(
                f"Parameter `residual` must be a name or {{name: level}}, found {residual!r}."
            )
        self.reward_spec = RewardSpec((*levels, *rest), (*levels.values(), *rest.values()))  # type: ignore[arg-type]
        self.reward_residual = next(iter(rest), None)
        self.reward_components = np.zeros((num_envs, len(self.reward_spec)))
        self._episode_returns = self.reward_components.copy()
        self.render_mode = None  # asked for by VecEnv.__init__
        action_space = spec.gymnasium_action_space
        if isinstance(action_space, spaces.Box):  # float64 in EnvPool
            low, high = action_space.low.astype(np.float32), action_space.high.astype(np.float32)
            action_space = spaces.Box(low, high, dtype=np.float32)
        super().__init__(num_envs, spec.gymnasium_observation_space, action_space)
        self._start_time = time.time()
        self.seed(seed)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seeds of the pool that the next ``reset`` makes.

        :param seed: env i gets ``seed + i``; None draws one. EnvPool's seeds end below 2³¹, so it
            is taken modulo 2³¹ - N
        :return: the seed of each env
        """
        largest = 2**31 - self.num_envs
        seed = int(np.random.randint(largest)) if seed is None else seed
        if not isinstance(seed, int | np.integer) or seed < 0:
            raise ValueError(f"Parameter `seed` must be None or an integer ≥ 0, found {seed!r}.")
        return super().seed(int(seed) % largest)

    def reset(self) -> VecEnvObs:
        """Start a new episode in each env.

        :return: observations, shape (N, ...)
        """
        if self._waiting:
            self._pool.recv()
        if self._seeds[0] is not None:
            self.close()
            self._pool_seeds = self._seeds
        if self._pool is None:
            # We count the time limit: EnvPool would call a fall in the last step of the limit a
            # truncation.
            settings = {**self._settings, "max_episode_steps": self.max_episode_steps + 1}
            threads = {"num_envs": self.num_envs, "num_threads": self.num_threads or 0}
            self._pool = self._envpool.make(
                self.env_id, "gymnasium", seed=self._pool_seeds, **threads, **settings
            )
        self._reset_seeds()
        self._reset_options()
        self._waiting = False
        self.reward_components = np.zeros_like(self.reward_components)
        self._episode_returns[:] = 0.0
        observations: VecEnvObs = self._pool.reset()[0]
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Let the threads start a step.

        :param actions: shape (N, A)
        """
        if self._pool is None:
            raise RuntimeError("EnvPoolVecEnv must be reset before a step.")
        expected = (self.num_envs, *(self.action_space.shape or ()))
        if np.shape(actions) != expected:
            raise ValueError(
                f"Parameter `actions` must have shape {expected}, found {np.shape(actions)}."
            )
        self._pool.send(np.asarray(actions))
        self._waiting = True

    def step_wait(self) -> VecEnvStepReturn:
        """Wait for the step, and reset the envs that it has finished.

        :return: observations, rewards, dones, infos
        """
        if not self._waiting:  # EnvPool would wait for ever
            raise RuntimeError("`step_wait` must follow `step_async`.")
        observations, rewards, terminated, _, info = self._pool.recv()
        self._waiting = False
        rewards = self._collect(info, rewards)
        self._episode_returns += self.reward_components
        truncated = info["elapsed_step"] >= self.max_episode_steps
        dones = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if dones.any():
            for index in np.flatnonzero(dones):
                infos[index] = self._finish(index, observations, info)
                infos[index]["TimeLimit.truncated"] = bool(
                    truncated[index] and not terminated[index]
                )
            self._episode_returns[dones] = 0.0
            # EnvPool itself would reset in the next step, and pay a dummy transition for it.
            starts, reset_info = self._pool.reset(options={"reset_mask": dones})
            if isinstance(observations, dict):
                for key, rows in starts.items():
                    observations[key][reset_info["env_id"]] = rows
            else:
                observations[reset_info["env_id"]] = starts
        return observations, rewards, dones, infos

    def _collect(self, info: dict[str, Any], rewards: NDArray[np.float32]) -> NDArray[np.float32]:
        """Set the components of the step, shape (N, K), and return the rewards, shape (N,)."""
        self.reward_components = np.stack([info[key] for key in self._keys], axis=1) * self._factors
        total = self.reward_components.sum(1)
        if self._has_residual:
            self.reward_components = np.column_stack([self.reward_components, rewards - total])
        elif self._is_clipped:
            rewards = np.where((rewards == 0) & (total < 0), total, rewards).astype(np.float32)
        return rewards

    def _finish(self, index: Any, observations: Any, info: dict[str, Any]) -> dict[str, Any]:
        """The info of an env that has finished its episode; copies, because the reset overwrites
        the observation.
        """
        returns = self._episode_returns[index].round(6).tolist()
        row = {
            key: value[index].copy() for key, value in info.items() if isinstance(value, np.ndarray)
        }
        if isinstance(observations, dict):
            row["terminal_observation"] = {
                key: value[index].copy() for key, value in observations.items()
            }
        else:
            row["terminal_observation"] = observations[index].copy()
        by_key = dict(zip(self.reward_spec.return_keys, returns, strict=True))
        row.update(by_key)
        row["episode"] = {
            "r": round(sum(returns), 6),
            "l": int(info["elapsed_step"][index]),
            "t": round(time.time() - self._start_time, 6),
            **by_key,
        }
        return row

    def close(self) -> None:
        """Stop the threads; ``reset`` would start them again."""
        if self._pool is not None:
            self._pool.close()
        self._pool, self._waiting = None, False  # the threads end with the last reference

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """The adapter's attribute of that name, once per env."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> NoReturn:
        """Not possible: the envs live in C++."""
        raise NotImplementedError(
            "EnvPool's envs take their settings at construction: EnvPoolVecEnv(..., "
            f"{attr_name}=...)."
        )

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> NoReturn:
        """Not possible: the envs live in C++."""
        raise NotImplementedError(
            f"EnvPool's envs have no Python methods, found a call of {method_name!r}."
        )

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """True for SB3's Monitor, whose statistics are in the infos."""
        return [wrapper_class is Monitor for _ in self._get_indices(indices)]


def _import_envpool() -> Any:
    try:
        return importlib.import_module("envpool")
    except ImportError:
        message = (
            "EnvPoolVecEnv needs EnvPool (Python 3.11 or newer): pip install 'sb3_gcr[envpool]'"
        )
        raise ImportError(message) from None


def _check_count(name: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"Parameter `{name}` must be an integer ≥ 1, found {value!r}.")


def _make_spec(envpool: Any, env_id: str, settings: dict[str, Any]) -> Any:
    """EnvPool's description of the env, without making one."""
    if env_id not in envpool.list_all_envs():
        raise ValueError(
            f"Parameter `env_id` must be an id of EnvPool, found {env_id!r}: valid choices are "
            f"{sorted(ENVPOOL_ENVS)}, "
            "and with `components` others of `envpool.list_all_envs()`."
        )
    valid = set(envpool.make_spec(env_id).config._asdict()) - _OWN_SETTINGS
    for name in sorted(settings):
        if name not in valid:
            raise TypeError(
                f"'{env_id}' has no setting `{name}`: valid choices are {sorted(valid)}."
            )
    try:
        return envpool.make_spec(env_id, **settings)
    except TypeError:
        raise TypeError(
            f"EnvPool's settings of '{env_id}' must have the types of their defaults, found "
            f"{settings}."
        ) from None


def _choose_components(
    env_id: str, components: Mapping[str, Level] | None, spec: Any
) -> dict[str, Level]:
    """Levels by info key, checked against what the env reports."""
    numbers = sorted(
        key.removeprefix("info:")
        for key, array in spec.state_array_spec.items()
        if key.startswith("info:") and list(array.shape) in ([], [-1]) and array.dtype.kind == "f"
    )
    if components is None:
        known = ENVPOOL_ENVS.get(env_id.removeprefix("MuJoCoPlayground/"))
        terms = [key for key in numbers if "reward" in key]
        if known is None and not terms:
            raise ValueError(
                "Parameter `env_id` must be an env that reports the terms of its reward, found "
                f"{env_id!r}: "
                f"valid choices are {sorted(ENVPOOL_ENVS)}."
            )
        if known is None:
            raise ValueError(
                f"Parameter `components` must be given for '{env_id}': levels are known only for "
                f"{sorted(ENVPOOL_ENVS)}. "
                f"The terms in its info are {terms}."
            )
        config = spec.config._asdict()
        return {key: level for key, level in known.items() if _scale(key, config) != 0}
    RewardSpec.from_dict(components)
    for key in components:
        if key not in numbers:
            raise ValueError(
                f"Parameter `components` must name keys of the info, found {key!r}: valid choices "
                f"are {numbers}."
            )
    return dict(components)


def _scale(key: str, config: dict[str, Any]) -> Any:
    """The weight of a Playground term in the settings of its env, None where there is none."""
    term = key.removeprefix("reward_")
    return config.get(f"{term}_scale", config.get(f"{term}_reward"))


def _factor(key: str, config: dict[str, Any]) -> float:
    """What EnvPool multiplies a term of its info by before it adds it to the reward."""
    if "ctrl_dt" not in config:  # Gymnasium's envs report what they add
        return 1.0
    if (
        config["task_name"].startswith("Panda") or key == "reward_success"
    ):  # reported raw, and not times the time step
        scale = _scale(key, config)
        return 1.0 if scale is None else float(scale)
    return float(config["ctrl_dt"])

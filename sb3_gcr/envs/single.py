"""One simulation of a task as a Gymnasium env, with pictures."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer
from numpy.typing import NDArray

from sb3_gcr.envs.engine import Engine
from sb3_gcr.envs.tasks.catalogue import make_task
from sb3_gcr.rewards.spec import COMPONENTS_KEY

_NO_CONTEXT = (
    "No picture could be rendered: MuJoCo found no OpenGL context. Without a screen, set the "
    "environment variable "
    "MUJOCO_GL=egl (Debian and Ubuntu: apt install libegl1 libgl1) or MUJOCO_GL=osmesa (apt "
    "install libosmesa6) "
    "before Python starts."
)
_WINDOW_CAMERA = {
    "type": mujoco.mjtCamera.mjCAMERA_TRACKING,
    "trackbodyid": 1,
    "distance": 4.0,
    "elevation": -15.0,
}


class TaskEnv(gym.Env[NDArray[Any], NDArray[Any]], gym.utils.EzPickle):
    """A task of :mod:`sb3_gcr.envs` as a Gymnasium env; ``gym.make("sb3_gcr/HumanoidRun-v0")``
    makes one.

    The info of each step has the terms of the reward by name, all of them in ``reward_components``
    (K,), and what each has summed up to since the reset as ``r_<name>``, for Monitor's
    ``info_keywords``.

    :param task: name of the task
    :param render_mode: "rgb_array", "human" or None
    :param width: of the picture, in pixels
    :param height: of the picture, in pixels
    :param kwargs: arguments of the task
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"]}  # noqa: RUF012 as declared there

    def __init__(
        self,
        task: str,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        **kwargs: Any,
    ):
        gym.utils.EzPickle.__init__(self, task, render_mode, width, height, **kwargs)
        modes = self.metadata["render_modes"]
        if render_mode not in (None, *modes):
            raise ValueError(
                f"Parameter `render_mode` must be one of {modes} or None, found {render_mode!r}."
            )
        self.task = make_task(task, **kwargs)
        self.metadata = {**self.metadata, "render_fps": round(1 / self.task.dt)}
        self.observation_space = self.task.observation_space
        self.action_space = self.task.action_space
        self.reward_spec = self.task.reward_spec
        self.render_mode = render_mode
        self.engine = Engine(self.task, 1, n_threads=1)
        self.picture_size = width, height
        self._painter = Painter(self.engine, width, height)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Start an episode.

        :param seed: of the generator, from now on
        :param options: not used
        """
        super().reset(seed=seed)
        self.engine.generators[0] = self.np_random
        observation = self.engine.reset(np.array([0]))[0]
        if self.render_mode == "human":
            self.render()
        return observation, {}

    def step(self, action: NDArray[Any]) -> tuple[NDArray[Any], float, bool, bool, dict[str, Any]]:
        """Advance by one control step.

        :param action: inside the action space
        """
        step = self.engine.step(np.asarray(action, dtype=self.action_space.dtype)[None])
        components = step.components[0]
        info: dict[str, Any] = dict(zip(self.reward_spec.names, components.tolist(), strict=True))
        info[COMPONENTS_KEY] = components
        info.update(zip(self.reward_spec.return_keys, self.engine.returns[0].tolist(), strict=True))
        if step.diverged[0]:
            info["diverged"] = True
        if self.render_mode == "human":
            self.render()
        return step.observations[0], float(components.sum()), bool(step.terminated[0]), False, info

    def set_task(self, **values: Any) -> None:
        """Set attributes of the task; ``VecEnv.env_method("set_task", ...)`` reaches workers, too.

        :param values: by name
        """
        for name, value in values.items():
            setattr(self.task, name, value)

    def render(self) -> Any:
        """A picture (height, width, 3) in mode "rgb_array"; a window in mode "human"."""
        return self._painter.paint(self.render_mode) if self.render_mode else None

    def close(self) -> None:
        """Close the window and end the simulation."""
        self._painter.close()
        self.engine.close()


class Painter:
    """Pictures of the simulations of an engine, with a camera that follows the robot.

    :param engine: the simulations
    :param width: in pixels
    :param height: in pixels
    """

    def __init__(self, engine: Engine, width: int, height: int):
        self._engine = engine
        self._size = width, height
        self._data = mujoco.MjData(engine.task.model)
        self._renderer: MujocoRenderer | None = None

    def paint(self, mode: str, index: int = 0) -> Any:
        """Show a simulation.

        :param mode: "rgb_array" or "human"
        :param index: which simulation
        :raises RuntimeError: where OpenGL is missing
        """
        model = self._engine.task.model
        if self._renderer is None:
            width, height = self._size
            model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
            model.vis.global_.offheight = max(model.vis.global_.offheight, height)
            # The model's camera follows in pictures, MuJoCo's own in a window, where the mouse
            # moves it.
            self._renderer = MujocoRenderer(
                model, self._data, _WINDOW_CAMERA, width, height, camera_name="track"
            )
        self._engine.batch.get_data(index, self._data)
        mujoco.mj_forward(model, self._data)
        try:
            return self._renderer.render(mode)
        except Exception as error:  # each back end has errors of its own
            raise RuntimeError(_NO_CONTEXT) from error

    def close(self) -> None:
        """Give the window or the context back."""
        if self._renderer is not None:
            self._renderer.close()  # type: ignore[no-untyped-call]
            self._renderer = None

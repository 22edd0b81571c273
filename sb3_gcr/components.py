"""What the reward is made of: the names and levels of its components, and where each number comes from."""

from __future__ import annotations

import operator
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

#: Words for priority levels; any integer from 0 (highest priority) on is a level too.
LEVEL_WORDS = {"task": 0, "regulariser": 1, "regularizer": 1}
#: By how much the components may miss the reward, relative to the sum of their sizes.
SUM_TOLERANCE = 1e-4
#: Info key of the components, and of the sentence that says why there are none.
COMPONENTS_KEY = "reward_components"
ERROR_KEY = "reward_components_error"

Level = str | int


@dataclass(frozen=True)
class RewardSpec:
    """Names of the K reward components and their priority levels.

    :param names: unique and not empty, in the order of the reward vector
    :param levels: one integer per name: 0 = task, 1 = regulariser, more allowed; 0 is the highest priority
    :raises ValueError: for empty, duplicate or unequally many names and levels, and negative levels
    :raises TypeError: for names that are not strings and levels that are not integers
    """

    names: tuple[str, ...]
    levels: tuple[int, ...]

    def __post_init__(self) -> None:
        for parameter in ("names", "levels"):
            given = getattr(self, parameter)
            if isinstance(given, str) or not isinstance(given, Sequence | np.ndarray):
                raise TypeError(f"Parameter `{parameter}` must be a sequence, found {given!r}.")
        names = tuple(self.names)
        if not names:
            raise ValueError("Parameter `names` must name at least one reward component, found none.")
        for name in names:
            if not isinstance(name, str):
                raise TypeError(f"Parameter `names` must contain strings, found {name!r}.")
            if not name:
                raise ValueError(f"Parameter `names` must not contain an empty name, found {list(names)}.")
            if set(name) & set(',"\r\n'):  # SB3 writes names into CSV files as they are
                raise ValueError(f"Parameter `names` must not contain commas, quotes or line breaks, found {name!r}.")
        duplicates = sorted({name for name in names if names.count(name) > 1})
        if duplicates:
            raise ValueError(f"Parameter `names` must be unique, found {duplicates} more than once in {list(names)}.")
        if len(self.levels) != len(names):
            raise ValueError(
                f"Parameter `levels` must have one level for each of the {len(names)} names, found {len(self.levels)}."
            )
        object.__setattr__(self, "names", names)
        object.__setattr__(
            self, "levels", tuple(parse_level(level, name) for name, level in zip(names, self.levels, strict=True))
        )

    @classmethod
    def from_dict(cls, components: Mapping[str, Level]) -> RewardSpec:
        """Build a spec from ``{name: "task" | "regulariser" | level}``; "regularizer" is the same word.

        :param components: levels by name, in the order of the reward vector
        :raises ValueError: for an unknown level word
        """
        if not isinstance(components, Mapping):
            raise TypeError(f"Parameter `components` must map names to levels, found {components!r}.")
        return cls(tuple(components), tuple(parse_level(level, name) for name, level in components.items()))

    def to_dict(self) -> dict[str, int]:
        """Levels by name, in order."""
        return dict(zip(self.names, self.levels, strict=True))

    @property
    def return_keys(self) -> tuple[str, ...]:
        """Info keys under which our envs report the return of each component, for Monitor's ``info_keywords``."""
        return tuple(f"r_{name}" for name in self.names)

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[tuple[str, int]]:
        return iter(zip(self.names, self.levels, strict=True))

    def __str__(self) -> str:
        return ", ".join(f"{name} ({level_label(level)})" for name, level in self)


def parse_level(level: Any, name: str) -> int:
    """The integer behind a level word or integer.

    :param level: a word of ``LEVEL_WORDS`` or an integer ≥ 0
    :param name: the component that it belongs to, for the error
    :raises ValueError: for an unknown word or a negative level
    :raises TypeError: for anything else
    """
    choices = f"valid choices are {sorted(LEVEL_WORDS)} and integers from 0 (highest priority) on"
    if isinstance(level, str):
        if level not in LEVEL_WORDS:
            raise ValueError(f"Unknown level {level!r} of reward component '{name}': {choices}.")
        return LEVEL_WORDS[level]
    try:
        if isinstance(level, bool | np.bool_):
            raise TypeError
        value = operator.index(level)
    except TypeError:
        raise TypeError(
            f"The level of reward component '{name}' must be an integer or a word, found {level!r}: {choices}."
        ) from None
    if value < 0:
        raise ValueError(f"The level of reward component '{name}' must not be negative, found {value}: {choices}.")
    return value


def level_label(level: int) -> str:
    """What people call a level: "task", "regulariser", "level 2" …"""
    return {0: "task", 1: "regulariser"}.get(level, f"level {level}")


#: The spec of a reward that nobody has taken apart.
SCALAR_REWARD = RewardSpec(("reward",), (0,))

_RUNNING = {"reward_forward": "task", "reward_survive": "task", "reward_ctrl": "regulariser"}
_RUNNING_WITH_CONTACT = {**_RUNNING, "reward_contact": "regulariser"}
_CRUISING = {"reward_forward": "task", "reward_ctrl": "regulariser"}

#: Arguments of :class:`RewardDecomposition` for Gymnasium's MuJoCo envs whose info reports the terms of their reward.
GYMNASIUM_ENVS: dict[str, dict[str, Any]] = {
    "Ant-v5": {"components": _RUNNING_WITH_CONTACT},
    "Humanoid-v5": {"components": _RUNNING_WITH_CONTACT},
    "HalfCheetah-v5": {"components": _CRUISING},
    "Swimmer-v5": {"components": _CRUISING},
    "Hopper-v5": {"components": _RUNNING},
    "Walker2d-v5": {"components": _RUNNING},
    "Pusher-v5": {"components": {"reward_dist": "task", "reward_near": "task", "reward_ctrl": "regulariser"}},
    "Reacher-v5": {"components": {"reward_dist": "task", "reward_ctrl": "regulariser"}},
    "HumanoidStandup-v5": {
        "components": {"reward_linup": "task", "reward_quadctrl": "regulariser", "reward_impact": "regulariser"},
        "residual": "alive",
    },
    "InvertedDoublePendulum-v5": {
        "components": {"reward_survive": "task", "distance_penalty": "regulariser", "velocity_penalty": "regulariser"}
    },
    "InvertedPendulum-v5": {"components": {"reward_survive": "task"}},
}


class RewardDecomposition(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Collects the terms of a reward from the info dict into ``info["reward_components"]``, a float array of shape (K,).

    The reward itself stays what it is. A term that is missing, not finite, or does not add up to the reward is reported in
    ``info["reward_components_error"]``, because a wrapper inside a ``SubprocVecEnv`` cannot raise where anyone would see
    it; ``GCRPPO`` and ``evaluate_components`` raise it with the index of the env.

    :param env: the environment to wrap
    :param components: levels by info key, e.g. ``{"reward_forward": "task", "reward_ctrl": "regulariser"}``; an info key that
        holds a vector maps to the levels of its entries by name, e.g. ``{"vector_reward": {"speed": "task", "energy": 1}}``,
        and is multiplied by ``info["reward_weights"]`` where that is present. None looks the env up in ``GYMNASIUM_ENVS``
    :param residual: name of a component for the rest of the reward, a task; ``{name: level}`` for another level
    :param tolerance: how far the sum may be from the reward, relative to the sum of the components' sizes
    :raises ValueError: if ``components`` is None and the env is not in the table, or if a name appears twice
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        components: Mapping[str, Level | Mapping[str, Level]] | None = None,
        residual: str | Mapping[str, Level] | None = None,
        tolerance: float = SUM_TOLERANCE,
    ):
        gym.utils.RecordConstructorArgs.__init__(self, components=components, residual=residual, tolerance=tolerance)
        gym.Wrapper.__init__(self, env)
        if components is None:
            known = GYMNASIUM_ENVS.get(env.spec.id if env.spec is not None else "")
            if known is None:
                raise ValueError(_unknown_env_message(env))
            components, residual = known["components"], residual if residual is not None else known.get("residual")
        if not isinstance(components, Mapping):
            raise TypeError(f"Parameter `components` must map info keys to levels, found {components!r}.")
        self.components = dict(components)
        self.residual = {residual: "task"} if isinstance(residual, str) else dict(residual or {})
        if len(self.residual) > 1:
            raise ValueError(f"Parameter `residual` must name one component, found {list(self.residual)}.")
        if not tolerance >= 0:
            raise ValueError(f"Parameter `tolerance` must be a number ≥ 0, found {tolerance!r}.")
        self.reward_tolerance = tolerance
        pairs = [
            pair
            for key, level in self.components.items()
            for pair in (level.items() if isinstance(level, Mapping) else [(key, level)])
        ] + list(self.residual.items())
        self.reward_spec = RewardSpec(
            tuple(name for name, _ in pairs), tuple(parse_level(level, name) for name, level in pairs)
        )

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the env and add the components, or the sentence that says what is wrong with them, to its info."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        try:
            components = self._collect(info, float(reward))
            fault = find_fault(components[None], np.array([reward], dtype=float), self.reward_spec, self.reward_tolerance)
            if fault is not None:
                raise ValueError(fault[1])
            info[COMPONENTS_KEY] = components
        except ValueError as error:
            info[ERROR_KEY] = str(error)
        return observation, reward, terminated, truncated, info

    def _collect(self, info: dict[str, Any], reward: float) -> NDArray[np.float64]:
        values: list[float] = []
        for key, level in self.components.items():
            if key not in info:
                raise ValueError(
                    f"Reward component '{key}' is missing: parameter `components` must name keys of `info`, "
                    f"found only {sorted(map(str, info))}."
                )
            vector = np.atleast_1d(np.asarray(info[key], dtype=float))
            if isinstance(level, Mapping) and "reward_weights" in info:
                vector = vector * np.asarray(info["reward_weights"], dtype=float)
            expected = len(level) if isinstance(level, Mapping) else 1
            if vector.shape != (expected,):
                raise ValueError(f'`info["{key}"]` must have shape ({expected},), found {vector.shape}.')
            values.extend(vector)
        if self.residual:
            values.append(reward - sum(values))
        return np.array(values)


def _unknown_env_message(env: gym.Env[Any, Any]) -> str:
    """The error for an env without a table entry, with the info keys of one step as a help to write `components`."""
    env.reset()
    info = env.step(env.action_space.sample())[4]
    name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
    return (
        f"Parameter `components` must be given for '{name}': its reward terms are known only for {sorted(GYMNASIUM_ENVS)}. "
        f"The keys of its info are {sorted(map(str, info))}."
    )


def find_fault(components: NDArray[Any], rewards: NDArray[Any], spec: RewardSpec, tolerance: float) -> tuple[int, str] | None:
    """First env whose components are not finite or do not sum to its reward.

    :param components: shape (N, K)
    :param rewards: shape (N,)
    :param spec: names the K components
    :param tolerance: allowed abs(Σ_k r^(k) - r) relative to Σ_k abs(r^(k)) + abs(r)
    :return: index of the env and what is wrong, or None
    """
    with np.errstate(invalid="ignore"):
        total = components.sum(1)
        allowed = tolerance * (np.abs(components).sum(1) + np.abs(rewards))
        healthy = np.isfinite(total)
        if tolerance < np.inf:
            healthy &= np.abs(total - rewards) <= allowed
    if healthy.all():
        return None
    index = int(np.argmin(healthy))
    row, reward = components[index], rewards[index]
    listed = ", ".join(f"{name}={value:.6g}" for name, value in zip(spec.names, row, strict=True))
    for name, value in zip(spec.names, row, strict=True):
        if not np.isfinite(value):
            return index, f"Reward component '{name}' must be finite, found {value} ({listed})."
    return index, (
        f"The reward components must sum to the reward {reward:.6g}, found {row.sum():.6g} ({listed}). "
        'Name the missing terms, or collect the rest in a component of its own with `RewardDecomposition(residual="name")`.'
    )


def find_reward_spec(env: VecEnv) -> RewardSpec | None:
    """The spec that a VecEnv, or each of its envs, carries as ``reward_spec``; None where there is none.

    :param env: a VecEnv
    :raises TypeError: if ``reward_spec`` is neither a RewardSpec nor a mapping of names to levels
    :raises ValueError: if the envs disagree
    """
    spec = getattr(env, "reward_spec", None)
    if spec is not None and not callable(spec):
        return _as_spec(spec)
    found = _attribute(env, "reward_spec")
    if all(spec is None or callable(spec) for spec in found):  # a method of that name is somebody else's
        return None
    specs = [_as_spec(spec) for spec in found]
    for index, other in enumerate(specs):
        if other != specs[0]:
            raise ValueError(
                f"All envs must have the same `reward_spec`, found ({specs[0]}) in env 0 and ({other}) in env {index}."
            )
    return specs[0]


def _attribute(env: VecEnv, name: str) -> list[Any]:
    """An attribute of all envs, or nothing where the VecEnv has none or cannot say."""
    try:
        return list(env.get_attr(name)) if env.has_attr(name) else []
    except NotImplementedError:
        return []


def _as_spec(spec: Any) -> RewardSpec:
    if isinstance(spec, RewardSpec):
        return spec
    if isinstance(spec, Mapping):
        return RewardSpec.from_dict(spec)
    raise TypeError(f"An env's `reward_spec` must be a RewardSpec or a mapping of names to levels, found {spec!r}.")


def undecomposed_id(env: VecEnv) -> str | None:
    """Id of the first env if its reward terms are known but nobody has collected them."""
    if find_reward_spec(env) is not None:
        return None
    ids = [getattr(spec, "id", None) for spec in _attribute(env, "spec")]
    return ids[0] if ids and ids[0] in GYMNASIUM_ENVS else None


def match_specs(saved: RewardSpec, found: RewardSpec | None) -> RewardSpec:
    """The spec of a model on an env: the model's order, the env's levels.

    :param saved: the model's spec
    :param found: the env's spec; None, an env without components, is fine for ``predict``
    :return: ``saved``, with the levels of ``found``; warns if they differ
    :raises ValueError: if the names differ
    """
    if found is None:
        return saved
    if set(found.names) != set(saved.names):
        raise ValueError(
            f"The env's reward components must be those of the model: the model has {list(saved.names)}, "
            f"found {list(found.names)} in the env."
        )
    levels = found.to_dict()
    matched = RewardSpec(saved.names, tuple(levels[name] for name in saved.names))
    if matched != saved:
        warnings.warn(f"The env's levels replace those of the model: now {matched}; before {saved}.", stacklevel=2)
    return matched


class ComponentReader:
    """Reads the components of each VecEnv step, in the order of the model and the units of the returned reward.

    :param env: a VecEnv that offers an (N, K) array ``reward_components``, or whose infos carry the key of that name
    :param spec: names in the order in which the model wants them
    """

    def __init__(self, env: VecEnv, spec: RewardSpec):
        env_spec = find_reward_spec(env) or spec
        self.env, self.spec = env, spec
        self._columns = [env_spec.names.index(name) for name in spec.names]
        self._batched = getattr(env, COMPONENTS_KEY, None) is not None
        self._vec_normalize = unwrap_vec_normalize(env)
        self._tolerance = max([SUM_TOLERANCE, *filter(None, _attribute(env, "reward_tolerance"))])

    def read(
        self, rewards: NDArray[Any], infos: Sequence[dict[str, Any]], timestep: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Components of the step that the VecEnv has just made.

        :param rewards: what the VecEnv returned, shape (N,)
        :param infos: what the VecEnv returned
        :param timestep: for the error message
        :return: components that sum to ``rewards``, and the same before VecNormalize; both new arrays of shape (N, K)
        :raises ValueError: if a component is missing, not finite, or they do not sum; names env index and timestep
        """
        if self._batched:
            original = np.array(getattr(self.env, COMPONENTS_KEY), dtype=float)
        else:
            original = self._read_infos(infos, timestep)
        if original.shape != (len(rewards), len(self.spec)):
            raise ValueError(
                f"`reward_components` must have shape ({len(rewards)}, {len(self.spec)}), found {original.shape}."
            )
        original = original[:, self._columns]
        components = original
        if self._vec_normalize is not None and self._vec_normalize.norm_reward:
            components = original * reward_scale(self._vec_normalize)[:, None]
        fault = find_fault(components, rewards, self.spec, self._tolerance)
        if fault is not None:
            raise ValueError(f"Env index {fault[0]} at timestep {timestep}: {fault[1]}")
        return components, original

    def _read_infos(self, infos: Sequence[dict[str, Any]], timestep: int) -> NDArray[np.float64]:
        rows = [info.get(COMPONENTS_KEY) for info in infos]
        for index, row in enumerate(rows):
            if row is None or np.shape(row) != (len(self.spec),):
                found = f"found keys {sorted(map(str, infos[index]))}" if row is None else f"found shape {np.shape(row)}"
                problem = f'`info["reward_components"]` must be an array of shape ({len(self.spec)},), {found}.'
                raise ValueError(f"Env index {index} at timestep {timestep}: {infos[index].get(ERROR_KEY, problem)}")
        return np.array(rows, dtype=float)


def reward_scale(vec_normalize: VecNormalize) -> NDArray[np.float64]:
    """What VecNormalize has just multiplied each reward by: 1 / √(var + ε), less where its clip struck, so that sums hold.

    :param vec_normalize: after a step
    :return: shape (N,)
    """
    scale = 1 / np.sqrt(vec_normalize.ret_rms.var + vec_normalize.epsilon)
    size = np.abs(vec_normalize.get_original_reward() * scale)
    return np.asarray(scale * vec_normalize.clip_reward / np.maximum(size, vec_normalize.clip_reward))

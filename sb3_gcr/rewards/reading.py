"""Reading the spec and the components of each step from a VecEnv."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_gcr.rewards.decomposition import GYMNASIUM_ENVS
from sb3_gcr.rewards.spec import COMPONENTS_KEY, ERROR_KEY, RewardSpec
from sb3_gcr.rewards.sums import SUM_TOLERANCE, find_fault


def find_reward_spec(env: VecEnv) -> RewardSpec | None:
    """The spec that a VecEnv, or each of its envs, carries as ``reward_spec``; None where there is
    none.

    :param env: a VecEnv
    :raises TypeError: if ``reward_spec`` is neither a RewardSpec nor a mapping of names to levels
    :raises ValueError: if the envs disagree
    """
    spec = getattr(env, "reward_spec", None)
    if spec is not None and not callable(spec):
        return _as_spec(spec)
    found = _attribute(env, "reward_spec")
    if all(
        spec is None or callable(spec) for spec in found
    ):  # a method of that name is somebody else's
        return None
    specs = [_as_spec(spec) for spec in found]
    for index, other in enumerate(specs):
        if other != specs[0]:
            raise ValueError(
                f"All envs must have the same `reward_spec`, found ({specs[0]}) in env 0 and "
                f"({other}) in env {index}."
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
    raise TypeError(
        "An env's `reward_spec` must be a RewardSpec or a mapping of names to levels, found "
        f"{spec!r}."
    )


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
            "The env's reward components must be those of the model: the model has "
            f"{list(saved.names)}, "
            f"found {list(found.names)} in the env. `GCRPPO.warm_start(path, env)` begins a new "
            "model with what a saved one has learned of other components."
        )
    levels = found.to_dict()
    matched = RewardSpec(saved.names, tuple(levels[name] for name in saved.names))
    if matched != saved:
        warnings.warn(
            f"The env's levels replace those of the model: now {matched}; before {saved}.",
            stacklevel=2,
        )
    return matched


class ComponentReader:
    """Reads the components of each VecEnv step, in the order of the model and the units of the
    returned reward.

    :param env: a VecEnv that offers an (N, K) array ``reward_components``, or whose infos carry the
        key of that name
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
        :return: components that sum to ``rewards``, and the same before VecNormalize; both new
            arrays of shape (N, K)
        :raises ValueError: if a component is missing, not finite, or they do not sum; names env
            index and timestep
        """
        if self._batched:
            original = np.array(getattr(self.env, COMPONENTS_KEY), dtype=float)
        else:
            original = self._read_infos(infos, timestep)
        if original.shape != (len(rewards), len(self.spec)):
            raise ValueError(
                f"`reward_components` must have shape ({len(rewards)}, {len(self.spec)}), found "
                f"{original.shape}."
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
                found = (
                    f"found keys {sorted(map(str, infos[index]))}"
                    if row is None
                    else f"found shape {np.shape(row)}"
                )
                problem = (
                    f'`info["reward_components"]` must be an array of shape ({len(self.spec)},), '
                    f"{found}."
                )
                raise ValueError(
                    f"Env index {index} at timestep {timestep}: "
                    f"{infos[index].get(ERROR_KEY, problem)}"
                )
        return np.array(rows, dtype=float)


def reward_scale(vec_normalize: VecNormalize) -> NDArray[np.float64]:
    """What VecNormalize has just multiplied each reward by: 1 / √(var + ε), less where its clip
    struck, so that sums hold.

    :param vec_normalize: after a step
    :return: shape (N,)
    """
    scale = 1 / np.sqrt(vec_normalize.ret_rms.var + vec_normalize.epsilon)
    size = np.abs(vec_normalize.get_original_reward() * scale)
    return np.asarray(
        scale * vec_normalize.clip_reward / np.maximum(size, vec_normalize.clip_reward)
    )

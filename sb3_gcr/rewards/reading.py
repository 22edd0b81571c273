"""Reading the spec and the components of each step from a VecEnv, layer by layer."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_gcr.rewards.decomposition import vector_length
from sb3_gcr.rewards.gymnasium_envs import GYMNASIUM_ENVS
from sb3_gcr.rewards.layers import (
    Placed,
    env_attributes,
    layers_of,
    outermost_attribute,
    own_attribute,
    placed_specs,
)
from sb3_gcr.rewards.layers import find_reward_spec as find_reward_spec
from sb3_gcr.rewards.residuals import ResidualWatch
from sb3_gcr.rewards.spec import COMPONENTS_KEY, ERROR_KEY, RewardSpec
from sb3_gcr.rewards.sums import (
    SINGLE_ROUNDING,
    SUM_TOLERANCE,
    find_fault,
    sum_sentence,
)
from sb3_gcr.rewards.values import as_array, as_vector, collect


def undecomposed_id(env: VecEnv) -> str | None:
    """Id of the first env if its reward terms are known but nobody has collected them."""
    if find_reward_spec(env) is not None:
        return None
    ids = [getattr(spec, "id", None) for spec in env_attributes(env, "spec")]
    return ids[0] if ids and ids[0] in GYMNASIUM_ENVS else None


def refuse_vector_rewards(env: VecEnv) -> None:
    """Refuse envs whose reward is a vector that nobody has taken apart.

    :param env: a VecEnv
    :raises ValueError: names the way out
    """
    envs = getattr(layers_of(env)[-1], "envs", None) or [None]
    length = vector_length(envs[0])
    if length is not None:
        raise ValueError(
            f"Parameter `env` must have a number as reward, found a vector of {length} entries: "
            'name them with `RewardDecomposition(env, {"first": "task", ...})`, which hands on '
            "their sum."
        )


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


class _Found(NamedTuple):
    """Components (N, K), the depth of the layer that reports them, and whether the infos of the
    envs do.
    """

    components: NDArray[np.float64]
    depth: int
    is_of_envs: bool = False


class ComponentReader:
    """Reads the components of each VecEnv step, in the order of the model and the units of the
    returned reward.

    The outermost layer with an (N, K) array ``reward_components`` says them, looked up at each
    step; where there is none, the infos do, as arrays or as dictionaries by name.

    :param env: a VecEnv
    :param spec: names in the order in which the model wants them
    :raises ValueError: if the layer that replaces a spec names other components than there are
    """

    def __init__(self, env: VecEnv, spec: RewardSpec):
        self.env, self.spec = env, spec
        self._layers = layers_of(env)
        self._specs = placed_specs(env) or [Placed(spec, len(self._layers) - 1)]
        tolerances = [*env_attributes(env, "reward_tolerance")]
        tolerances.append(outermost_attribute(env, "reward_tolerance"))
        given = [float(tolerance) for tolerance in tolerances if tolerance is not None]
        self._tolerance = max([SUM_TOLERANCE, *given])
        #: Whether a RewardDecomposition has checked the sums already, where it stands.
        self.is_checked = bool(given)
        residual = outermost_attribute(env, "reward_residual")
        residuals = [residual, *env_attributes(env, "reward_residual")]
        residual = next((name for name in residuals if name in spec.names), None)
        self._watch = None if residual is None else ResidualWatch(spec, residual)

    def is_for(self, env: VecEnv, spec: RewardSpec) -> bool:
        """Whether this reader reads an env in the order of a spec.

        :param env: a VecEnv
        :param spec: names in order
        """
        return env is self.env and spec.names == self.spec.names

    def read(
        self, rewards: NDArray[Any], infos: Sequence[dict[str, Any]], timestep: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Components of the step that the VecEnv has just made.

        :param rewards: what the VecEnv returned, shape (N,)
        :param infos: what the VecEnv returned
        :param timestep: for the error message
        :return: components that sum to ``rewards``, and the same in the units of the place where
            they stand, before the VecNormalize outside it; both new arrays of shape (N, K)
        :raises ValueError: if a component is missing, not finite, or they do not sum; names env
            index and timestep
        """
        found = self._find(infos, timestep, rewards)
        normalisers = self._normalisers(found.depth)
        self._check(found, self._rewards_at(found.depth, rewards), timestep)
        self._tell(found.components)
        if not normalisers:
            return found.components.copy(), found.components
        scale = np.prod([reward_scale(layer) for layer in normalisers], axis=0)
        expected = normalisers[-1].get_original_reward() * scale
        self._check_rewards(expected, rewards, timestep)
        return found.components * scale[:, None], found.components

    def read_original(
        self, rewards: NDArray[Any], infos: Sequence[dict[str, Any]], timestep: int
    ) -> NDArray[np.float64]:
        """Components of the step in the units of the place where they stand, shape (N, K); their
        sums are checked there, unless a RewardDecomposition inside has done so.

        :param rewards: what the VecEnv returned, shape (N,)
        :param infos: what the VecEnv returned
        :param timestep: for the error message
        :raises ValueError: if a component is missing, not finite, or they do not sum
        """
        found = self._find(infos, timestep, rewards)
        if not (found.is_of_envs and self.is_checked):
            self._check(found, self._rewards_at(found.depth, rewards), timestep)
        self._tell(found.components)
        return found.components

    def conclude(self) -> None:
        """Say now what the steps so far tell about the residual."""
        self._tell(np.empty((0, len(self.spec))), is_last=True)

    def _tell(self, components: NDArray[np.float64], is_last: bool = False) -> None:
        """Warn, once, where the residual of the first few hundred steps follows from other
        terms.
        """
        sentence = self._watch.add(components, is_last) if self._watch is not None else None
        if sentence is not None:
            warnings.warn(sentence, stacklevel=4)

    def _normalisers(self, depth: int) -> list[VecNormalize]:
        """Those outside a layer."""
        return [layer for layer in self._layers[:depth] if isinstance(layer, VecNormalize)]

    def _rewards_at(self, depth: int, rewards: NDArray[Any]) -> NDArray[Any]:
        """The rewards as they left a layer, as far as VecNormalize remembers them."""
        normalisers = self._normalisers(depth)
        return normalisers[-1].get_original_reward() if normalisers else rewards

    def _find(
        self, infos: Sequence[dict[str, Any]], timestep: int, rewards: NDArray[Any]
    ) -> _Found:
        """The components in the order of the model, and where they stand."""
        outer = self._specs[0]
        if len(self.spec) == 1:  # is the whole reward, whatever a term of that name may be
            depth = outer.depth
            return _Found(np.array(self._rewards_at(depth, rewards), dtype=float)[:, None], depth)
        for depth, layer in enumerate(self._layers):
            rows = own_attribute(layer, COMPONENTS_KEY)
            if rows is None or callable(rows):
                continue
            # Its own spec, or that of the next layer inside; else the only one that there is.
            inner = next((placed for placed in self._specs if placed.depth >= depth), outer)
            if set(inner.spec.names) == set(outer.spec.names):
                return _Found(self._from_array(rows, inner.spec, len(rewards)), depth)
            if len(infos) == 0 or COMPONENTS_KEY not in infos[0]:
                replacing = self._layers[outer.depth]
                raise ValueError(_unfilled(replacing, outer.spec, layer, inner.spec))
            break
        placed = self._specs[-1]
        if set(placed.spec.names) != set(outer.spec.names):  # then it has rewritten the infos
            placed = outer
        return _Found(
            self._from_infos(infos, placed.spec, timestep),
            self._depth_of_writer(placed),
            placed is self._specs[-1],
        )

    def _depth_of_writer(self, placed: Placed) -> int:
        """The layer that fills the infos: the one with the spec, but no wrapper of SB3's."""
        layer = type(self._layers[placed.depth])
        is_sb3s = layer.__module__.startswith("stable_baselines3.")
        return len(self._layers) - 1 if is_sb3s else placed.depth

    def _from_array(self, rows: Any, spec: RewardSpec, num_envs: int) -> NDArray[np.float64]:
        where = f"`{COMPONENTS_KEY}`"
        if isinstance(rows, Mapping):
            columns = [
                as_vector(_entry(rows, name, where), f'`{COMPONENTS_KEY}["{name}"]`', num_envs)
                for name in self.spec.names
            ]
            return np.stack(columns, axis=1)
        array = as_array(rows, where)
        if array.shape != (num_envs, len(spec)):
            raise ValueError(
                f"{where} must have shape ({num_envs}, {len(spec)}), found {array.shape}."
            )
        return array[:, self._columns(spec)]  # a copy: a simulator may overwrite its own

    def _from_infos(
        self, infos: Sequence[dict[str, Any]], spec: RewardSpec, timestep: int
    ) -> NDArray[np.float64]:
        columns = self._columns(spec)
        arrays = [
            row
            for row in (info.get(COMPONENTS_KEY) for info in infos)
            if isinstance(row, np.ndarray) and row.dtype == float and row.shape == (len(spec),)
        ]
        is_plain = len(arrays) == len(infos) and not any(ERROR_KEY in info for info in infos)
        if arrays and is_plain:  # nearly always
            return np.array(arrays)[:, columns]
        rows = []
        for index, info in enumerate(infos):
            row = info.get(COMPONENTS_KEY)
            try:
                if ERROR_KEY in info:
                    raise ValueError(info[ERROR_KEY])
                rows.append(self._from_info(row, spec, columns, info))
            except ValueError as error:
                raise ValueError(f"Env index {index} at timestep {timestep}: {error}") from None
        if not rows:
            raise ValueError(
                "`reward_components` must be an array of the VecEnv or in its infos, found neither "
                f"at timestep {timestep}."
            )
        return np.array(rows, dtype=float)

    def _from_info(
        self, row: Any, spec: RewardSpec, columns: list[int], info: dict[str, Any]
    ) -> NDArray[np.float64]:
        where = f'info["{COMPONENTS_KEY}"]'
        if isinstance(row, Mapping):
            return np.array(collect(dict.fromkeys(self.spec.names, 0), row, where))
        if row is None or np.shape(row) != (len(spec),):
            found = (
                f"found keys {sorted(map(str, info))}"
                if row is None
                else f"found shape {np.shape(row)}"
            )
            raise ValueError(f"`{where}` must be an array of shape ({len(spec)},), {found}.")
        return as_array(row, f"`{where}`")[columns]

    def _columns(self, spec: RewardSpec) -> list[int]:
        """Where the model's components are in a row of another order."""
        return [spec.names.index(name) for name in self.spec.names]

    def _check(self, found: _Found, rewards: NDArray[Any], timestep: int) -> None:
        """Refuse components that are not finite or do not sum to the rewards where they stand."""
        fault = find_fault(found.components, rewards, self.spec, self._tolerance)
        if fault is None:
            return
        sentence = fault.sentence
        if fault.is_sum and found.is_of_envs and self.is_checked:
            row, reward = found.components[fault.env_index], float(rewards[fault.env_index])
            sentence = sum_sentence(row, reward, self.spec, _changed_outside(row.sum(), reward))
        raise ValueError(f"Env index {fault.env_index} at timestep {timestep}: {sentence}")

    def _check_rewards(self, expected: NDArray[Any], rewards: NDArray[Any], timestep: int) -> None:
        """Refuse rewards that are not those that VecNormalize gave."""
        if self._tolerance == np.inf:
            return
        miss = np.abs(expected - rewards)
        wrong = np.flatnonzero(~(miss <= SINGLE_ROUNDING * (np.abs(expected) + np.abs(rewards))))
        if len(wrong):
            index = int(wrong[0])
            raise ValueError(
                f"Env index {index} at timestep {timestep}: the reward must be the "
                f"{expected[index]:.6g} that VecNormalize gave, found {rewards[index]:.6g}: a "
                "wrapper outside VecNormalize changes it after the terms were collected. Put it "
                "inside."
            )


def _changed_outside(total: float, reward: float) -> str:
    """Why terms that added up where they were collected do not add up any more."""
    factor = float(f"{reward / total:.3g}") if total else 0.0
    message = "They did where RewardDecomposition stands: a wrapper outside it changes the reward"
    if factor and abs(reward - factor * total) <= SINGLE_ROUNDING * abs(reward):
        return (
            f"{message}, here by a factor of {factor:g}. Wrap that wrapper instead, with "
            f"`RewardDecomposition(weights={factor:g})`, or scale with VecNormalize, which scales "
            "the terms along."
        )
    return f"{message}. Leave it out, or scale with VecNormalize, which scales the terms along."


def _unfilled(outer: Any, spec: RewardSpec, inner: Any, inner_spec: RewardSpec) -> str:
    """The sentence about a wrapper that names components which nobody reports."""
    return (
        f"{type(outer).__name__} names the reward components {list(spec.names)}, but the "
        f"`reward_components` of {type(inner).__name__} inside it are {list(inner_spec.names)}: a "
        "wrapper with other components must have `reward_components` of its own, shape (N, "
        f"{len(spec)})."
    )


def _entry(rows: Mapping[str, Any], name: str, where: str) -> Any:
    if name not in rows:
        raise ValueError(
            f"Reward component '{name}' is missing in {where}, found only {sorted(map(str, rows))}."
        )
    return rows[name]


def reward_scale(vec_normalize: VecNormalize) -> NDArray[np.float64]:
    """What a VecNormalize has just multiplied each reward by: 1 / √(var + ε), less where its clip
    struck, so that sums hold; 1 where it leaves rewards alone.

    :param vec_normalize: after a step
    :return: shape (N,)
    """
    rewards = vec_normalize.get_original_reward()
    if not vec_normalize.norm_reward:
        return np.ones(len(rewards))
    scale = 1 / np.sqrt(vec_normalize.ret_rms.var + vec_normalize.epsilon)
    size = np.abs(rewards * scale)
    return np.asarray(
        scale * vec_normalize.clip_reward / np.maximum(size, vec_normalize.clip_reward)
    )

"""Spaces and observations of a simulator as Gymnasium's spaces and NumPy's arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, TypeAlias

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

Groups: TypeAlias = Mapping[str, "th.Tensor | Mapping[str, th.Tensor]"]
HostObservations: TypeAlias = "NDArray[np.generic] | dict[str, NDArray[np.generic]]"


class BoxLike(Protocol):
    """A Box of Gymnasium, or mjlab's own, which has one number for all bounds."""

    shape: tuple[int, ...]
    dtype: str | np.dtype[np.generic]
    low: ArrayLike
    high: ArrayLike


class DictLike(Protocol):
    """A Dict of Gymnasium or mjlab."""

    spaces: Mapping[str, BoxLike | DictLike]


def to_host(values: th.Tensor | ArrayLike) -> NDArray[np.generic]:
    """A copy on the host: simulators write into the buffers that they return.

    :param values: a tensor on any device, or an array
    """
    if isinstance(values, th.Tensor):
        values = values.detach().cpu().numpy()
    return np.array(values)


class GroupReader:
    """Copies a simulator's observations: an array for one group, a dict by group for several.

    The terms of a group that is not concatenated are entries ``group/term`` of the dict.

    :param space: ``single_observation_space`` of the simulator
    """

    def __init__(self, space: BoxLike | DictLike):
        self._paths = _paths(space)
        boxes = {name: _box(_follow(space, path)) for name, path in self._paths.items()}
        #: Observation space of one env.
        self.space: spaces.Box | spaces.Dict
        if len(boxes) == 1:
            self.space = next(iter(boxes.values()))
        else:
            self.space = spaces.Dict(boxes)  # type: ignore[arg-type]

    def read(self, groups: Groups | th.Tensor) -> HostObservations:
        """The entries of the space, each a copy of shape (N, ...).

        :param groups: what the simulator returned
        """
        arrays = {name: to_host(_follow(groups, path)) for name, path in self._paths.items()}
        if len(arrays) == 1:
            return next(iter(arrays.values()))
        return arrays


def row_of(observations: HostObservations, index: int) -> HostObservations:
    """A copy of the observation of one env.

    :param observations: of N envs
    :param index: which of them
    """
    if isinstance(observations, dict):
        return {name: rows[index].copy() for name, rows in observations.items()}
    return observations[index].copy()


def replace_rows(
    observations: HostObservations, others: HostObservations, chosen: NDArray[np.bool_]
) -> HostObservations:
    """New arrays with the chosen rows of the others.

    :param observations: of N envs
    :param others: of the same envs
    :param chosen: shape (N,)
    """
    if isinstance(observations, dict):
        assert isinstance(others, dict)
        return {
            name: _replace_rows(rows, others[name], chosen) for name, rows in observations.items()
        }
    assert not isinstance(others, dict)
    return _replace_rows(observations, others, chosen)


def _replace_rows(
    rows: NDArray[np.generic], others: NDArray[np.generic], chosen: NDArray[np.bool_]
) -> NDArray[np.generic]:
    rows = rows.copy()
    rows[chosen] = others[chosen]
    return rows


def _paths(space: BoxLike | DictLike, path: tuple[str, ...] = ()) -> dict[str, tuple[str, ...]]:
    """Where the Boxes of a space are, by their joined names."""
    inner = _inside(space)
    if inner is None:
        return {"/".join(path): path}
    paths: dict[str, tuple[str, ...]] = {}
    for name, part in inner.items():
        paths |= _paths(part, (*path, name))
    return paths


def _inside(space: BoxLike | DictLike) -> Mapping[str, BoxLike | DictLike] | None:
    return getattr(space, "spaces", None)


def _follow(tree: Any, path: tuple[str, ...]) -> Any:
    """The leaf of a space or of observations at a path."""
    for name in path:
        tree = getattr(tree, "spaces", tree)[name]
    return tree


def _box(space: BoxLike) -> spaces.Box:
    dtype = np.dtype(space.dtype)
    low = np.broadcast_to(np.asarray(space.low, dtype), space.shape)
    high = np.broadcast_to(np.asarray(space.high, dtype), space.shape)
    return spaces.Box(low, high, dtype=dtype.type)  # type: ignore[arg-type]


def bounded_actions(space: BoxLike, limit: float) -> spaces.Box:
    """The action space of one env with finite bounds, which SB3 asks for.

    :param space: ``single_action_space`` of the simulator
    :param limit: bound where the simulator has none
    :raises TypeError: for a space that is no Box
    """
    if not hasattr(space, "low"):
        raise TypeError(f"ManagerVecEnv needs a Box of actions, found {space!r}.")
    low = np.broadcast_to(np.asarray(space.low, np.float32), space.shape)
    high = np.broadcast_to(np.asarray(space.high, np.float32), space.shape)
    return spaces.Box(
        np.where(np.isfinite(low), low, -limit).astype(np.float32),
        np.where(np.isfinite(high), high, limit).astype(np.float32),
        dtype=np.float32,
    )

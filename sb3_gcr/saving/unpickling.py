"""Reading the pickled part of a model's file, which runs what its author put into it."""

from __future__ import annotations

import base64
import io
import pickle
from collections.abc import Mapping
from typing import Any

#: Classes that older files name by where they were then.
MOVED = {
    "sb3_gcr.components.RewardSpec": "sb3_gcr.rewards.spec.RewardSpec",
    "sb3_gcr.components.RewardDecomposition": "sb3_gcr.rewards.decomposition.RewardDecomposition",
}
#: What no model can do without.
NEEDED = ("policy_class", "observation_space", "action_space", "reward_spec")
#: What unpickling raises where this Python or these packages are not those of the file.
_ERRORS = (RuntimeError, TypeError, AttributeError)


class Unpickler(pickle.Unpickler):
    """Python's ``Unpickler``, which finds classes that have moved within this package."""

    def find_class(self, module: str, name: str) -> Any:
        """Find a class or function of a pickle.

        :param module: where the pickle says that it is
        :param name: in that module
        """
        moved = MOVED.get(f"{module}.{name}", "")
        if moved:
            module, _, name = moved.rpartition(".")
        return super().find_class(module, name)


def unpickle_attributes(
    written: Mapping[str, Any], custom_objects: Mapping[str, Any]
) -> dict[str, Any]:
    """The attributes of a saved model, from what SB3's ``data_to_json`` wrote.

    One that cannot be unpickled is left out, as SB3 does, unless the model needs it.

    :param written: the JSON of the entry "data"
    :param custom_objects: replace attributes by name; these are not unpickled
    :raises ValueError: names what cannot be unpickled, and the way out
    """
    attributes: dict[str, Any] = {}
    for name, item in written.items():
        if name in custom_objects:
            attributes[name] = custom_objects[name]
        elif not isinstance(item, dict) or ":serialized:" not in item:
            attributes[name] = item
        else:
            pickled = base64.b64decode(item[":serialized:"])
            try:
                attributes[name] = Unpickler(io.BytesIO(pickled)).load()
            except ImportError as error:
                raise ValueError(_refusal(name, error)) from error
            except _ERRORS as error:
                if name in NEEDED:
                    raise ValueError(_refusal(name, error)) from error
    return attributes


def _refusal(name: str, error: Exception) -> str:
    return (
        f"The file's `{name}` cannot be read here: {error}. Install or import what it needs, or "
        f"give another with `custom_objects={{{name!r}: …}}`."
    )

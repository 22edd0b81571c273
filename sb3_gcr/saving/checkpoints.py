"""Files that are whole: the old model or the new one, never half; and which of them is the
newest.
"""

from __future__ import annotations

import io
import os
import re
import secrets
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def whole_file(path: Path) -> Iterator[io.BufferedRandom]:
    """A temporary file beside ``path`` that replaces it in one step once the block has ended and
    the disk has it all.

    After an error ``path`` is as it was. A process that is killed leaves it as it was, too, and the
    hidden temporary file.

    :param path: where the file belongs
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("x+b") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    if os.name == "posix":
        with suppress(OSError):  # some network file systems cannot sync folders
            _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Make a new name in a folder survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def saving_path(path: str | Path) -> Path:
    """Where SB3 would save: with its suffix, in a folder that exists, beside a folder of that name;
    links are followed.

    :param path: as for ``model.save``
    """
    path = Path(path)
    if path.suffix == "":
        path = Path(f"{path}.zip")
    if path.is_dir():
        warnings.warn(f"Path '{path}' is a folder. Will save instead to {path}_2", stacklevel=3)
        path = Path(f"{path}_2")
    if not path.parent.exists():
        warnings.warn(f"Path '{path.parent}' does not exist. Will create it.", stacklevel=3)
        path.parent.mkdir(exist_ok=True, parents=True)
    return Path(os.path.realpath(path))


def latest_checkpoint(folder: str | Path, name_prefix: str = "rl_model") -> Path | None:
    """The checkpoint with the most steps in a folder of SB3's ``CheckpointCallback``, None where
    there is none yet.

    With it a training that was killed goes on where its last checkpoint was made, VecNormalize's
    statistics included::

        checkpoint = latest_checkpoint("checkpoints")
        model = GCRPPO.load(checkpoint, env=env) if checkpoint else GCRPPO("MlpPolicy", env)
        callback = CheckpointCallback(save_freq=10_000, save_path="checkpoints")
        model.learn(1_000_000 - model.num_timesteps, callback, reset_num_timesteps=False)

    :param folder: ``save_path`` of the callback; it need not exist
    :param name_prefix: ``name_prefix`` of the callback
    :return: a file that is a whole zip; half ones, which SB3's own ``save`` can leave behind, are
        passed over
    """
    pattern = re.compile(rf"{re.escape(name_prefix)}_(\d+)_steps\.zip")
    found = [
        (int(match[1]), path)
        for path in Path(folder).glob("*.zip")
        if (match := pattern.fullmatch(path.name))
    ]
    return next((path for _, path in sorted(found, reverse=True) if _is_whole(path)), None)


def _is_whole(path: Path) -> bool:
    """Whether a model's file has its end; ``zipfile.is_zipfile`` is content with that of a state
    dict in half a file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return "data" in archive.namelist()
    except zipfile.BadZipFile:
        return False

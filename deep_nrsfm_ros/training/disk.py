# SPDX-License-Identifier: Apache-2.0
"""Room on the disk of the models, and words for a folder that cannot be written to."""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path


def check_room(option: str, folder: Path, megabytes: float) -> None:
    """Raise ValueError unless the disk of `folder`, which need not exist yet, has enough room.

    Args:
        option: name of the option that says how much is needed, for the message.
        folder: folder of the models.
        megabytes: MB that must be free.
    """
    place = folder.expanduser().absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    disk = shutil.disk_usage(place)
    free = disk.free / 1e6
    # A file system without a size is no disk; the attempt to write there gives a better message.
    if disk.total and free < megabytes:
        raise ValueError(
            f"{folder} is on a disk with {free:.0f} MB free; a training needs {megabytes:.0f} MB "
            f"({option}); make room, or choose another folder for models"
        )


def unwritable(folder: Path, error: Exception) -> str:
    """Return the message for a folder that could not be written to, and what to do."""
    room = ""
    with suppress(OSError):
        room = f" ({shutil.disk_usage(folder).free / 1e6:.1f} MB free on its disk)"
    return (
        f"cannot write to {folder}{room}: {getattr(error, 'strerror', None) or error}; make room "
        "and see that it is writable, or choose another --output (models_dir of the lifter); an "
        "existing model is unchanged"
    )

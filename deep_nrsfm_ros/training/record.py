"""Trainings that were cut off: what they were asked for, how far they came, how to go on.

While a training runs, `.NAME.training.json` next to its checkpoint says what it was asked for, and
the process holds a lock on that file, which ends with the process however that ends. A file without
a lock is therefore what a crash or a power cut has left. Knows nothing of ROS.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, NamedTuple

CHECKPOINT = ".checkpoint"
RECORD = ".training.json"

_AGES = ((86400, "days"), (3600, "h"), (60, "min"))
_SHOWN = ("bag", "cmu", "topic", "object", "steps")


class TrainingRecord(NamedTuple):
    """A training that began and did not end.

    age: seconds since it was last saved, or began. saved: whether there is a checkpoint to go on
    from. asked: what it was asked for by option, {} if nobody knows. running: a process is at it.
    """

    name: str
    folder: Path
    age: float
    saved: bool
    asked: dict[str, Any]
    running: bool

    def __str__(self) -> str:
        """Say which it is and how old."""
        unit, word = next((u for u in _AGES if self.age >= 2 * u[0]), (1, "s"))
        when = f"{'last saved' if self.saved else 'begun'} {self.age / unit:.0f} {word} ago"
        text = f"training of {self.name!r} in {self.folder}, {when}"
        if self.running:
            return f"{text}, under way in another process"
        if not self.saved:
            text += " and not saved since: it begins anew"
        if shown := [f"{k} {_text(self.asked[k])}" for k in _SHOWN if self.asked.get(k)]:
            text += f" ({'; '.join(shown)})"
        return f"unfinished {text}"

    @property
    def advice(self) -> str:
        """Say how to go on, or to give up."""
        if self.running:
            return "wait until it ends"
        files = (record_file(self.folder, self.name), checkpoint_file(self.folder, self.name))
        old = "" if self.asked else " with what it was asked for, of which there is no record"
        return (
            f"to go on, set train.name to {self.name!r} and train.resume to true, then call "
            f"~/train; or run: ros2 run deep_nrsfm_ros train --resume --name {self.name} --output "
            f"{self.folder}{old}; to give it up, delete {' and '.join(map(str, files))}"
        )


def checkpoint_file(folder: Path, name: str) -> Path:
    """Return where the training of a model keeps its state."""
    return folder / f".{name}{CHECKPOINT}"


def record_file(folder: Path, name: str) -> Path:
    """Return where the training of a model keeps what it was asked for."""
    return folder / f".{name}{RECORD}"


def find_records(folder: Path) -> list[TrainingRecord]:
    """Return every training in the folder that did not end, the newest first."""
    names = {
        path.name[1 : -len(suffix)]
        for suffix in (CHECKPOINT, RECORD)
        for path in (folder.iterdir() if folder.is_dir() else ())
        if path.name.startswith(".") and path.name.endswith(suffix)
    }
    found = (look(folder, name) for name in names)
    return sorted((one for one in found if one), key=lambda one: one.age)


def look(folder: Path, name: str) -> TrainingRecord | None:
    """Return the unfinished training of a model, None if there is none to go on with."""
    record, checkpoint = record_file(folder, name), checkpoint_file(folder, name)
    asked: dict[str, Any] = {}
    running = saved = False
    try:
        with suppress(FileNotFoundError), record.open(encoding="utf-8") as file:
            running = not _lock(file, fcntl.LOCK_SH)
            with suppress(ValueError, RecursionError):  # damaged: the checkpoint still counts
                read = json.load(file)
                asked = read if isinstance(read, dict) else {}
        saved = checkpoint.is_file()
        if not saved and not asked and not running:
            return None
        age = time.time() - (checkpoint if saved else record).stat().st_mtime
    except OSError:  # it ended in this moment, or is not for us to read
        return None
    return TrainingRecord(name, folder, max(age, 0.0), saved, asked, running)


@contextmanager
def keep_record(
    folder: Path, name: str, asked: Mapping[str, Any], *, resume: bool
) -> Iterator[Path]:
    """Record what a training was asked for until the end of the block; give its checkpoint's path.

    The record outlives the block if there is a checkpoint then, and the process if it is killed.
    Without `resume`, a checkpoint that is there is removed. Raises ValueError when the folder
    cannot be written to or another process trains the same.
    """
    record, checkpoint = record_file(folder, name), checkpoint_file(folder, name)
    partial = record.with_name(f"{record.name}.partial")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        before = record.open("a")
    except OSError as error:
        raise ValueError(unwritable(folder, error)) from error
    with before:
        if not _lock(before, fcntl.LOCK_EX):
            raise ValueError(
                f"another process trains {name!r} in {folder}; wait until it ends, or choose "
                "another name"
            )
        try:
            if not resume:
                checkpoint.unlink(missing_ok=True)
            file = partial.open("w", encoding="utf-8")
        except OSError as error:
            raise ValueError(unwritable(folder, error)) from error
        with file:
            try:
                _write(file, lasting(asked), record)
                yield checkpoint
            finally:
                partial.unlink(missing_ok=True)
                checkpoint.with_name(f"{checkpoint.name}.partial").unlink(missing_ok=True)
                if not checkpoint.exists():
                    record.unlink(missing_ok=True)


def _write(file: IO[str], asked: Mapping[str, Any], record: Path) -> None:
    """Write the record, locked before anybody can see it; raise ValueError if there is no room."""
    try:
        _lock(file, fcntl.LOCK_EX)
        json.dump(asked, file, indent=1, default=str)
        file.flush()
        os.fsync(file.fileno())
        Path(file.name).replace(record)
    except OSError as error:
        raise ValueError(unwritable(record.parent, error)) from error


def unwritable(folder: Path, error: Exception) -> str:
    """Return what is wrong with a folder that could not be written to, and the mend."""
    room = ""
    with suppress(OSError):
        room = f" ({shutil.disk_usage(folder).free / 1e6:.1f} MB free on its disk)"
    return (
        f"cannot write to {folder}{room}: {getattr(error, 'strerror', None) or error}; make room "
        "and see that it is writable, or choose another --output (models_dir of the lifter); a "
        "model that was there is as it was"
    )


def check_room(folder: Path, megabytes: float) -> None:
    """Raise ValueError unless the disk of a folder, which need not exist yet, has room."""
    place = folder.absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    disk = shutil.disk_usage(place)
    free = disk.free / 1e6
    # What has no size at all is no disk, and writing there says so better.
    if disk.total and free < megabytes:
        raise ValueError(
            f"{folder} is on a disk with {free:.0f} MB free; a training needs {megabytes:.0f} MB "
            "(free_disk); make room, or choose another folder for models"
        )


def lasting(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Return options as JSON has them, with whole paths: who resumes may be in another folder."""
    return {name: _lasting(value) for name, value in asked.items()}


def differences(asked: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return in words where options differ from those that a training was asked for."""
    return [
        f"{name} was {_text(asked[name])}, is {_text(value)} now"
        for name, value in lasting(now).items()
        if name in asked and asked[name] != value
    ]


def _lasting(value: Any) -> Any:
    """Return one value of `lasting`."""
    if isinstance(value, (list, tuple)):
        return [_lasting(item) for item in value]
    if isinstance(value, Path):
        return str(value.expanduser().absolute())
    # A layout or a model may be a name or a file, and only a file has a suffix.
    if isinstance(value, str) and Path(value).suffix and Path(value).expanduser().is_file():
        return str(Path(value).expanduser().absolute())
    return value


def _text(value: Any) -> str:
    """Return a value as people write it."""
    if isinstance(value, list):
        return " ".join(map(str, value)) or "empty"
    return "empty" if value in ("", None) else str(value)


def _lock(file: IO[str], kind: int) -> bool:
    """Lock a file until it is closed; return whether nobody else has."""
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True

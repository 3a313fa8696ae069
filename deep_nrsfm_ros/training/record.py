# SPDX-License-Identifier: Apache-2.0
"""Records of trainings: the configuration of each one that runs or was cut off.

While a training runs, `.NAME.training.json` next to its checkpoint holds its configuration, and
the process holds a lock on that file. The lock ends with the process, however that ends, so a
record without a lock is left from a crash or a power cut.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, NamedTuple

from deep_nrsfm_ros.training.config import TrainingConfig, option_text
from deep_nrsfm_ros.training.disk import unwritable
from deep_nrsfm_ros.training.same_name import UNFINISHED
from deep_nrsfm_ros.wording import wording

CHECKPOINT = ".checkpoint"
RECORD = ".training.json"

_AGES = ((86400, "days"), (3600, "h"), (60, "min"))


class TrainingRecord(NamedTuple):
    """A training that began and did not end.

    Attributes:
        name: name of the model.
        folder: folder of the model.
        age: seconds since it was last saved, or began.
        saved: there is a checkpoint to continue from.
        config: the configuration that it began with, None where the record is missing or damaged.
        running: a process is training it.
    """

    name: str
    folder: Path
    age: float
    saved: bool
    config: TrainingConfig | None
    running: bool

    def __str__(self) -> str:
        """Return a sentence on the training, its age, its data and its steps."""
        unit, word = next((u for u in _AGES if self.age >= 2 * u[0]), (1, "s"))
        when = f"{'last saved' if self.saved else 'begun'} {self.age / unit:.0f} {word} ago"
        text = f"training of {self.name!r} in {self.folder}, {when}"
        if self.running:
            return f"{text}, under way in another process"
        if not self.saved:
            text += " and not saved since: it begins anew"
        return f"unfinished {text}" + (f" ({_summary(self.config)})" if self.config else "")

    @property
    def advice(self) -> str:
        """Return how to continue the training, or how to give it up."""
        if self.running:
            return "wait until it ends"
        files = (record_file(self.folder, self.name), checkpoint_file(self.folder, self.name))
        options = "" if self.config else " with the options it began with, which are not recorded"
        return (
            f"to go on, set train.name to {self.name!r} and train.resume to true, then call "
            f"~/train; or run: ros2 run deep_nrsfm_ros train --resume --name {self.name} --output "
            f"{self.folder}{options}; to give it up, delete {' and '.join(map(str, files))}"
        )


def _summary(config: TrainingConfig) -> str:
    """Return data, object and steps of a training, e.g. "bags /a /b; topic /k; steps 300"."""
    values = {
        "bags": config.data.bags,
        "inputs": config.data.inputs,
        "cmu": config.data.cmu,
        "topic": config.data.topic,
        "object": config.object,
        "steps": max(config.recipe.steps, 0),  # not those that follow from the frames
    }
    return "; ".join(f"{name} {option_text(value)}" for name, value in values.items() if value)


def checkpoint_file(folder: Path, name: str) -> Path:
    """Return where the training of a model keeps its state."""
    return folder / f".{name}{CHECKPOINT}"


def record_file(folder: Path, name: str) -> Path:
    """Return where the training of a model keeps its configuration."""
    return folder / f".{name}{RECORD}"


def find_records(folder: Path) -> list[TrainingRecord]:
    """Return the records of all unfinished trainings in a folder, the newest first."""
    names = {
        path.name[1 : -len(suffix)]
        for suffix in (CHECKPOINT, RECORD)
        for path in (folder.iterdir() if folder.is_dir() else ())
        if path.name.startswith(".") and path.name.endswith(suffix)
    }
    records = (read_record(folder, name) for name in names)
    return sorted((record for record in records if record), key=lambda record: record.age)


def read_record(folder: Path, name: str) -> TrainingRecord | None:
    """Return the record of an unfinished training, None where there is nothing to continue."""
    record, checkpoint = record_file(folder, name), checkpoint_file(folder, name)
    config: TrainingConfig | None = None
    running = saved = False
    try:
        with suppress(FileNotFoundError), record.open(encoding="utf-8") as file:
            running = not _lock(file, fcntl.LOCK_SH)
            with suppress(ValueError):  # a damaged record: the checkpoint still counts
                config = TrainingConfig.from_json(file.read())
        saved = checkpoint.is_file()
        if not saved and not config and not running:
            return None
        age = time.time() - (checkpoint if saved else record).stat().st_mtime
    except OSError:  # the training ended at this moment, or its files cannot be read
        return None
    return TrainingRecord(name, folder, max(age, 0.0), saved, config, running)


@contextmanager
def keep_record(
    config: TrainingConfig, say: Callable[[str], None] = lambda sentence: None
) -> Iterator[Path]:
    """Record the configuration of a training until the end of the block.

    The record outlives the block if there is a checkpoint at its end, and a process that is killed.
    Unless the configuration says to resume, an unfinished training of the same name becomes that of
    NAME_unfinished, which can be resumed until one of NAME ends with a model that is not doubtful.

    Args:
        config: the configuration.
        say: takes a sentence on an unfinished training that becomes NAME_unfinished.

    Yields:
        The path of the checkpoint.

    Raises:
        ValueError: the folder cannot be written to, or another process trains the same model.
    """
    folder, name = config.output.folder, config.output.name
    record, checkpoint = record_file(folder, name), checkpoint_file(folder, name)
    partial = record.with_name(f"{record.name}.partial")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        existing = record.open("a")
    except OSError as error:
        raise ValueError(unwritable(folder, error)) from error
    with existing:
        if not _lock(existing, fcntl.LOCK_EX):
            raise ValueError(
                f"another process trains {name!r} in {folder}; wait until it ends, or choose "
                "another name"
            )
        try:
            if not config.resume and checkpoint.exists():
                say(_set_aside(folder, name))
            file = partial.open("w", encoding="utf-8")
        except OSError as error:
            raise ValueError(unwritable(folder, error)) from error
        with file:
            try:
                _write(file, config, record)
                yield checkpoint
            finally:
                partial.unlink(missing_ok=True)
                checkpoint.with_name(f"{checkpoint.name}.partial").unlink(missing_ok=True)
                if not checkpoint.exists():
                    record.unlink(missing_ok=True)


def _set_aside(folder: Path, name: str) -> str:
    """Give an unfinished training another name; return a sentence on it.

    Its record is copied: this process has locked it under its old name.
    """
    aside = f"{name}{UNFINISHED}"
    with suppress(OSError):
        shutil.copyfile(record_file(folder, name), record_file(folder, aside))
    checkpoint_file(folder, name).replace(checkpoint_file(folder, aside))
    resume = wording(
        f"--resume --name {aside}", node=f"train.resume with train.name {aside}", python=""
    )
    return (
        f"the training of {name!r} begins anew. The unfinished one is kept as {aside!r} until one "
        f"of {name!r} ends with a model that is not doubtful: {resume} goes on with it"
    )


def give_up_unfinished(folder: Path, name: str) -> None:
    """Remove the unfinished training that `keep_record` has set aside for one of `name`."""
    aside = f"{name}{UNFINISHED}"
    record = read_record(folder, aside)
    if record and not record.running:
        for file in (checkpoint_file(folder, aside), record_file(folder, aside)):
            file.unlink(missing_ok=True)


def _write(file: IO[str], config: TrainingConfig, record: Path) -> None:
    """Write the record, locked before its name exists; raise ValueError if there is no room."""
    try:
        _lock(file, fcntl.LOCK_EX)
        file.write(config.to_json())
        file.flush()
        os.fsync(file.fileno())
        Path(file.name).replace(record)
    except OSError as error:
        raise ValueError(unwritable(record.parent, error)) from error


def _lock(file: IO[str], kind: int) -> bool:
    """Lock a file until it is closed; return False if another process has locked it."""
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True

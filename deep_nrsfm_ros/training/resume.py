# SPDX-License-Identifier: Apache-2.0
"""How a training that was cut off is continued, from the command line and by the service."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable

from deep_nrsfm_ros.training.config import COMMAND_LINE, PARAMETERS, TrainingConfig, differences
from deep_nrsfm_ros.training.disk import check_room
from deep_nrsfm_ros.training.record import (
    TrainingRecord,
    checkpoint_file,
    find_records,
    read_record,
)


def resume_arguments(arguments: argparse.Namespace, say: Callable[[str], None]) -> TrainingConfig:
    """Return the recorded configuration with the options that the command line gives.

    Without a record the training begins anew with the options of the command line.

    Args:
        arguments: only the options that were given, by field name.
        say: takes a sentence for each option that differs from the recorded one.

    Raises:
        ValueError: there is nothing to resume, and no data to begin with either.
    """
    config = TrainingConfig.from_arguments(arguments)
    folder, name = config.output.folder.expanduser(), config.output.name
    record, data = read_record(folder, name), config.data
    has_data = bool(data.bags or data.inputs or data.cmu)
    if record is None:
        if not has_data:
            raise ValueError(
                f"--resume found no unfinished training of {name!r} in {folder}; name it by --name "
                "and --output, or say what to train on"
            )
        say("there is nothing to resume; the training begins anew")
        return config
    if record.config is None:
        if not has_data:
            raise ValueError(
                f"there is no record of the options of the training of {name!r} in {folder}; give "
                "the data and the options that it began with, or delete "
                f"{checkpoint_file(folder, name)}"
            )
        return config
    resumed = TrainingConfig.from_arguments(arguments, record.config)
    for difference in differences(record.config, resumed, COMMAND_LINE):
        say(f"warning: since this training began, {difference}")
    # The folder may have moved since.
    output = dataclasses.replace(resumed.output, folder=config.output.folder, name=name)
    return dataclasses.replace(resumed, output=output)


def resume_request(config: TrainingConfig) -> tuple[TrainingConfig, str]:
    """Return the recorded configuration that the service continues with, and a message on it.

    Unlike the command line, the service keeps to all recorded options but the threads; the message
    names those that differ from the parameters. A checkpoint without a record continues with the
    parameters.

    Raises:
        ValueError: there is no unfinished training of this name, or it runs in another process.
    """
    check_room(PARAMETERS("free_disk"), config.output.folder, config.limits.free_disk)
    record = _unfinished(config)
    if record.config is None:
        return config, ""
    message = f"goes on with {record}"
    if changes := differences(record.config, config, PARAMETERS):
        message += f"; {'; '.join(changes)}; it keeps to what it began with"
    return dataclasses.replace(record.config, output=config.output, resume=True), message


def _unfinished(config: TrainingConfig) -> TrainingRecord:
    """Return the record of the training to continue; raise ValueError if there is none."""
    folder, name = config.output.folder, config.output.name
    record = read_record(folder, name)
    if record is None:
        names = ", ".join(other.name for other in find_records(folder)) or "none"
        raise ValueError(
            f"train.resume is true, but there is no unfinished training of {name!r} in {folder} "
            f"(unfinished: {names}); set train.resume to false to begin one"
        )
    if record.running:
        raise ValueError(f"{record}: {record.advice}")
    return record

# SPDX-License-Identifier: Apache-2.0
"""One training from its configuration to the model file."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from safetensors import SafetensorError

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.held_out import Split, split
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, Model, load_once, save_model
from deep_nrsfm_ros.nrsfm.recipe import LayoutLossWeights
from deep_nrsfm_ros.training.config import COMMAND_LINE, TrainingConfig
from deep_nrsfm_ros.training.data_check import check_dataset
from deep_nrsfm_ros.training.disk import unwritable
from deep_nrsfm_ros.training.distributed import join, rank
from deep_nrsfm_ros.training.fine_tuning import inherit, start_from
from deep_nrsfm_ros.training.limb_exchange import LimbExchange
from deep_nrsfm_ros.training.preparation import Prepared, prepare, read_data, read_people
from deep_nrsfm_ros.training.record import checkpoint_file, keep_record
from deep_nrsfm_ros.training.reporter import CancelledError, Reporter
from deep_nrsfm_ros.training.validation import find_layouts, validate

if TYPE_CHECKING:
    from deep_nrsfm_ros.training.judge import Judgement
    from deep_nrsfm_ros.training.trainer import Trainer


class TrainingResult(NamedTuple):
    """A training that has ended and whose model is saved.

    Attributes:
        model: the model that was learned.
        path: its file.
        prepared: the data it was learned from.
        state: "finished" or "cancelled".
        message: one line for people about the end.
        detector_layout: value of the lifter's `keypoint_layout` for the detector of the data; ""
            where that is the layout of the model, or the data is of several.
        mapping: field mapping of the messages in the data; "" for none.
        judgement: whether the model should replace the one at hand; None: it was cut off.
        frames: those of the training and those held out; None: nothing is held out.
        rival: the model at hand; None: there is none.
    """

    model: Model
    path: Path
    prepared: Prepared
    state: str
    message: str
    detector_layout: str = ""
    mapping: str = ""
    judgement: Judgement | None = None
    frames: Split | None = None
    rival: Model | None = None


def run(
    config: TrainingConfig, reporter: Reporter, should_stop: Callable[[], bool]
) -> TrainingResult | None:
    """Read the data, train, and save the model.

    Args:
        config: what to train on, how, and where the model goes.
        reporter: takes progress and warnings.
        should_stop: called often; True ends the training, which saves the best model so far.

    Returns:
        The result; None in all but the first of several processes.

    Raises:
        ValueError: for a configuration, data or a folder that a training cannot work with.
        CancelledError: the training was stopped before anything was learned.
    """
    validate(config, COMMAND_LINE)
    try:
        dataset, detector_layout = read_data(config, reporter)
        if not config.data.cmu:
            source, _ = find_layouts(config, COMMAND_LINE)
            dataset = check_dataset(dataset, source, config.data.image_size, reporter)
        prepared = prepare(config.curation, dataset, reporter, has_start=bool(config.start))
    except (ValueError, OSError) as error:
        if should_stop():  # whoever stopped it meanwhile does not ask what the data is like
            raise CancelledError from error
        raise
    try:
        with _record(config) as checkpoint:
            result = _train_and_save(config, prepared, checkpoint, reporter, should_stop)
            return result and result._replace(detector_layout=detector_layout)
    except SafetensorError as error:  # neither OSError nor ValueError, though the disk is full
        raise ValueError(unwritable(config.output.folder, error)) from error


def _record(config: TrainingConfig) -> AbstractContextManager[Path]:
    """Return the context of the training's record; only the first of several processes keeps it."""
    if rank():
        return nullcontext(checkpoint_file(config.output.folder, config.output.name))
    return keep_record(config)


def _train_and_save(
    config: TrainingConfig,
    prepared: Prepared,
    checkpoint: Path,
    reporter: Reporter,
    should_stop: Callable[[], bool],
) -> TrainingResult | None:
    """Train on the prepared data; the first process saves the model and returns the result."""
    start, rival = (load_once(Path(f)) if f else None for f in (config.start, config.rival))
    _describe(prepared, reporter, start)
    share = config.curation.held_out if rival else 0.0
    frames = split(prepared.dataset, share)
    trainer = _train(config, frames.training, checkpoint, reporter, should_stop)
    if trainer.group.rank:
        return None
    if not trainer.step and config.recipe.steps:
        checkpoint.unlink(missing_ok=True)
        raise CancelledError
    from deep_nrsfm_ros.training.finish import finish
    from deep_nrsfm_ros.training.judge import judge

    dataset = prepared.dataset
    people = read_people(config, dataset.layout, reporter)
    model = finish(trainer, config.output.name, dataset.layout, dataset.source, people)
    date = time.strftime("%Y-%m-%d", time.gmtime())
    model = dataclasses.replace(model, provenance=model.provenance | {"date": date})
    if start:
        model = inherit(model, start)
    judgement = judge(frames, model, rival) if trainer.end_reason else None
    if judgement:
        model.provenance["judgement"] = judgement.record()
    path = config.output.folder / f"{config.output.name}{MODEL_SUFFIX}"
    if judgement and judgement.doubtful and path.resolve() == Path(config.rival).resolve():
        model = dataclasses.replace(model, name=f"{model.name}_doubtful")
        path = path.with_name(f"{model.name}{MODEL_SUFFIX}")
    save_model(path, model)
    ending = _ending(trainer, path, model, checkpoint)
    return TrainingResult(
        *(model, path, prepared, *ending),
        mapping=config.data.mapping,
        judgement=judgement,
        frames=None if frames.held_out is frames.training else frames,
        rival=rival,
    )


def _describe(prepared: Prepared, reporter: Reporter, start: Model | None) -> None:
    """Report the size of the dataset, what it cannot teach, and what the training starts from."""
    dataset = prepared.dataset
    reporter.say(
        f"starts from model {start.name!r} (--from none, train.from none: from random weights)"
        if start
        else "starts from random weights"
    )
    if dataset.layout.warning and not start:  # a start passes its handedness on
        reporter.warn(dataset.layout.warning)
    times_visible = zip(dataset.layout.keypoints, dataset.visible.sum(0), strict=True)
    if missing := [name for name, times in times_visible if not times]:
        reporter.warn(f"no frame shows {', '.join(missing)}: the model will only guess them")
    reporter.say(f"{len(dataset)} frames of {len(dataset.layout)} keypoints ({dataset.source})")


def _train(
    config: TrainingConfig,
    dataset: Dataset,
    checkpoint: Path,
    reporter: Reporter,
    should_stop: Callable[[], bool],
) -> Trainer:
    """Return the trainer after the training loop; this process has left its group then."""
    weights = config.layout_loss
    origin = load_once(Path(config.start)) if config.start else None
    start = start_from(origin, dataset.layout) if origin else None
    weights.check(dataset.layout, COMMAND_LINE)
    import torch  # takes seconds; a wrong configuration is refused without it

    from deep_nrsfm_ros.nrsfm.layout_loss import LayoutLoss
    from deep_nrsfm_ros.training.loop import Callbacks, Checkpointing, train
    from deep_nrsfm_ros.training.setup import Setup

    if config.output.threads:
        torch.set_num_threads(config.output.threads)
    loss = None
    if weights != LayoutLossWeights():
        is_mirrored = origin is not None and bool(np.linalg.det(origin.object_frame) < 0)
        loss = LayoutLoss(weights, dataset.layout, mirrored_axes=is_mirrored)
    group = join()
    trainer = train(
        dataset.points,
        dataset.visible,
        config.preset,
        Setup(
            start,
            loss,
            limits=config.limits,
            group=group,
            limb_exchange=LimbExchange.of(dataset.layout),
            own_frames=not config.data.cmu,
        ),
        Callbacks(on_progress=reporter.training, should_stop=should_stop, on_message=reporter.say),
        Checkpointing(checkpoint),
    )
    group.close()
    if trainer.minutes_needed and trainer.end_reason:
        reporter.warn(
            "the factorisations of the few frames were cut short: give --minutes "
            f"{trainer.minutes_needed:g} (train.minutes), or leave it out, for a better model"
        )
    return trainer


def _ending(trainer: Trainer, path: Path, model: Model, checkpoint: Path) -> tuple[str, str]:
    """Return the state and the message with which the training ends; remove a used checkpoint."""
    if not trainer.end_reason:
        message = f"{path} holds what was learned so far"
        return "cancelled", message + (", --resume goes on" if checkpoint.exists() else "")
    checkpoint.unlink(missing_ok=True)
    message, steps = f"{path} {json.dumps(model.quality)}", trainer.preset.recipe.steps
    if trainer.step < steps:
        message += f"; after {trainer.step} of {steps} steps {trainer.end_reason}"
    return "finished", message

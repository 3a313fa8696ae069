# SPDX-License-Identifier: Apache-2.0
"""One training from its configuration to the model file."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from safetensors import SafetensorError

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.hands import as_right_hands
from deep_nrsfm_ros.data.held_out import MIN_HELD_OUT, MIN_HELD_OUT_ALONE, Split, split
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, Model, load_once, save_model
from deep_nrsfm_ros.nrsfm.recipe import LayoutLossWeights
from deep_nrsfm_ros.training.config import TrainingConfig, option_names
from deep_nrsfm_ros.training.data_check import SourceFinding, never_seen
from deep_nrsfm_ros.training.disk import unwritable
from deep_nrsfm_ros.training.distributed import join, rank
from deep_nrsfm_ros.training.fine_tuning import inherit, start_from
from deep_nrsfm_ros.training.limb_exchange import LimbExchange
from deep_nrsfm_ros.training.preparation import Prepared, prepare, read_data, read_people
from deep_nrsfm_ros.training.record import checkpoint_file, give_up_unfinished, keep_record
from deep_nrsfm_ros.training.reporter import CancelledError, Reporter
from deep_nrsfm_ros.training.same_name import (
    BEFORE,
    CUT_OFF,
    OldModel,
    keep_before,
    name_beside,
    old_model,
)
from deep_nrsfm_ros.training.validation import validate
from deep_nrsfm_ros.wording import wording

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
        rival: the model that it was judged beside; None: there is none.
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
    validate(config, option_names())
    try:
        dataset, detector_layout, findings = read_data(config, reporter)
        if config.data.hands:
            dataset = as_right_hands(dataset, config.data.hands)
        prepared = prepare(config.curation, dataset, reporter, has_start=bool(config.start))
    except (ValueError, OSError) as error:
        if should_stop():  # whoever stopped it meanwhile does not ask what the data is like
            raise CancelledError from error
        raise
    try:
        with _record(config, reporter) as checkpoint:
            result = _train_and_save(config, prepared, findings, checkpoint, reporter, should_stop)
            return result and result._replace(detector_layout=detector_layout)
    except SafetensorError as error:  # neither OSError nor ValueError, though the disk is full
        raise ValueError(unwritable(config.output.folder, error)) from error


def _record(config: TrainingConfig, reporter: Reporter) -> AbstractContextManager[Path]:
    """Return the context of the training's record; only the first of several processes keeps it."""
    if rank():
        return nullcontext(checkpoint_file(config.output.folder, config.output.name))
    return keep_record(config, reporter.warn)


def _train_and_save(
    config: TrainingConfig,
    prepared: Prepared,
    findings: tuple[SourceFinding, ...],
    checkpoint: Path,
    reporter: Reporter,
    should_stop: Callable[[], bool],
) -> TrainingResult | None:
    """Train on the prepared data; the first process saves the model and returns the result."""
    start, rival = (load_once(Path(f)) if f else None for f in (config.start, config.rival))
    is_resumed = config.resume and checkpoint.exists()
    _describe(prepared, reporter, start, is_resumed=is_resumed)
    old = old_model(config.output.folder, config.output.name)
    rivals = _rivals(config, prepared.dataset.layout, rival, old)
    fewest = MIN_HELD_OUT if rivals else MIN_HELD_OUT_ALONE
    frames = split(prepared.dataset, config.curation.held_out, fewest)
    if frames.held_out is not frames.training:
        reporter.say(_shared_out(len(prepared.dataset), frames))
    trainer = _train(config, frames.training, checkpoint, reporter, should_stop)
    if trainer.group.rank:
        return None
    if not trainer.step and config.recipe.steps:
        checkpoint.unlink(missing_ok=True)
        raise CancelledError
    from deep_nrsfm_ros.training.finish import finish

    dataset = prepared.dataset
    reporter.judging(
        "bones and errors of the new model; it takes some seconds, up to a minute where other "
        "programs have the cores"
    )
    people = read_people(config, dataset.layout, reporter)
    model = finish(trainer, config.output.name, dataset.layout, dataset.source, people)
    date = time.strftime("%Y-%m-%d", time.gmtime())
    model = dataclasses.replace(model, provenance=model.provenance | {"date": date})
    if start:
        model = inherit(model, start)
    judgement, rival = None, rivals[0] if rivals else None
    if trainer.end_reason:
        beside = f" beside model {rival.name!r}" if rival else ""
        reporter.judging(f"the new model on {len(frames.held_out)} frames{beside}")
        judgement, rival = _judge(frames, model, rivals, findings)
        model.provenance["judgement"] = judgement.record()
    else:
        model.provenance[CUT_OFF] = True
    model, path, note = _save(config, model, old, judgement)
    if rival and rival.name == path.stem:
        rival = dataclasses.replace(rival, name=f"{rival.name}{BEFORE}")
    state, message = _ending(trainer, path, model, checkpoint, config.output.name)
    if judgement and not judgement.doubtful:
        give_up_unfinished(config.output.folder, config.output.name)
    return TrainingResult(
        *(model, path, prepared, state, message + note),
        mapping=config.data.mapping,
        judgement=judgement,
        frames=None if frames.held_out is frames.training else frames,
        rival=rival,
    )


def _rivals(
    config: TrainingConfig, layout: KeypointLayout, rival: Model | None, old: OldModel | None
) -> list[Model]:
    """Return the models that the new one must be better than to take its name.

    They are the model at hand, and a good one of that name and of the same object. Motion capture
    is compared with none.

    Args:
        config: names the data and the model at hand.
        layout: of the new model.
        rival: the model at hand.
        old: the model that has the name of the new one.
    """
    rivals = [rival] if rival else []
    if config.data.cmu or old is None or not old.is_rival(layout):
        return rivals
    return rivals if _is_file_of(old, config.rival) else [*rivals, load_once(old.path)]


def _is_file_of(old: OldModel, file: str) -> bool:
    """Return whether an old model is the one in a file; "" is no file."""
    return bool(file) and old.path.resolve() == Path(file).resolve()


def _judge(
    frames: Split, model: Model, rivals: list[Model], findings: tuple[SourceFinding, ...]
) -> tuple[Judgement, Model | None]:
    """Return a judgement that doubts the model if there is one, else the first one, and its rival.

    Args:
        frames: those of the training and those held out.
        model: the new one.
        rivals: see `_rivals`.
        findings: what looks wrong in the data.
    """
    from deep_nrsfm_ros.training.judge import judge

    judgement = judge(frames, model, rivals[0] if rivals else None, findings)
    for other in rivals[1:]:
        if judgement.doubtful:
            break
        second = judge(frames, model, other, findings)
        if second.doubtful:
            return second, other
    return judgement, rivals[0] if rivals else None


def _save(
    config: TrainingConfig, model: Model, old: OldModel | None, judgement: Judgement | None
) -> tuple[Model, Path, str]:
    """Write the model file, beside a good one if need be; return model, file and a note on it.

    Args:
        config: names the file.
        model: the new one.
        old: the model that has its name.
        judgement: of the new one; None: it was cut off.
    """
    is_at_stake = old is not None and (
        old.is_at_stake(model.layout, judgement) or _is_file_of(old, config.rival)
    )
    name = name_beside(model.name, old if is_at_stake else None, judgement)
    path, note = config.output.folder / f"{name}{MODEL_SUFFIX}", ""
    if name != model.name:
        note = f"; model {model.name!r} stays as it was"
    elif path.is_file() and not (config.resume and old and old.is_cut_off):
        # A cut-off model is of the training that goes on.
        note = f"; the model {name!r} that was there is kept as {keep_before(path)!r}"
    model = dataclasses.replace(model, name=name)
    save_model(path, model)
    return model, path, note


def _describe(
    prepared: Prepared, reporter: Reporter, start: Model | None, *, is_resumed: bool
) -> None:
    """Report the size of the dataset, what it cannot teach, and what the training starts from."""
    dataset = prepared.dataset
    random = wording("--from none, train.from none", node="train.from none", python="")
    if not is_resumed:  # the training loop says where it goes on
        reporter.say(
            f"starts from model {start.name!r} ({random}: from random weights)"
            if start
            else "starts from random weights"
        )
    # A start passes its handedness on to a layout without one.
    if dataset.layout.warning and (dataset.layout.handedness or not start):
        reporter.warn(dataset.layout.warning)
    if unseen := never_seen(dataset, start):
        reporter.warn(unseen)
    reporter.say(f"{len(dataset)} frames of {len(dataset.layout)} keypoints ({dataset.source})")


def _shared_out(total: int, frames: Split) -> str:
    """Return how many frames are trained on, held out and in neither part."""
    training, held_out = len(frames.training), len(frames.held_out)
    return (
        f"{training} of the {total} frames are trained on; {held_out} later ones are held out to "
        f"judge the model, and {total - training - held_out} between them are left out "
        f"({wording('--held-out, train.held_out', node='train.held_out', python='')})"
    )


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
    weights.check(dataset.layout, option_names())
    import torch  # takes seconds; a wrong configuration is refused without it

    from deep_nrsfm_ros.nrsfm.layout_loss import LayoutLoss
    from deep_nrsfm_ros.training.few_frames import minutes_option
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
            "the factorisations of the few frames were cut short: give "
            f"{minutes_option(trainer.minutes_needed)}, or leave it out, for a better model"
        )
    return trainer


def _ending(
    trainer: Trainer, path: Path, model: Model, checkpoint: Path, name: str
) -> tuple[str, str]:
    """Return the state and the message with which the training ends; remove a used checkpoint."""
    if not trainer.end_reason:
        message = f"{path} holds what was learned so far"
        goes_on = wording(f", --resume --name {name} goes on", node="", python="")
        return "cancelled", message + (goes_on if checkpoint.exists() else "")
    checkpoint.unlink(missing_ok=True)
    message, steps = str(path), trainer.preset.recipe.steps
    if trainer.step < steps:
        message += f"; after {trainer.step} of {steps} steps {trainer.end_reason}"
    return "finished", message

"""Train a model from recorded bags or motion capture: 2D keypoints in, one model file out."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import signal
import stat
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path

from safetensors import SafetensorError

from deep_nrsfm_ros.commands.evaluate import read_split
from deep_nrsfm_ros.commands.program import program, program_name
from deep_nrsfm_ros.configuration import add_arguments, override
from deep_nrsfm_ros.data.bags import keypoint_count, read_bags
from deep_nrsfm_ros.data.curation import Curated, Curation
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.data.sufficiency import Sufficiency
from deep_nrsfm_ros.extras import require_extra
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.messages.field_mapping import FieldMapping
from deep_nrsfm_ros.messages.mapping_file import read_mapping
from deep_nrsfm_ros.model_files.find_layout import NUMBERED, find_layout
from deep_nrsfm_ros.model_files.folders import model_folders
from deep_nrsfm_ros.model_files.model_file import (
    MODEL_SUFFIX,
    Model,
    check_name,
    find_model,
    load_model,
    save_model,
)
from deep_nrsfm_ros.nrsfm.network import Architecture
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, LayoutLossWeights, Preset, Recipe
from deep_nrsfm_ros.reporting.page import Training, write_report
from deep_nrsfm_ros.reporting.shapes import handedness_warning
from deep_nrsfm_ros.training.distributed import join, rank
from deep_nrsfm_ros.training.fine_tuning import inherit, keep_what_is_fixed, start_from
from deep_nrsfm_ros.training.limits import WHOLE, Limits
from deep_nrsfm_ros.training.preparation import chosen_curation, prepare
from deep_nrsfm_ros.training.record import check_room, checkpoint_file, keep_record, unwritable
from deep_nrsfm_ros.training.reporter import CancelledError, Reporter, SilentReporter
from deep_nrsfm_ros.training.resume import resumed_arguments

NOT_ASKED = ("name", "output", "resume", "json_progress")
"""Arguments that say which training is meant and how to show it, not what is asked of it."""


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(prog=program_name("train"), description=__doc__)
    data = parser.add_argument_group("Data (bags or motion capture)")
    data.add_argument("--bag", type=Path, action="append", default=[], help="bag; repeatable")
    data.add_argument("--topic", default="", help="keypoint topic (default: the only one)")
    data.add_argument(
        "--keypoint-layout",
        default="",
        help="order of the keypoints in the bags (default: that of the object)",
    )
    data.add_argument(
        "--min-confidence", type=float, default=0.1, help="keypoints below it count as missing"
    )
    data.add_argument(
        "--mapping", default="", help="field mapping (.yaml) for messages of a type not known here"
    )
    for side in ("width", "height"):
        text = f"{side} of the image in pixels, for normalised keypoints"
        data.add_argument(f"--image-{side}", type=int, default=0, help=text)
    data.add_argument("--cmu", type=Path, help="folder of the CMU database (NN/NN.asf, *.amc)")
    data.add_argument("--subjects", nargs="*", default=["01"], help="CMU subjects")
    data.add_argument(
        "--all-trials",
        action="store_true",
        help="every trial of a subject instead of the paper's first floor(0.8 N)",
    )
    data.add_argument("--stride", type=int, default=1, help="take every n-th CMU frame")
    data.add_argument("--camera-seed", type=int, default=0, help="seed of the CMU cameras")
    result = parser.add_argument_group("Result")
    result.add_argument(
        "--object",
        default="",
        help="the model's layout: a preset, a layout file (.yaml), a model file, or 'numbered' "
        "for points without names (default: that of --from, or human17)",
    )
    result.add_argument("--name", default="trained", help="name of the model")
    result.add_argument("--output", type=Path, default=Path("models"), help="folder of the model")
    run = parser.add_argument_group("Run")
    run.add_argument(
        "--from",
        dest="start",
        default="",
        metavar="MODEL",
        help="start from this model, a name or a file, instead of from chance",
    )
    run.add_argument("--preset", default="default", choices=list(PRESETS), help="see below")
    run.add_argument("--threads", type=int, default=0, help="threads of torch (0: all cores)")
    run.add_argument(
        "--resume",
        action="store_true",
        help="go on with a training that was cut off: name it (--name, --output); it keeps to its "
        "data and options",
    )
    run.add_argument("--json-progress", action="store_true", help="one JSON object a line")
    for config in (Recipe, LayoutLossWeights, Limits, Architecture, Normaliser, Curation):
        add_arguments(parser, config)
    return parser


def read_data(given: argparse.Namespace, report: Reporter) -> Dataset:
    """Return the dataset that the arguments name; raise ValueError if there is none."""
    if bool(given.bag) == bool(given.cmu):
        raise ValueError("name what to train on: --bag (repeatable), or --cmu with --subjects")
    source, target = read_layouts(given)
    if given.bag:
        size = (given.image_width, given.image_height)
        options = ReadOptions(
            topic=given.topic,
            min_confidence=given.min_confidence,
            mapping=_mapping(given),
            image_size=size if all(size) else None,
            max_frames=override(Limits(), given).max_frames,
        )
        reading = read_bags(given.bag, source, target, options, report.reading)
        for warning in reading.warnings:
            report.warn(warning)
        if reading.unreadable:
            count = f"{reading.unreadable} of {reading.messages}"
            report.warn(f"{count} messages could not be read: {reading.reason}")
        return reading.dataset
    return read_split(
        *(given.cmu, given.subjects, "all" if given.all_trials else "train", target),
        seed=given.camera_seed,
        stride=given.stride,
        on_progress=report.reading,
    )


def read_layouts(given: argparse.Namespace) -> tuple[KeypointLayout, KeypointLayout]:
    """Return the layouts of the data and of the new model; raise ValueError if there is none."""
    if given.object == NUMBERED:
        if not given.bag or given.keypoint_layout:
            raise ValueError(
                f"--object {NUMBERED} takes the points of bags as they come; "
                "leave out --keypoint-layout and --cmu, or name an object"
            )
        options = ReadOptions(given.topic, mapping=_mapping(given))
        points = KeypointLayout.numbered(keypoint_count(given.bag, options))
        return points, points
    target = find_layout("--object", given.object or HUMAN17.name)
    named = given.keypoint_layout
    return find_layout("--keypoint-layout", named) if named else target, target


def _mapping(given: argparse.Namespace) -> FieldMapping | None:
    """Return the field mapping that the arguments name, if they name one."""
    return read_mapping(Path(given.mapping).expanduser()) if given.mapping else None


def read_start(given: argparse.Namespace) -> Model | None:
    """Return the model that `--from` names; the new one has its layout unless another is named."""
    if not given.start:
        return None
    path = find_model(given.start, model_folders(given.output))
    given.object = given.object or str(path)
    return load_model(path)


def write_page(training: Training, report: Reporter, *, compare: bool) -> str:
    """Write the HTML report next to the model; return its path, "" if it could not be written.

    The model stands, whatever becomes of it. compare: with the other models that are there, which
    takes a second for each; who cancels a training does not wait for that.
    """
    folders = model_folders(training.path.parent) if compare else []
    try:
        return str(write_report(training, folders))
    except (ValueError, OSError) as error:
        report.say(f"no report was written: {error}")
        return ""


def stop_on_signals() -> Callable[[], bool]:
    """Return a function that tells whether SIGINT or SIGTERM has come."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop.is_set


def stop_with_parent(stopped: Callable[[], bool]) -> Callable[[], bool]:
    """Return `stopped`, or the end of a pipe on standard input: who started us is gone.

    Anything but a pipe says nothing about that: a terminal, /dev/null in a shell's background.
    """
    if not stat.S_ISFIFO(os.fstat(sys.stdin.fileno()).st_mode):
        return stopped
    orphaned = threading.Event()

    def watch() -> None:
        while os.read(sys.stdin.fileno(), 4096):
            pass
        orphaned.set()

    threading.Thread(target=watch, daemon=True).start()
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)  # its output has nobody either: see `_print`
    return lambda: stopped() or orphaned.is_set()


def run(given: argparse.Namespace, report: Reporter, should_stop: Callable[[], bool]) -> None:
    """Read, train and save as the arguments say; raise ValueError for what cannot be done."""
    preset, start = PRESETS[given.preset], read_start(given)
    if start:
        preset = Preset(start.network.architecture, start.normaliser, preset.recipe)
    preset = Preset(
        override(preset.architecture, given),
        override(preset.normaliser, given),
        override(preset.recipe, given),
    )
    if start:
        keep_what_is_fixed(start, preset)
    limits = override(WHOLE if given.cmu else Limits(), given)
    check_room(given.output, limits.free_disk)
    require_extra("train", "training")
    curated, sufficiency = prepare(given, read_data(given, report), report.say)
    asked = {name: value for name, value in vars(given).items() if name not in NOT_ASKED}
    for options in (*preset, override(LayoutLossWeights(), given), limits, chosen_curation(given)):
        asked |= dataclasses.asdict(options)
    # Of several processes the first keeps the record; the others only know where it is.
    others = nullcontext(checkpoint_file(given.output, given.name))
    first = keep_record(given.output, given.name, asked, resume=given.resume)
    with others if rank() else first as checkpoint:
        learn(given, preset, limits, start, curated, sufficiency, checkpoint, report, should_stop)


def learn(
    given: argparse.Namespace,
    preset: Preset,
    limits: Limits,
    start: Model | None,
    curated: Curated,
    sufficiency: Sufficiency,
    checkpoint: Path,
    report: Reporter,
    should_stop: Callable[[], bool],
) -> None:
    """Train on what `run` has read and save the model with its report."""
    dataset = curated.dataset
    if dataset.layout.warning and not start:
        report.warn(dataset.layout.warning)
    network = start_from(start, dataset.layout) if start else None
    weights = override(LayoutLossWeights(), given)
    weights.check(dataset.layout)
    seen = dataset.visible.sum(0)
    unseen = [name for i, name in enumerate(dataset.layout.keypoints) if not seen[i]]
    if unseen:
        report.warn(f"no frame shows {', '.join(unseen)}: the model will only guess them")
    report.say(f"{len(dataset)} frames of {len(dataset.layout)} keypoints ({dataset.source})")
    import torch  # seconds to import: bad arguments should not wait for it

    from deep_nrsfm_ros.nrsfm.layout_loss import LayoutLoss
    from deep_nrsfm_ros.training.finish import finish
    from deep_nrsfm_ros.training.loop import Callbacks, Checkpointing, Setup, train

    if given.threads:
        torch.set_num_threads(given.threads)
    team = join()
    model_path = given.output / f"{given.name}{MODEL_SUFFIX}"
    trainer = train(
        dataset.points,
        dataset.visible,
        preset,
        Setup(
            network,
            LayoutLoss(weights, dataset.layout) if weights != LayoutLossWeights() else None,
            limits,
            team,
        ),
        Callbacks(on_progress=report.training, should_stop=should_stop),
        Checkpointing(checkpoint),
    )
    team.leave()
    if team.rank:
        return
    if not trainer.step:
        checkpoint.unlink(missing_ok=True)
        raise CancelledError
    model = finish(trainer, given.name, dataset.layout, dataset.source)
    model.provenance["date"] = time.strftime("%Y-%m-%d", time.gmtime())
    if start:
        model = inherit(model, start)
    save_model(model_path, model)
    depth = handedness_warning(model, dataset)
    if depth:
        report.warn(depth)
    whole = Training(
        *(model, model_path, dataset, curated, sufficiency, report.curves, report.warnings)
    )
    html = write_page(whole, report, compare=bool(trainer.ended))
    state, message = "finished", f"{model_path} {json.dumps(model.quality)}"
    if trainer.step < preset.recipe.steps and trainer.ended:
        message += f"; after {trainer.step} of {preset.recipe.steps} steps {trainer.ended}"
    if not trainer.ended:
        state, message = "cancelled", "cancelled; the model holds what was learned so far"
        if checkpoint.exists():
            message += ", --resume goes on"
    else:
        checkpoint.unlink(missing_ok=True)
    message += f"; report {html}" if html else ""
    found = model.quality | ({"warning": depth} if depth else {})
    report.end(state, message, model=str(model_path), report=html, **found)


@program
def main(argv: Sequence[str] | None = None) -> None:
    """Run the command; exit code 2 says that the input was at fault."""
    given = arguments().parse_args(argv)
    should_stop = stop_on_signals()
    if given.json_progress:
        should_stop = stop_with_parent(should_stop)
    report = (SilentReporter if rank() else Reporter)(given.json_progress, should_stop)
    try:
        if given.resume:
            given = resumed_arguments(arguments(), argv, given, report.say)
        check_name("--name", given.name)
        run(given, report, should_stop)
    except CancelledError:
        report.end("cancelled", "cancelled before anything was learned; nothing was written")
    except SafetensorError as error:  # neither OSError nor ValueError, though the disk is full
        report.end("failed", unwritable(given.output, error))
        sys.exit(2)
    except (ValueError, OSError) as error:
        report.end("failed", str(error))
        sys.exit(2)


if __name__ == "__main__":
    main()

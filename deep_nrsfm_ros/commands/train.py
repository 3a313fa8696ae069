# SPDX-License-Identifier: Apache-2.0
"""Train a model from bags and files of 2D keypoints, or motion capture: one model file out.

Exit code 0: the training has ended; 2: the input or an option is at fault; 3: the model is written,
and is doubtful since its data looks wrong (--force: 0); 130: the training was stopped before its
end.
"""

from __future__ import annotations

import argparse
import os
import signal
import stat
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from deep_nrsfm_ros.commands.program import Parser, program, program_name
from deep_nrsfm_ros.configuration import add_arguments
from deep_nrsfm_ros.data.curation import Curation
from deep_nrsfm_ros.data.hands import SIDES
from deep_nrsfm_ros.data.keypoint_files import KINDS
from deep_nrsfm_ros.data.pose2sim import JOINTS
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.data.varied_images import ImageVariation
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN25
from deep_nrsfm_ros.lifting.sanity import EXIT_DOUBTFUL
from deep_nrsfm_ros.model_files.folders import default_models_dir, model_folders
from deep_nrsfm_ros.model_files.matching_model import knows
from deep_nrsfm_ros.nrsfm.network import Architecture
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, LayoutLossWeights, Recipe
from deep_nrsfm_ros.reporting.page import Training, write_report
from deep_nrsfm_ros.training.activation import switch_commands
from deep_nrsfm_ros.training.config import TrainingConfig
from deep_nrsfm_ros.training.distributed import own_share, rank
from deep_nrsfm_ros.training.handedness_check import handedness_warning
from deep_nrsfm_ros.training.job import FOR_NODE
from deep_nrsfm_ros.training.limits import Limits
from deep_nrsfm_ros.training.reporter import CancelledError, Reporter, SilentReporter
from deep_nrsfm_ros.training.resume import resume_arguments
from deep_nrsfm_ros.training.run import TrainingResult, run
from deep_nrsfm_ros.training.verdicts import UNKNOWN
from deep_nrsfm_ros.wording import in_node

if TYPE_CHECKING:  # it imports torch
    from deep_nrsfm_ros.training.judge import Judgement

CANCELLED = 128 + signal.SIGINT
"""Exit code of a training that was stopped, by whatever signal."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line: an option that is not given leaves no attribute."""
    parser = Parser(
        prog=program_name("train"), description=__doc__, argument_default=argparse.SUPPRESS
    )
    data = parser.add_argument_group("Data (bags and files, or motion capture)")
    data.add_argument("--bag", dest="bags", type=Path, action="append", help="bag; repeatable")
    data.add_argument(
        "--input",
        dest="inputs",
        metavar="INPUT",
        type=Path,
        action="append",
        help="keypoints beside the bags, of any kind that `lift` reads, or a folder of such "
        f"recordings; repeatable: {KINDS}",
    )
    data.add_argument(
        "--keypoint-layout",
        help="order of the keypoints in bags and files (default: the one that they name; else, for "
        "people and wherever the training starts from a model, the one that fits best; else that "
        "of the object)",
    )
    data.add_argument(
        "--min-confidence",
        type=float,
        help="keypoints of less confidence count as missing, 0 to 1 (default: 0.1)",
    )
    data.add_argument(
        "--mapping", help="field mapping (.yaml) for messages of a type that is not built in"
    )
    for side in ("width", "height"):
        text = f"{side} of the image in pixels, for keypoints given as shares of it"
        data.add_argument(f"--image-{side}", type=int, help=text)
    data.add_argument(
        "--hands",
        choices=SIDES,
        help="what the recorded hands are, for a model of right hands: right, left (mirrored "
        "before the training), or palms (each hand shows its palm: those that look like left ones "
        "are mirrored) (default: unknown; both sides mixed make a model doubtful)",
    )
    data.add_argument("--cmu", type=Path, help="folder of the CMU database (NN/NN.asf, *.amc)")
    data.add_argument("--subjects", nargs="*", help="CMU subjects (default: 01)")
    data.add_argument(
        "--all-trials",
        action="store_true",
        help="every trial of a subject instead of the paper's first floor(0.8 N)",
    )
    data.add_argument("--stride", type=int, help="take every n-th CMU frame (default: 1)")
    data.add_argument("--camera-seed", type=int, help="seed of the CMU cameras (default: 0)")
    data.add_argument(
        "--cameras",
        type=int,
        help="random cameras that project each CMU frame; 8 typical for a model of people in "
        "general, the paper has 1 (default: 1)",
    )
    data.add_argument(
        "--virtual-people",
        type=int,
        help="learn error covariance and bones from so many virtual people in CMU poses, with "
        "other bodies and with joints where detectors put them; 16384 typical, 0 = from the "
        "training frames (default: 0)",
    )
    result = parser.add_argument_group("Result")
    result.add_argument(
        "--object",
        help="the model's layout: a preset, a layout file (.yaml), a model file, or 'numbered' "
        "for points without names (default: that of --from, or human25)",
    )
    result.add_argument(
        "--name", help="name of the model, not one of the package's (default: trained)"
    )
    result.add_argument(
        "--output",
        dest="folder",
        type=Path,
        help="folder of the model; other programs know the models of the default folder by name "
        f"(default: {default_models_dir()})",
    )
    run = parser.add_argument_group("Run")
    run.add_argument(
        "--from",
        dest="start",
        metavar="MODEL",
        help="start from this model, a name or a file; none = from random weights (default: a "
        "model that comes with the package and has most keypoints of the object, if there is one; "
        "with --cmu none)",
    )
    run.add_argument(
        "--preset",
        choices=list(PRESETS),
        help="the defaults of the options below; fast = the same errors on the training "
        "frames in about half of the time, for objects that are seen from all sides; paper = the "
        "paper's (default: default)",
    )
    run.add_argument("--threads", type=int, help="threads of torch (default: 0, all cores)")
    run.add_argument(
        "--resume",
        action="store_true",
        help="continue a training that was cut off: name it (--name, --output); it keeps its data "
        "and options, unless others are given",
    )
    run.add_argument(
        "--config",
        type=Path,
        help="take all options that are not given here from this JSON file, such as the record "
        ".NAME.training.json of another training",
    )
    run.add_argument(
        "--force",
        action="store_true",
        default=False,
        help="end with exit code 0 even if the data looks wrong",
    )
    run.add_argument(
        "--json-progress", action="store_true", default=False, help="one JSON object a line"
    )
    # Time plays no role in a training, so --rate would have no effect.
    add_arguments(parser, ReadOptions, without=("rate",))
    parts = (Recipe, LayoutLossWeights, Limits, Architecture, Normaliser, Curation, ImageVariation)
    for config in parts:
        add_arguments(parser, config)
    return parser


def parse(arguments: argparse.Namespace, say: Callable[[str], None]) -> TrainingConfig:
    """Return the configuration that the command line gives; raise ValueError if there is none."""
    if "config" in arguments:
        text = arguments.config.read_text(encoding="utf-8")
        try:
            base = TrainingConfig.from_json(text)
        except ValueError as error:
            raise ValueError(f"--config {arguments.config}: {error}") from error
        return TrainingConfig.from_arguments(arguments, base)
    if "resume" in arguments:
        return resume_arguments(arguments, say)
    return TrainingConfig.from_arguments(arguments)


def stop_on_signals() -> Callable[[], bool]:
    """Return a function that returns True once SIGINT or SIGTERM has come."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop.is_set


def stop_with_parent(stopped: Callable[[], bool]) -> Callable[[], bool]:
    """Return a function that is True once `stopped` is, or once standard input has ended.

    The end of a pipe means that the parent process is gone. Other kinds of standard input mean
    nothing: a terminal, or /dev/null in a shell's background.
    """
    if not stat.S_ISFIFO(os.fstat(sys.stdin.fileno()).st_mode):
        return stopped
    orphaned = threading.Event()

    def watch() -> None:
        while os.read(sys.stdin.fileno(), 4096):
            pass
        orphaned.set()

    threading.Thread(target=watch, daemon=True).start()
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)  # nobody reads its output either: see `_print`
    return lambda: stopped() or orphaned.is_set()


def report_end(result: TrainingResult, reporter: Reporter) -> None:
    """Write the page of a training, and report how the training ended."""
    step = result.model.provenance["step"]
    values: dict[str, object] = {"step": step, "steps": step, **result.model.quality}
    from deep_nrsfm_ros.training.mirror import warning as mirror_warning  # imports torch

    share = result.model.quality.get("mirrored_share", 0.0)
    found = (mirror_warning(share), handedness_warning(result.model, result.prepared.dataset))
    if warnings := [text for text in found if text]:
        for text in warnings:
            reporter.warn(text)
        values["warning"] = "; ".join(warnings)
    lines = [result.message]
    if judgement := result.judgement:
        values["judgement"] = judgement.record()["verdict"]
        # The lifter shows the last line where warnings may be out of sight.
        said = str(judgement) if reporter.as_json else judgement.brief
        lines = [said, f"model {result.message}"]
        if judgement.doubtful:
            reporter.warnings.append(judgement.brief)  # for the page; the last line says it as well
    reporter.judging("the report, beside your other models of this object")
    page = write_page(result, reporter)
    lines += [f"report {page}"] if page else []
    if not reporter.as_json and result.state == "finished":  # else the lifter says it
        lines += _next_steps(result.model.layout, result.path, judgement)
    message = ("; " if reporter.as_json else "\n  ").join(lines)
    if not reporter.as_json:
        message = message.replace(". Judged ", "\n  judged ")
    reporter.end(result.state, message, model=str(result.path), report=page, **values)


def _next_steps(layout: KeypointLayout, path: Path, judgement: Judgement | None) -> list[str]:
    """Return how a model is put in use, and how it is measured if it lifts people."""
    known = path.parent.resolve() == default_models_dir().resolve()
    name = path.stem if known else str(path)
    use = "use it"
    if judgement and judgement.doubtful:
        use = "not in use, but you can look at what it lifts"
    elif judgement and judgement.is_first_look:
        use = "too few steps for use, but you can look at what it lifts"
    elif judgement and judgement.verdict == UNKNOWN:
        use = "whether it is better is unknown; to use it"
    elif judgement and judgement.fits_badly:
        use = "it fits badly; look at what it lifts"
    other = not knows(layout, HUMAN25)
    switch = ", and then ".join(switch_commands("/lifter", path.stem, other_object=other))
    lines = [f"{use}: lift FILE --model {name}, or in a lifter: {switch}"]
    if set(JOINTS) <= set(layout.keypoints):
        lines.append(f"see how many mm it is off on the demo's person: demo --model {name}")
    return lines


def write_page(result: TrainingResult, reporter: Reporter) -> str:
    """Write the HTML report next to the model; return its path, "" if that was not possible.

    A page that cannot be written costs no model. A finished training is shown beside the other
    models, which takes a second for each; a cancelled one does not take the time.
    """
    prepared = result.prepared
    training = Training(
        result.model,
        result.path,
        prepared.dataset,
        prepared.curated,
        prepared.sufficiency,
        progress=reporter.curves,
        warnings=reporter.warnings,
        detector_layout=result.detector_layout,
        input_type=result.mapping,
        held_out=result.frames,
        rival=result.rival,
    )
    folders = model_folders(result.path.parent) if result.state == "finished" else []
    try:
        return str(write_report(training, folders))
    except (ValueError, OSError) as error:
        reporter.say(f"no report was written: {error}")
        return ""


@program
def main(argv: Sequence[str] | None = None) -> None:
    """Run the command; the exit code says how it ended and whether to believe the model.

    2: the input was at fault; 3: a model came of data that looks wrong; 130: it was stopped before
    its end.
    """
    arguments = parser().parse_args(argv)
    should_stop = stop_on_signals()
    if arguments.json_progress:
        should_stop = stop_with_parent(should_stop)
    reporter = (SilentReporter if rank() else Reporter)(arguments.json_progress, should_stop)
    code = 0
    try:
        with in_node() if os.environ.get(FOR_NODE) else nullcontext():
            result = run(parse(arguments, reporter.say), reporter, should_stop)
            if result:
                report_end(result, reporter)
        if result:
            if result.state == "cancelled":
                code = CANCELLED
            elif result.judgement and result.judgement.faults and not arguments.force:
                code = EXIT_DOUBTFUL
    except CancelledError:
        reporter.end("cancelled", "nothing had been learned; nothing was written")
        code = CANCELLED
    except (ValueError, OSError) as error:
        reporter.end("failed", str(error))
        sys.exit(2)
    if code and own_share().size == 1:  # torchrun takes any other code than 0 for a crash
        sys.exit(code)


if __name__ == "__main__":
    main()

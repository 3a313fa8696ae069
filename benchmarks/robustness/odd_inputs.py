# SPDX-License-Identifier: Apache-2.0
"""Odd inputs after public bug reports, given to lift, train and the steps of the lifter.

Each input shows a person, or two, who walk and turn before a camera, as some program writes it. The
answer is compared with the truth: the error of the limbs, the number of objects, times, identities.
An answer that is wrong, although nothing was said, is a silent wrong value.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.data.odd_files import CASES, TRUTH, Case, Row
from benchmarks.table import Table, bars
from deep_nrsfm_ros.commands import lift
from deep_nrsfm_ros.data.bag_files import open_bag
from deep_nrsfm_ros.data.bag_topics import keypoint_topics
from deep_nrsfm_ros.data.keypoint_files import is_bag
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.lifting.smoothing import SmoothingOptions
from deep_nrsfm_ros.messages.options import InputOptions
from deep_nrsfm_ros.messages.pipeline import Pipeline
from deep_nrsfm_ros.messages.serialised import MessageReader
from deep_nrsfm_ros.messages.stamps import Moment
from deep_nrsfm_ros.messages.stream_check import StreamCheck
from deep_nrsfm_ros.model_files.model_file import Model, load_model
from deep_nrsfm_ros.training.config import COMMAND_LINE, DataConfig, TrainingConfig
from deep_nrsfm_ros.training.preparation import read_data
from deep_nrsfm_ros.training.reporter import Reporter
from deep_nrsfm_ros.training.validation import validate

Floats = NDArray[Any]

MAX_ERROR = 25.0
"""Error of the limbs in % above which an answer is wrong; it is below 20 on sound input."""
MAX_DELAY = 0.01  # seconds between the time of an object and the truth
MAX_DISTANCE = 5.0  # pixels between a keypoint of a training and the truth
LIMBS = [i for i, name in enumerate(HUMAN17.keypoints) if name.split("_")[0] in ("left", "right")][
    :12
]
LEGEND = {
    "inputs": "inputs of this kind that were made and given to the program",
    "worked": f"the answer is right: limbs within {MAX_ERROR:g} % of their size (lift, lifter) or "
    f"keypoints within {MAX_DISTANCE:g} pixels (train), objects, times and identities",
    "said": "the answer is not right, or there is none, and an error or a warning says so",
    "silent": "the answer is wrong, although nothing was said",
}


class Answer(NamedTuple):
    """What a program makes of an input.

    Attributes:
        said: its errors and warnings; "" if it said nothing.
        problem: what is wrong with its answer; "" if it is right.
    """

    said: str
    problem: str

    @property
    def outcome(self) -> str:
        """One of the figures of the table."""
        if not self.problem:
            return "worked"
        return "said" if self.said else "silent"


def by_lift(path: Path, case: Case, folder: Path) -> Answer:
    """Return the answer of `lift` on a file."""
    output, text, code = folder / "out.npz", io.StringIO(), 0
    with contextlib.redirect_stderr(text), contextlib.redirect_stdout(io.StringIO()):
        try:
            lift.main([str(path), "--output", str(output), *case.options])
        except SystemExit as end:
            code = int(end.code or 0)
    lines = text.getvalue().replace("\r", "\n").splitlines()
    said = "; ".join(line for line in lines if line.startswith(("failed", "warning")))
    if code == 2:
        return Answer(said, "no answer")
    with np.load(output) as file:
        seconds = file["stamps"][file["frame"]] / 1e9
        return Answer(said, compare(case.rows, file["shapes"], seconds, file["identities"]))


def by_train(path: Path, case: Case) -> Answer:
    """Return the dataset that `train` makes of a file, compared with the true keypoints."""
    warnings: list[str] = []

    class Recorder(Reporter):
        def warn(self, message: str) -> None:
            warnings.append(message)

        def say(self, message: str) -> None:
            """Print nothing."""

        def reading(self, done: int, total: int) -> None:
            """Show nothing."""

    options = dict(zip(case.options[::2], case.options[1::2], strict=True))
    size = int(options.get("--image-width", 0)), int(options.get("--image-height", 0))
    missing = options.get("--missing-value")
    source = case.options and options.get("--keypoint-layout") or case.layout
    data = DataConfig(
        inputs=(path,),
        keypoint_layout=source,
        image_width=size[0],
        image_height=size[1],
        category=options.get("--category", ""),
        min_score=float(options.get("--min-score", 0)),
        missing_value=float(missing) if missing else None,
    )
    config = TrainingConfig(data=data, object="human17")
    try:
        if warning := validate(config, COMMAND_LINE):
            warnings.append(warning)
        reporter = Recorder(False, lambda: False)
        dataset = read_data(config, reporter).dataset
    except ValueError as error:
        return Answer(str(error), "no answer")
    said = "; ".join(warnings)
    rows = case.trained or case.rows
    if len(dataset) != len(rows):
        return Answer(said, f"{len(dataset)} objects, not {len(rows)}")
    order = sorted(range(len(rows)), key=lambda i: (rows[i].identity or "", i))
    worst = 0.0
    for points, visible, i in zip(dataset.points, dataset.visible, order, strict=True):
        truth = TRUTH[rows[i].person].pixels[rows[i].frame]
        distance = np.linalg.norm(points - truth, axis=-1)[LIMBS][visible[LIMBS]]
        worst = max(worst, float(np.median(distance)) if len(distance) else np.inf)
    return Answer(said, f"keypoints {worst:.0f} pixels off" if worst > MAX_DISTANCE else "")


def by_lifter(path: Path, case: Case, model: Model) -> Answer:
    """Return what the node's steps make of the messages in a bag."""
    inputs, said = InputOptions(), list[str]()
    stream = StreamCheck(search=True)
    pipeline = Pipeline(model, None, inputs, LiftingOptions(), SmoothingOptions())
    shapes, seconds, identities = [], [], []
    residual = np.nan
    with contextlib.closing(open_bag(path)) as bag:
        try:
            ((topic, input_type, decode),) = keypoint_topics(bag, "", None)
        except ValueError as error:
            return Answer(str(error), "no answer")
        reader = MessageReader(input_type, decode)
        for record in bag.records(topic):
            stream.received(topic.name, reader, record.raw)
            if stream.searching and (choice := stream.search(pipeline, None)):
                own = choice.layout.keypoints == model.layout.keypoints
                detector = None if own else choice.layout
                pipeline = Pipeline(model, detector, inputs, LiftingOptions(), SmoothingOptions())
            try:
                header, observation = pipeline.read(record.raw, reader)
                stamp = header.stamp if header else record.time
                moment = Moment(stamp / 1e9, 1 / 30, False)
                n = len(observation.confidence)
                lifted, _ = pipeline.lift(observation, None, ("",) * n, topic.name, moment)
            except ValueError as error:
                said.append(str(error))
                continue
            if n:
                stream.lifted(lifted)
                residual = float(np.nanmedian(lifted.residual))
            shapes += list(lifted.shapes[:n])
            seconds += [stamp / 1e9] * n
            identities += list(observation.identities or (None,) * n)
    said += map(str, stream.look(pipeline, None, None, residual))
    names = np.array([identity or "" for identity in identities], str)
    return Answer("; ".join(said), compare(case.rows, np.array(shapes), np.array(seconds), names))


def compare(
    rows: Sequence[Row], shapes: Floats, seconds: Floats, identities: NDArray[np.str_]
) -> str:
    """Return what is wrong with lifted objects; "" if nothing is."""
    if len(shapes) != len(rows):
        return f"{len(shapes)} objects, not {len(rows)}"
    errors = []
    for row, S in zip(rows, shapes, strict=True):
        errors.append(limb_error(S, TRUTH[row.person].shapes[row.frame]))
    worst = float(np.nanmedian(errors)) if np.isfinite(errors).any() else np.inf
    if worst > MAX_ERROR:
        return f"error {worst:.0f} %"
    late = np.abs(
        (seconds - seconds[0]) - np.array([row.seconds - rows[0].seconds for row in rows])
    )
    if late.max() > MAX_DELAY:
        return f"times are {late.max():.2f} s off"
    said = [(row.identity, name) for row, name in zip(rows, identities, strict=True)]
    if any(identity is not None and identity != name for identity, name in said):
        return "other identities"
    return ""


def limb_error(S: Floats, truth: Floats) -> float:
    """Return the error in % of the limbs after a rotation and a scale; a mirror image is wrong."""
    A, B = (X[LIMBS] - X[LIMBS].mean(0) for X in (S, truth))
    if not np.isfinite(A).all():
        return np.nan
    A = A / np.linalg.norm(A) * np.linalg.norm(B)
    U, _, Vt = np.linalg.svd(A.T @ B)
    R = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return 100 * float(np.linalg.norm(A @ R - B) / np.linalg.norm(B))


def benchmark(show: bool = False) -> Table:
    """Make every input, run the programs on it and return the table."""
    figures = ("inputs", *(name for name in LEGEND if name != "inputs"))
    table = Table(
        "odd_inputs",
        "Odd inputs",
        ("kind", "program"),
        figures,
        LEGEND,
        bars("worked", "said", "silent"),
    )
    model = load_model("human")
    counts: dict[tuple[str, str], dict[str, int]] = {}
    for case in CASES:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            path = case.write(folder)
            answers = {"lift": by_lift(path, case, folder), "train": by_train(path, case)}
            if is_bag(path):
                answers["lifter"] = by_lifter(path, case, model)
        for program, answer in answers.items():
            for labels in ((case.kind, program), ("all", program)):
                count = counts.setdefault(labels, dict.fromkeys(figures, 0))
                count["inputs"] += 1
                count[answer.outcome] += 1
            if show:
                shown = answer.said[:300]
                print(f"{answer.outcome:7} {program:6} {case.name}: {answer.problem} | {shown}")
    for labels in sorted(counts, key=lambda labels: labels[0] == "all"):
        table.add(labels, {name: float(value) for name, value in counts[labels].items()})
    return table


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.robustness.odd_inputs")
    parser.description = __doc__
    parser.add_argument("--show", action="store_true", help="print the outcome of each input")
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks"))
    args = parser.parse_args(argv)
    table = benchmark(args.show)
    table.write(args.output)
    print(table.markdown())


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: Apache-2.0
"""Models trained from bags: a real video, an excavator, and CMU 01 through the lifter's service.

Each is written to a bag as a detector would publish it, trained by the program `train` or by the
lifter, and lifted from the bag. Finished trainings are kept; interrupted ones continue.
"""

from __future__ import annotations

import argparse
import gzip
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.baselines.methods import rigid
from benchmarks.data import synthetic_excavator as excavator
from benchmarks.real import plausibility
from benchmarks.speed.timing import random_domain
from benchmarks.table import Table, bars
from deep_nrsfm_ros.commands.demo.client import Client, DemoError, lifter
from deep_nrsfm_ros.commands.evaluate import CONVENTIONS, LIFTING, evaluate
from deep_nrsfm_ros.commands.evaluate import figures as error_figures
from deep_nrsfm_ros.data.bags import Frame, frames, read_bags, write_bag
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.mocap import TrialSelection, read_split
from deep_nrsfm_ros.data.openpose import read_people
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.layouts.presets import BODY25, CMU31, HUMAN25
from deep_nrsfm_ros.lifting.lifter import Lifter, lift_all
from deep_nrsfm_ros.lifting.perspective import lift_perspective
from deep_nrsfm_ros.model_files.find_layout import find_layout
from deep_nrsfm_ros.model_files.folders import model_folders
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, Model, find_model, load_model
from deep_nrsfm_ros.nrsfm.geometry import align, centre
from deep_nrsfm_ros.nrsfm.metrics import shape_errors
from deep_nrsfm_ros.training.job import ENDED
from deep_nrsfm_ros.training.record import read_record

Floats = NDArray[Any]

TOPIC = "/keypoints"
VIDEO = "detections/long_video_body25.jsonl.gz"
VIDEO_RATE, CMU_RATE = 30.0, 120.0
EXCAVATOR = Path(__file__).parents[2] / "config/layouts/excavator.yaml"
TRAINING_FRAMES, TEST_FRAMES = 6000, 1500
"""Frames of the excavator for training and for the test."""
STEPS = {"video": 30_000, "layout_loss": 6000, "tuned": 100, "machine": 8000, "mocap": 3000}
QUALITY = {
    "reprojection": "label-free, from the training's report: error of the network alone",
    "cycle": "label-free: error of reconstructing its own shapes seen from elsewhere",
}
_SHOWN = {name: CONVENTIONS[name] for name in ("shape %", "proper %", "mirrored %")}
_LAYOUT_LOSS = ("--bone-length-weight", "3", "--handedness-weight", "1", "--depth-penalty", "0.1")
_DRAWN = 8
_AT_ONCE = 256
NO_CURATION = {
    "train.min_change": "0.0",
    "train.outlier_threshold": "0.0",
    "train.min_visible": "0",
    "train.held_out": "0.0",
    "train.keep_best": "false",
}
"""Curation and the choice of the best checkpoint off, as for motion capture."""


class Session(NamedTuple):
    """The options of the benchmark."""

    data: Path
    output: Path
    steps: int | None  # instead of STEPS
    stride: int  # every n-th frame of the motion capture

    @property
    def models(self) -> Path:
        """Return the folder of the models."""
        return self.output / "models"

    def bag(self, name: str, messages: Callable[[], Iterable[Frame]]) -> Path:
        """Return the bag `name`; write the messages if it does not exist."""
        path = self.output / name
        if not (path / "metadata.yaml").exists():  # written last
            shutil.rmtree(path, ignore_errors=True)
            path.parent.mkdir(parents=True, exist_ok=True)
            print(f"{write_bag(path, TOPIC, messages())} messages in {path}", flush=True)
        return path

    def name_and_steps(self, title: str, kind: str) -> tuple[str, int]:
        """Return name and steps of a training."""
        steps = self.steps or STEPS[kind]
        suffix = f"_every_{self.stride}" if kind == "mocap" and self.stride > 1 else ""
        return f"{title}_{steps}{suffix}", steps

    def trained(self, title: str, kind: str, *arguments: str) -> Model:
        """Return the model that the program `train` makes, told by `words` what else to do."""
        name, steps = self.name_and_steps(title, kind)
        path = self.models / f"{name}{MODEL_SUFFIX}"
        record = read_record(self.models, name)
        if record or not path.exists():
            arguments = (*arguments, "--steps", str(steps), "--threads", "1", "--force")
            arguments = ("--resume",) if record else arguments
            command = [sys.executable, "-m", "deep_nrsfm_ros.commands.train", *arguments]
            subprocess.run([*command, "--name", name, "--output", str(self.models)], check=True)
        return load_model(path)


def video(session: Session) -> Table:
    """Train on the detections of a real video, with and without the shipped model's knowledge."""
    bag = session.bag("video_bag", partial(_people, session.data / VIDEO))
    arguments = ("--bag", str(bag), "--keypoint-layout", BODY25.name)
    alone = (*arguments, "--object", HUMAN25.name, "--from", "none")
    shipped = load_model(find_model("human", model_folders(session.models)))
    models = {
        "this video alone": session.trained("video", "video", *alone),
        "this video, losses of the layout": session.trained(
            "video_layout_loss", "layout_loss", *alone, *_LAYOUT_LOSS
        ),
        "the same, longer": session.trained("video_layout_loss", "video", *alone, *_LAYOUT_LOSS),
        "human, fine-tuned": session.trained("tuned", "tuned", *arguments, "--from", "human"),
        "human": shipped,
    }
    dataset = read_bags([bag], BODY25, HUMAN25, ReadOptions(TOPIC, min_confidence=0.1)).dataset
    lifted = {
        name: lift_all(Lifter(model).lift, dataset.points, dataset.visible.astype(np.float32))
        for name, model in models.items()
    }
    lifted_by_all = np.flatnonzero(
        ~np.isnan([result.residual for result in lifted.values()]).any(0)
    )
    shapes = {name: result.shapes[lifted_by_all] for name, result in lifted.items()}
    kept = dataset[lifted_by_all]
    legend = {
        "residual %": "relative reprojection error, median of the objects",
        "mirrored to human %": "objects that are more like the mirror image of what the model "
        "human returns for them, which is not the truth either",
        "human, depth set to 0": "the same without its depth, for comparison",
        "this video, losses of the layout": f"this video alone, with `{' '.join(_LAYOUT_LOSS)}`; "
        "its training optimises faces, knees, toes and bones, so their figures say little",
    }
    chosen = np.linspace(0, len(lifted_by_all) - 1, _DRAWN).astype(int).tolist()
    table = Table(
        "from_video",
        f"A real video of {len(dataset)} people in {bag.name}",
        ("lifted by", "steps"),
        (*plausibility.FIGURES, "residual %", "mirrored to human %", *QUALITY),
        plausibility.FIGURES | legend | QUALITY,
        lambda _, figure: plausibility.draw(figure, kept, shapes, chosen),
    )
    for name, model in models.items():
        alignment = align(centre(shapes["human"]), centre(shapes[name]), allow_reflection=True)
        row = {
            **plausibility.figures(shapes[name], kept.visible),
            "residual %": 100 * float(np.median(lifted[name].residual[lifted_by_all])),
            "mirrored to human %": 100 * float(alignment.mirrored.mean()),
        }
        table.add((name, str(model.provenance["step"])), row | _quality(model))
    flat = plausibility.figures(shapes["human"] * [1, 1, 0], kept.visible)
    table.add(("human, depth set to 0", ""), {name: flat[name] for name in ("bones %", "depth %")})
    return table


def machine(session: Session) -> Table:
    """Train on an excavator at work, described by its layout file; lift other work of it."""
    recordings = {
        "excavator_bag": excavator.record(TRAINING_FRAMES, 0),
        "excavator_later_bag": excavator.record(TEST_FRAMES, 1),
    }
    layout = find_layout("--object", str(EXCAVATOR))
    bags = {name: session.bag(name, partial(_work, result)) for name, result in recordings.items()}
    arguments = ("--bag", str(bags["excavator_bag"]), "--object", str(EXCAVATOR))
    model = session.trained("excavator", "machine", *arguments)
    legend = {
        "metres": "mean distance of points, aligned by a proper rotation only: the output is in "
        f"metres, as the layout file gives a length; the machine is about {_size(recordings)}",
        "with intrinsics": "lifted with the camera's intrinsics, as with camera_info; the "
        "model was trained without them",
        "rigid": "factorisation (Tomasi-Kanade) of the same frames",
        "proper %, mirrored %": "forgive a mirrored depth of all frames alike; metres do not",
    }
    table = Table(
        "from_excavator",
        "A synthetic excavator",
        ("bag", "frames", "lifted by", "steps"),
        (*_SHOWN, "metres", *QUALITY),
        _SHOWN | legend | QUALITY,
        bars("shape %", "proper %"),
    )
    for name, recording in recordings.items():
        dataset = read_bags([bags[name]], layout, layout, ReadOptions(TOPIC)).dataset
        confidence = dataset.visible.astype(np.float32)
        truth = centre(recording.truth)
        shapes = {
            "trained model": lift_all(Lifter(model).lift, dataset.points, confidence).shapes,
            "trained model, with intrinsics": _at_place(model, dataset.points, confidence),
        }
        labels = (name, str(len(dataset)))
        for method, S in shapes.items():
            distances = np.linalg.norm(align(S, truth).aligned - truth, axis=2)
            row = _errors(S, truth) | {"metres": float(distances.mean())}
            table.add((*labels, method, str(model.provenance["step"])), row | _quality(model))
        table.add((*labels, "rigid", ""), _errors(rigid(dataset.points), truth))
    return table


def mocap(session: Session) -> Table:
    """Train on CMU 01 from a bag through ~/train, and from the motion capture directly."""
    folder = session.data / "cmu"
    truth = read_split(TrialSelection(folder, ["01"], stride=session.stride), CMU31)
    bag = session.bag(f"cmu01_{session.stride}_bag", lambda: _frames(truth, CMU_RATE))
    suffix = ("--stride", str(session.stride))
    arguments = ("--cmu", str(folder), "--subjects", "01", "--object", CMU31.name, *suffix)
    models = {
        "train --cmu": session.trained("direct", "mocap", *arguments),
        "~/train, without curation": _trained_by_service(session, "served", bag, NO_CURATION),
        "~/train, with curation": _trained_by_service(session, "curated", bag, {}),
    }
    table = Table(
        "from_mocap",
        f"CMU 01, {len(truth)} frames of the paper's trials",
        ("trained by", "frames", "steps", "lifted"),
        (*_SHOWN, *QUALITY),
        _SHOWN | QUALITY,
        bars("shape %", "proper %"),
    )
    for name, model in models.items():
        for method in ("network alone", "as shipped"):
            results = error_figures(evaluate(model, truth, LIFTING[method]))
            trained = (str(model.provenance[key]) for key in ("frames", "step"))
            table.add(
                (name, *trained, method), {key: results[key] for key in _SHOWN} | _quality(model)
            )
    return table


def _trained_by_service(
    session: Session, title: str, bag: Path, options: Mapping[str, str]
) -> Model:
    """Return the model that a lifter trains in a process of its own when it is asked to."""
    name, steps = session.name_and_steps(title, "mocap")
    path = session.models / f"{name}{MODEL_SUFFIX}"
    record = read_record(session.models, name)
    if path.exists() and not record:
        return load_model(path)
    parameters = {
        "model": "cmu31",
        "models_dir": session.models.absolute(),
        "train.bags": f"[{bag.absolute()}]",
        "train.topic": TOPIC,
        "train.object": CMU31.name,
        "train.name": name,
        "train.from": "none",
        "train.steps": steps,
        "train.resume": str(record is not None).lower(),
        **options,
    }
    answers = session.output / f"{name}_answers"
    shutil.rmtree(answers, ignore_errors=True)
    with (
        lifter(parameters, session.output / f"{name}.log") as process,
        Client(process, bag, answers) as client,
    ):
        client.meet()
        print(client.train(), flush=True)
        with tqdm(total=steps, desc=name) as bar:
            while client.training["state"] not in ENDED:
                client.wait_a_second()
                if client.training["state"] == "training":
                    bar.update(int(client.training.get("step", bar.n)) - bar.n)
        if client.training["state"] != "finished":
            raise DemoError(client.training["message"])
    return load_model(path)


def _people(path: Path) -> Iterator[Frame]:
    """Yield all people of each frame of the video."""
    with gzip.open(path) as lines:
        for i, line in enumerate(lines):
            people = read_people(line, len(BODY25))
            yield Frame(round(i * 1e9 / VIDEO_RATE), people.points, people.confidence, "camera")


def _work(recording: excavator.Recording) -> Iterator[Frame]:
    return frames(recording.points, np.ones(recording.points.shape[:2]), excavator.RATE)


def _frames(dataset: Dataset, rate: float) -> Iterator[Frame]:
    return frames(dataset.points, dataset.visible.astype(np.float32), rate)


def _at_place(model: Model, points: Floats, confidence: Floats) -> Floats:
    """Return the shapes (f, p, 3), centred, that a lifter with camera_info makes of points."""
    lifter = Lifter(model)
    parts = np.array_split(np.arange(len(points)), max(1, len(points) // _AT_ONCE))
    results = [lift_perspective(lifter, excavator.CAMERA, points[i], confidence[i]) for i in parts]
    return centre(np.concatenate([result.shapes for result in results]))


def _size(recordings: dict[str, excavator.Recording]) -> str:
    spans = np.concatenate([np.ptp(result.truth, axis=1).max(1) for result in recordings.values()])
    return f"{spans.mean():.0f} m across"


def _errors(S: Floats, truth: Floats) -> dict[str, float]:
    results = error_figures(shape_errors(S, truth))
    return {name: results[name] for name in _SHOWN}


def _quality(model: Model) -> dict[str, float]:
    values = (model.quality["reprojection_error"], model.quality["cycle_error"])
    return dict(zip(QUALITY, values, strict=True))


PARTS = {"video": video, "machine": machine, "mocap": mocap}


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command; exit code 2 for bad input, 1 if a training failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; default: all")
    parser.add_argument("--data", type=Path, required=True, help="folder of detections/ and cmu/")
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks/from_bags"))
    parser.add_argument("--steps", type=int, help="for all trainings: a quick look")
    parser.add_argument("--stride", type=int, default=1, help="take every n-th CMU frame only")
    args = parser.parse_args(argv)
    session = Session(args.data, args.output, args.steps, args.stride)
    os.environ["ROS_DOMAIN_ID"] = str(random_domain())
    try:
        if unknown := set(args.parts) - set(PARTS):
            raise ValueError(f"no part {', '.join(unknown)}; there are {', '.join(PARTS)}")
        for name in args.parts or PARTS:
            table = PARTS[name](session)
            print(table.markdown(), flush=True)
            table.write(session.output)
    except (ValueError, OSError) as error:
        print(f"failed: {error}", file=sys.stderr)
        sys.exit(2)
    except (DemoError, subprocess.CalledProcessError) as error:
        sys.exit(f"failed: {error}")


if __name__ == "__main__":
    main()

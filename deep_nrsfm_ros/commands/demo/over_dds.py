# SPDX-License-Identifier: Apache-2.0
"""The demo as on a robot: keypoints over DDS to the lifter, and a training on the recording.

Detections in a bag are played to the lifter, a process of its own, and what it publishes is
recorded in another bag.
"""

from __future__ import annotations

import argparse
import itertools
import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.commands.demo.client import NO_LATENCY, Client, DemoError, Played, lifter
from deep_nrsfm_ros.commands.demo.domain import take_domain
from deep_nrsfm_ros.commands.demo.evaluation import read_points, table
from deep_nrsfm_ros.commands.demo.first_look import (
    TORSO,
    model_file,
    read_model,
    say,
    show,
    stage_of,
    write_standing,
)
from deep_nrsfm_ros.data.bags import Frame, frames, write_bag
from deep_nrsfm_ros.data.clip import read_clip
from deep_nrsfm_ros.data.pose2sim import JOINTS, RATE, Session
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import BODY25B
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.model_files.folders import model_folders
from deep_nrsfm_ros.model_files.model_file import load_model
from deep_nrsfm_ros.nrsfm.metrics import camera_errors
from deep_nrsfm_ros.nrsfm.recipe import AUTOMATIC
from deep_nrsfm_ros.training.job import ENDED
from deep_nrsfm_ros.training.verdicts import DOUBTFUL

TOPIC = "/keypoints"
CAMERA_INFO = "/camera_info"
TRAINED = "demo"
LOG = "lifter.log"

_SECOND = 1_000_000_000
_MOST_MINUTES = 1.0  # of the training: a demo, not a model to keep


def detections(session: Session) -> Iterator[Frame]:
    """Yield the detections of each camera in turn; their stamps begin 10 s apart."""
    for i, view in enumerate(session.views):
        start = (1 + 10 * i) * _SECOND
        yield from frames(view.points, view.confidence, RATE, view.camera.name, start)


def run(given: argparse.Namespace) -> None:
    """Run the demo.

    Raises:
        DemoError: the lifter does not respond as expected.
        ValueError: the model is not usable.
        OSError: a file cannot be read or written.
    """
    models = given.output / "models"
    present = model_file(given.model, given.output)
    model, clip = read_model(given.model, given.output), read_clip()
    session = clip.session
    bags = {name: given.output / name for name in ("keypoints", "lifted", "trained")}
    for bag in bags.values():
        shutil.rmtree(bag, ignore_errors=True)
    count = write_bag(bags["keypoints"], TOPIC, detections(session))
    say(f"{count} messages of four cameras in {bags['keypoints']}, topic {TOPIC}")
    parameters = {
        # The lifter finds models of its folder and of the package by name, others by file.
        "model": given.model if present.parent in model_folders(models) else present,
        "models_dir": models,
        "keypoint_layout": BODY25B.name,
        "camera_info": CAMERA_INFO,
        "reference_length": TORSO,
        "train.bags": f"[{bags['keypoints'].absolute()}]",
        "train.topic": TOPIC,
        "train.name": TRAINED,
        "train.steps": given.train_steps or AUTOMATIC,
        "train.minutes": _MOST_MINUTES,
    }
    with lifter(parameters, given.output / LOG) as process:
        say(f"playing the messages to the lifter at {RATE:.0f} Hz")
        with Client(process, bags["keypoints"], bags["lifted"], CAMERA_INFO) as client:
            client.meet()
            played = []
            for view in session.views:
                client.announce(view.camera)
                played.append(client.play(view.camera.name))
        lifted = evaluate(session, played, model.layout, bags["lifted"])
        write_standing(model, given.output)
        page = show(stage_of(clip, model, lifted), given.output)
        if given.train_steps:
            with Client(process, bags["keypoints"], bags["trained"]) as client:
                client.meet()
                train(client, session, present)
    say(page)


def evaluate(
    session: Session, played: list[Played], layout: KeypointLayout, bag: Path
) -> list[NDArray[np.floating]]:
    """Print a table of the points in a recorded bag, and return them for each camera.

    Args:
        session: detections and ground truth of each camera.
        played: how the lifter responded to each camera.
        layout: of the lifted points.
        bag: recorded messages of the lifter.

    Returns:
        For each camera (f, p, 3) points in metres; NaN where none were lifted.
    """
    points = read_points(bag)
    limbs = [layout.index(joint) for joint in JOINTS]
    print(table(session, played, points, limbs), flush=True)
    say(f"the lifter's answers are in {bag}")
    nothing = np.full((len(layout), 3), np.nan)
    return [np.stack([points.get(stamp, nothing) for stamp in run.stamps]) for run in played]


def train(client: Client, session: Session, present: Path) -> None:
    """Train on the recording by the lifter's service, while it continues to lift with `present`."""
    cameras = [view.camera.name for view in session.views]
    before = client.health["model"]
    say(client.train())
    sent = 0
    latencies: list[float] = []
    shown = ""
    for camera in itertools.cycle(cameras):
        if client.training["state"] in ENDED:
            break
        played = client.play(camera)
        sent, latencies = sent + len(played.stamps), latencies + played.latencies
        done, steps = (client.training.get(key) for key in ("step", "steps"))
        progress = f": {done} of {steps} steps" if done and steps else ""
        if (text := f"  {client.training['state']}{progress}") != shown:
            shown = text
            print(text, flush=True)
    if client.training["state"] != "finished":
        raise DemoError(f"training {client.training['state']}: {client.training['message']}")
    p50, p99 = (Played([], latencies, 0.0, 0.0).latency(percent) for percent in (50, 99))
    text = NO_LATENCY if np.isnan(p50) else f"p50 {p50:.2f} ms, p99 {p99:.2f} ms"
    print(f"  lifted during training: {len(latencies)} of {sent} messages, {text}")
    say(client.training["message"])
    models = {before: present, TRAINED: Path(client.training["model"])}
    print(comparison(session, models), flush=True)
    if client.training["judgement"] == DOUBTFUL:
        say(f"the lifter goes on with model {before!r}")
        return
    client.wait(lambda: client.health["model"] == TRAINED, "the change of models")
    played = client.play(cameras[0])
    say(
        f"the lifter changed from model {before!r} to {client.health['model']!r} and lifted "
        f"{len(played.latencies)} of {len(played.stamps)} messages with it"
    )


def comparison(session: Session, models: Mapping[str, Path]) -> str:
    """Return the errors of models on the detections of all cameras, against the ground truth."""
    points = np.concatenate([view.points for view in session.views])
    confidence = np.concatenate([view.confidence for view in session.views])
    truth = np.concatenate([view.truth for view in session.views])
    lines = []
    for name, path in models.items():
        model = load_model(path)
        limbs = [model.layout.index(joint) for joint in JOINTS]
        shapes = Lifter(model, layout=BODY25B)(points, confidence).shapes[:, limbs]
        lifted = np.isfinite(shapes).all((1, 2))
        errors = camera_errors(shapes[lifted], truth[lifted])
        lines.append(
            f"  model {name!r}: {errors.aligned:.1f} mm aligned, {errors.rotation:.1f} degrees, "
            f"{errors.mirrored:.1%} of the frames mirrored"
        )
    return "\n".join(lines)


def launch(run: Callable[[argparse.Namespace], None], given: argparse.Namespace) -> None:
    """Run a demo on a DDS domain of its own on this machine, with the exit codes of `main`."""
    # A shell starts background jobs with SIGINT ignored.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    try:
        os.environ["ROS_DOMAIN_ID"] = str(take_domain())
        run(given)
    except KeyboardInterrupt:
        sys.exit(130)
    except DemoError as error:
        sys.exit(f"demo: {error}; the logs are in {given.output}")
    except (OSError, ValueError) as error:
        sys.exit(f"demo: {error}")

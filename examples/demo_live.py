# SPDX-License-Identifier: Apache-2.0
"""From video to 3D over DDS with nothing computed before: MediaPipe Pose and the lifter.

Four cameras' videos of one person, one after the other. The detector, the lifter and this program,
which records what they say, are processes of their own. The truth that the table compares with is
triangulated from the detections that come with the videos, by another detector.
"""

from __future__ import annotations

import argparse
import dataclasses
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from sensor_msgs.msg import PointCloud2

from deep_nrsfm_ros.commands.demo.client import Client, DemoError, Info, Played, lifter, node
from deep_nrsfm_ros.commands.demo.first_look import TORSO, read_model, say, show
from deep_nrsfm_ros.commands.demo.over_dds import CAMERA_INFO, LOG, evaluate, launch
from deep_nrsfm_ros.data.clip import read_clip
from deep_nrsfm_ros.data.pose2sim import View, extract_videos, fetch_wheel, read_session
from deep_nrsfm_ros.layouts.presets import MEDIAPIPE33
from deep_nrsfm_ros.lifting.observation import Observation
from deep_nrsfm_ros.messages.decoding import POINT_CLOUD, read_observation
from deep_nrsfm_ros.reporting.stage import make_stage

DETECTOR = "deep_nrsfm_ros.node.mediapipe_detector"
TOPIC = "/keypoints"


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(prog="demo_live", description=__doc__, allow_abbrev=False)
    parser.add_argument("--cache", type=Path, default=Path(".cache"), help="folder of downloads")
    parser.add_argument("--output", type=Path, default=Path("demo_output/live"), help="results")
    parser.add_argument("--model", default="human", help="name or path of the model")
    return parser


class Listener(Client):
    """Records what a detector and the lifter say."""

    def __init__(self, process: subprocess.Popen[bytes], bag: Path) -> None:
        """Connect to the lifter that runs as `process`; `bag` must not exist yet."""
        super().__init__(process, None, bag, CAMERA_INFO)
        self._heard: dict[int, float] = {}
        self._seen: list[Observation] = []
        self._record(PointCloud2, TOPIC, self._take_keypoints)

    def hear(self, detector: subprocess.Popen[bytes]) -> tuple[Played, Observation]:
        """Return how the lifter answered a detector that runs to its end, and what that saw.

        Latencies are those between the detector's publishing the keypoints and hearing the lifted
        points. Raises DemoError if either of the two fails.
        """
        self._forget()
        self._heard.clear()
        self._seen.clear()
        while detector.poll() is None:
            self._wait_for_keypoints(detector)
        if detector.returncode:
            raise DemoError("the detector has failed")
        played = self._played(self._heard)
        points, confidence, *_ = zip(*self._seen, strict=True)
        return played, Observation(np.concatenate(points), np.concatenate(confidence))

    def _wait_for_keypoints(self, detector: subprocess.Popen[bytes]) -> None:
        """Wait for the next message of the detector, or for its end."""
        count = len(self._heard)
        self.wait(
            lambda: len(self._heard) > count or detector.poll() is not None, "the next keypoints"
        )

    def _take_keypoints(self, message: PointCloud2, info: Info) -> None:
        """Note when a detection was published, and its points, all missing where nobody is."""
        stamp = message.header.stamp
        self._heard[stamp.sec * 1_000_000_000 + stamp.nanosec] = 1e-9 * info["source_timestamp"]
        seen = read_observation(message, POINT_CLOUD, len(MEDIAPIPE33))
        q = len(MEDIAPIPE33)
        nobody = Observation(np.zeros((1, q, 2), np.float32), np.zeros((1, q), np.float32))
        self._seen.append(seen if len(seen.points) else nobody)


def run(given: argparse.Namespace) -> None:
    """Run the demo; raise DemoError, ValueError or OSError for what goes wrong."""
    models = given.output / "models"
    layout = read_model(given.model, given.output).layout
    wheel = fetch_wheel(given.cache)
    videos = extract_videos(wheel, "Balancing", given.output / "videos")
    say("triangulating the ground truth from the detections that come with the videos")
    session = read_session(wheel)
    bag = given.output / "recorded"
    shutil.rmtree(bag, ignore_errors=True)
    parameters = {
        "model": given.model,
        "models_dir": models,
        "keypoint_layout": MEDIAPIPE33.name,
        "camera_info": CAMERA_INFO,
        "reference_length": TORSO,
    }
    answers: list[Played] = []
    views: list[View] = []
    with lifter(parameters, given.output / LOG) as process:
        listener = Listener(process, bag)
        with listener:
            listener.meet()
            for view in session.views:
                listener.announce(view.camera)
                played, seen = look(listener, videos[view.camera.name], view, given.output)
                answers.append(played)
                views.append(dataclasses.replace(view, points=seen[0], confidence=seen[1]))
    live = dataclasses.replace(session, views=tuple(views))
    lifted = evaluate(live, answers, layout, bag)
    show(make_stage(live, read_clip().images, MEDIAPIPE33, layout, lifted), given.output)


def look(listener: Listener, video: Path, view: View, output: Path) -> tuple[Played, Observation]:
    """Let the detector look at a video to its end; return what `Listener.hear` heard."""
    say(f"MediaPipe Pose looks at {video}")
    log = output / f"detector_{view.camera.name}.log"
    # Two listeners: the lifter and this program.
    options = {"source": video, "frame_id": view.camera.name, "listeners": 2}
    with node(DETECTOR, options, log) as detector:
        played, seen = listener.hear(detector)
    if len(played.stamps) != len(view.points):
        raise DemoError(f"{len(played.stamps)} of {len(view.points)} images were heard of")
    print(f"  {log.read_text().rsplit('[detector]: ')[-1].strip()}", flush=True)
    return played, seen


def main(argv: Sequence[str] | None = None) -> None:
    """Run the demo; exit code 1 says that something went wrong, 130 that it was stopped."""
    launch(run, arguments().parse_args(argv))


if __name__ == "__main__":
    main()

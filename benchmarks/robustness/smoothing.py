# SPDX-License-Identifier: Apache-2.0
"""Jitter, error and lag of lifted shapes with the temporal filter off and on."""

from __future__ import annotations

import gzip
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import Session, run_program
from benchmarks.table import Table, bars
from deep_nrsfm_ros.data.mocap import human25, read_amc, read_asf, trials
from deep_nrsfm_ros.data.openpose import largest, read_people
from deep_nrsfm_ros.data.pose2sim import JOINTS, RATE, WHEEL, read_session
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.presets import BODY25, BODY25B, HUMAN25
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter, lift_all
from deep_nrsfm_ros.lifting.smoothing import Smoother, SmoothingOptions
from deep_nrsfm_ros.model_files.folders import default_models_dir, model_folders
from deep_nrsfm_ros.model_files.model_file import find_model, load_model
from deep_nrsfm_ros.nrsfm.geometry import centre
from deep_nrsfm_ros.nrsfm.metrics import procrustes_distances, rotation_angles

Floats = NDArray[Any]

SUBJECTS = ("03",)
"""CMU subjects that walk on uneven ground and were not used in training."""
VIDEO = "detections/long_video_body25.jsonl.gz"
VIDEO_RATE = 30.0
MIN_CONFIDENCE = 0.1
CMU_RATE = 120.0
NOISE = 0.02  # of the RMS radius, as the lifter takes it to be
STILL_FRAMES = 300  # frames of one pose
LENGTH = 1200  # frames of motion capture
STRIDES = (1, 2, 4)  # every so many of them
FIGURES = {
    "rotation deg": "rotation of the object from one frame to the next, median",
    "points %": "movement of its points, in the camera's axes, in RMS radii, median over frames",
    "acceleration %": "the same of the second difference: x(t+1) - 2 x(t) + x(t-1)",
    "error mm": "mean distance from the truth after the best similarity, 12 limb joints",
    "camera mm": "the same after the best scale and translation: the rotation must fit too",
    "lag ms": "delay at which the filtered shapes fit the unfiltered ones best; without noise only",
}
FILTERS = {"off": SmoothingOptions(), "on": SmoothingOptions(enabled=True)}
CACHE = Path(".cache")
_LAGS = np.arange(0, 0.3, 0.001)


class Clip(NamedTuple):
    """Keypoints of one object over time, in the model's layout, with the truth if known."""

    points: Floats  # (f, p, 2)
    confidence: Floats  # (f, p)
    rate: float
    truth: Floats | None = None  # (f, 12, 3) mm, `JOINTS` in the camera's axes
    noisy: bool = True


def benchmark(session: Session) -> Table:
    """Lift each clip; return the table with the filter off and on."""
    lifter = Lifter(load_model(find_model("human", model_folders(default_models_dir()))))
    table = Table(
        "smoothing",
        "Temporal smoothing",
        ("clip", "filter"),
        tuple(FIGURES),
        FIGURES,
        bars("rotation deg", "points %", "acceleration %"),
    )
    for name, clip in clips(session).items():
        lifted = lift_all(lifter.lift, clip.points, clip.confidence)
        for state, options in FILTERS.items():
            smoothed_frames = smoothed(lifted, clip.rate, options)
            table.add((name, state), figures(lifted, smoothed_frames, clip))
    return table


def clips(session: Session) -> dict[str, Clip]:
    """Return title -> clip: a held-out subject at several rates, and available real detections."""
    result = {}
    for subject in session.subjects:
        motion = walking_motion(session, subject)
        for step in STRIDES:
            rate = CMU_RATE / step
            result[f"CMU {subject}, {rate:.0f} Hz"] = simulate_clip(motion[::step], rate)
            clean = simulate_clip(motion[::step], rate, noise=0.0)
            result[f"CMU {subject} without noise, {rate:.0f} Hz"] = clean
        result[f"CMU {subject} held still, {rate:.0f} Hz"] = simulate_clip(
            motion[[0] * STILL_FRAMES], rate
        )
    wheel, video = CACHE / WHEEL, session.data / VIDEO
    if wheel.exists():
        to_model = KeypointMap(BODY25B, HUMAN25)
        for view in read_session(wheel).views:
            clip = Clip(*to_model(view.points, view.confidence), RATE, view.truth)
            result[f"pose2sim {view.camera.name}, {RATE:.0f} Hz"] = clip
    else:
        print(f"no {wheel}, no rows of pose2sim; `make demo` downloads it")
    if video.exists():
        result[f"{VIDEO}, {VIDEO_RATE:.0f} Hz"] = video_clip(video)
    return result


def walking_motion(session: Session, subject: str) -> Floats:
    """Return the first trial of a subject (f, 25, 3) in mm, seen from 20 degrees above."""
    folder = session.data / "cmu"
    skeleton = read_asf(folder / subject / f"{subject}.asf")
    S = 1000 * human25(read_amc(trials(folder, subject)[0], skeleton))[:LENGTH]
    S = centre(S.astype(float)) * [1, -1, -1]  # y down, z away
    c, s = np.cos(np.radians(20)), np.sin(np.radians(20))
    return np.asarray(S @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]]))


def simulate_clip(S: Floats, rate: float, noise: float = NOISE) -> Clip:
    """Return the simulated detections of a motion S (f, 25, 3)."""
    rng = np.random.default_rng(0)
    size = np.sqrt((S * S).sum(2).mean())
    W = S[..., :2] + noise * size * rng.standard_normal((*S.shape[:2], 2)) / np.sqrt(2)
    limbs = [HUMAN25.index(joint) for joint in JOINTS]
    return Clip(
        W.astype(np.float32), np.ones(S.shape[:2], np.float32), rate, S[:, limbs], noise > 0
    )


def video_clip(video: Path) -> Clip:
    """Return the largest person in each frame of a video's detections."""
    points, confidence = [], []
    with gzip.open(video, "rt") as lines:
        for line in lines:
            people = read_people(line, len(BODY25), MIN_CONFIDENCE)
            i = largest(people)
            if i is not None:
                points.append(people.points[i])
                confidence.append(people.confidence[i])
    to_model = KeypointMap(BODY25, HUMAN25)
    return Clip(*to_model(np.array(points), np.array(confidence)), VIDEO_RATE)


def smoothed(lifted: Lifted, rate: float, options: SmoothingOptions) -> Lifted:
    """Return the frames (n = f) of one object, filtered one by one."""
    smoothed_frames = Smoother(options)
    outputs = [
        smoothed_frames(lifted.at([i]), ("0",), i / rate)[0] for i in range(len(lifted.residual))
    ]
    return Lifted._make(np.concatenate(parts) for parts in zip(*outputs, strict=True))


def figures(lifted: Lifted, smoothed_frames: Lifted, clip: Clip) -> dict[str, float]:
    """Return the `FIGURES` of the filtered frames of a clip."""
    S, R = smoothed_frames.shapes.astype(float), smoothed_frames.rotations
    S = S / np.sqrt((S * S).sum(2).mean(1))[:, None, None]
    angles = rotation_angles(R[1:] @ R[:-1].swapaxes(1, 2))
    shown: dict[str, float] = {
        "rotation deg": float(np.nanmedian(angles)),
        "points %": 100 * _median_length(np.diff(S, axis=0)),
        "acceleration %": 100 * _median_length(np.diff(S, 2, axis=0)),
    }
    if not clip.noisy:
        shown["lag ms"] = 1000 * lag(lifted.shapes, smoothed_frames.shapes, clip.rate)
    if clip.truth is not None:
        shown |= errors(smoothed_frames.shapes, clip.truth)
    return {name: float(value) for name, value in shown.items()}


def errors(shapes: Floats, truth: Floats) -> Mapping[str, float]:
    """Return the errors of shapes (f, 25, 3) against the truth (f, 12, 3) in mm."""
    limbs = [HUMAN25.index(joint) for joint in JOINTS]
    valid = np.isfinite(truth).all((1, 2)) & np.isfinite(shapes).all((1, 2))
    S, T = centre(shapes[valid][:, limbs].astype(float)), centre(truth[valid])
    scale = (S * T).sum((1, 2)) / (S * S).sum((1, 2))
    distances = np.linalg.norm(scale[:, None, None] * S - T, axis=2)
    return {"error mm": procrustes_distances(S, T).mean(), "camera mm": distances.mean()}


def lag(before: Floats, after: Floats, rate: float) -> float:
    """Return the delay in seconds of `after` (f, p, 3) relative to `before` (f, p, 3)."""
    valid = np.isfinite(before).all((1, 2)) & np.isfinite(after).all((1, 2))
    times = np.arange(len(before))[valid] / rate
    a, b = (X[valid].reshape(valid.sum(), -1) for X in (before, after))
    interior = times >= times[0] + _LAGS[-1]
    residuals = []
    for delay in _LAGS:
        places = (times[interior] - delay) * rate
        low = np.clip(np.searchsorted(times, times[interior] - delay, "right") - 1, 0, len(a) - 2)
        share = np.clip(places - times[low] * rate, 0, 1)[:, None]
        residuals.append(np.square((1 - share) * a[low] + share * a[low + 1] - b[interior]).mean())
    return float(_LAGS[int(np.argmin(residuals))])


def _median_length(steps: Floats) -> float:
    """Return the median over frames of the mean length of steps (f, p, 3)."""
    return float(np.nanmedian(np.linalg.norm(steps, axis=2).mean(1)))


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    run_program(benchmark, __doc__, SUBJECTS, argv)


if __name__ == "__main__":
    main()

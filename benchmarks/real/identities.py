# SPDX-License-Identifier: Apache-2.0
"""Identity switches of people who cross: assignment by keypoint similarity against the nearest.

Real detections of several people by five cameras (Shelf), and two dancers of CMU before a simulated
camera, who hide one another. The detector gives no identities here.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.table import Table, bars
from deep_nrsfm_ros.data.mocap import human17, read_amc, read_asf, trials
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import BODY25, HUMAN17
from deep_nrsfm_ros.lifting.observation import Observation
from deep_nrsfm_ros.lifting.track_matching import keypoint_tolerances
from deep_nrsfm_ros.lifting.tracking import MAX_TRACK_AGE, Tracker

Floats = NDArray[Any]
Identify = Callable[[Observation, float], tuple[str, ...]]

SHELF_RATE, DANCE_RATE = 25.0, 60.0  # Hz
SHELF_PARTS = tuple((stride, offset) for stride in (1, 2, 3, 5) for offset in range(stride))
DANCE_PARTS = ((2, 0), (4, 0), (8, 0))
DANCES = (1, 5, 10, 15)
AZIMUTHS = (0, 60, 120)  # degrees, of the camera around the dancers
LOST = (0.0, 0.2)  # shares of the detections that are left out, at random
LEGEND = {
    "detections": "people in frames, at several rates: Shelf 25, 12.5, 8.3 and 5 Hz, dancers 30, "
    "15 and 7.5 Hz",
    "lost": "share of the detections that are left out, at random",
    "nearest": "identity switches with the nearest pair first, by mean motion: a person seen "
    f"within the last {MAX_TRACK_AGE:g} s has another identity",
    "similarity": "the same with the package's tracker",
    "nearest swaps, similarity swaps": "those in which the new identity was another's",
}
_FIGURES = ("detections", "nearest", "similarity", "nearest swaps", "similarity swaps")
_OBJECTS = (1, 5, 20)  # of the timing


class Clip(NamedTuple):
    """Detections of k people in f frames of one camera."""

    points: Floats  # (f, k, q, 2) pixels
    confidence: Floats  # (f, k, q), 0 = missing
    rate: float  # Hz
    parts: tuple[tuple[int, int], ...]  # every n-th frame, and the first one
    layout: KeypointLayout


class Nearest:
    """The peer: the nearest pair first, by mean motion in object sizes, without a prediction."""

    def __init__(self) -> None:
        """Start without tracks."""
        self._tracks: dict[str, tuple[Floats, Floats, float, float]] = {}
        self._count = 0

    def __call__(self, observation: Observation, now: float) -> tuple[str, ...]:
        """Return the identities of the objects."""
        self._tracks = {k: t for k, t in self._tracks.items() if now - t[3] <= MAX_TRACK_AGE}
        new = []
        for points, confidence in zip(observation.points, observation.confidence, strict=True):
            visible = confidence > 0
            offset = points[visible] - points[visible].mean(0)
            new.append((points, visible, float(np.sqrt((offset**2).sum(1).mean())), now))
        distances = []
        for i, (points, visible, size, _) in enumerate(new):
            for identity, (old, seen, old_size, _) in self._tracks.items():
                both = visible & seen
                if both.any():
                    motion = np.linalg.norm((points - old)[both].mean(0)) / max(size, old_size)
                    distances.append((float(motion), i, identity))
        identities = [""] * len(new)
        for distance, i, identity in sorted(distances):
            if distance < 1.5 and not identities[i] and identity not in identities:
                identities[i] = identity
        for i, track in enumerate(new):
            if not identities[i]:
                self._count += 1
                identities[i] = f"object{self._count}"
            self._tracks[identities[i]] = track
        return tuple(identities)


def shelf_clips(file: Path) -> Iterator[tuple[str, Clip]]:
    """Yield the name and the clip of each camera of a file of Shelf."""
    with np.load(file) as arrays:
        points, confidence = arrays["points"], arrays["confidence"]
    visible = np.isfinite(points).all(-1)
    confidence = np.where(visible, np.clip(np.nan_to_num(confidence), 1e-3, 1), 0)
    points = np.where(visible[..., None], points, 0)
    for view in range(points.shape[1]):
        clip = Clip(points[:, view], confidence[:, view], SHELF_RATE, SHELF_PARTS, BODY25)
        yield f"{file.stem}, camera {view}", clip


def dancers(data: Path, trial: int) -> Floats:
    """Return both dancers (f, 2, 17, 3) of a trial of CMU 60 and 61 in metres, y up."""
    motions = []
    for subject in ("60", "61"):
        folder = data / "cmu"
        skeleton = read_asf(folder / subject / f"{subject}.asf")
        motions.append(human17(read_amc(trials(folder, subject)[trial - 1], skeleton)))
    length = min(map(len, motions))
    return np.stack([motion[:length] for motion in motions], 1)


def simulated_clip(X: Floats, azimuth: float, seed: int) -> Clip:
    """Return the detections of two people (f, 2, 17, 3) by a camera 4 m away at 1 m.

    Keypoints behind the other person are hidden; 15 % of them are found on that person instead.
    Noise is 2 % of a person's size, 5 % of the other keypoints are missing, and a person with fewer
    than 5 visible keypoints is not detected.
    """
    rng, focal = np.random.default_rng(seed), 1000.0
    c, s = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))
    X = (X - [0.3, 1.0, 0.0]) @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    depth = X[..., 2] + 4.0
    points = focal * X[..., :2] * [1, -1] / depth[..., None]
    size = np.sqrt(((points - points.mean(2, keepdims=True)) ** 2).sum(-1).mean(-1))
    confidence = np.ones(depth.shape)
    true_points = points.copy()
    for front, back in ((0, 1), (1, 0)):
        hidden = np.zeros(depth[:, 0].shape, bool)
        radius = focal / depth[:, front].mean(-1, keepdims=True)
        for i, j in HUMAN17.edge_indices():
            a, b = true_points[:, front, i, None], true_points[:, front, j, None]
            along = ((true_points[:, back] - a) * (b - a)).sum(-1) / (((b - a) ** 2).sum(-1) + 1e-9)
            foot = a + np.clip(along, 0, 1)[..., None] * (b - a)
            trunk = {"mid_hip", "neck"} <= {HUMAN17.keypoints[i], HUMAN17.keypoints[j]}
            thick = 0.16 if trunk else 0.07  # m
            hidden |= np.linalg.norm(true_points[:, back] - foot, axis=-1) < thick * radius
        hidden &= (depth[:, front].mean(-1) < depth[:, back].mean(-1))[:, None]
        wrong = hidden & (rng.random(hidden.shape) < 0.15)
        points[:, back][wrong] = true_points[:, front][wrong]
        confidence[:, back][hidden & ~wrong] = 0
    points = points + 0.02 * size[..., None, None] * rng.standard_normal(points.shape)
    confidence[rng.random(confidence.shape) < 0.05] = 0
    confidence[(confidence > 0).sum(-1) < 5] = 0
    points = np.where(confidence[..., None] > 0, points, 0)
    return Clip(points, confidence, DANCE_RATE, DANCE_PARTS, HUMAN17)


def switches(clip: Clip, identify: Callable[[], Identify], lost: float) -> NDArray[np.int64]:
    """Return detections, switches and swaps (3,) of a clip at all its rates."""
    total = np.zeros(3, np.int64)
    for stride, first in clip.parts:
        rows = slice(first, None, stride)
        part = clip._replace(points=clip.points[rows], confidence=clip.confidence[rows])
        total += _switches(part, identify(), clip.rate / stride, lost)
    return total


def _switches(clip: Clip, identify: Identify, rate: float, lost: float) -> tuple[int, int, int]:
    """Return detections, switches and swaps of a clip at one rate, people in random order."""
    rng = np.random.default_rng(0)
    last: dict[int, tuple[str, float]] = {}
    owner: dict[str, int] = {}
    detections = changed = swapped = 0
    for frame, (points, confidence) in enumerate(zip(clip.points, clip.confidence, strict=True)):
        people = [i for i in range(len(points)) if confidence[i].any() and rng.random() >= lost]
        rng.shuffle(people)
        if not people:
            continue
        now = frame / rate
        observation = Observation(
            points[people].astype(np.float32), confidence[people].astype(np.float32)
        )
        for person, identity in zip(people, identify(observation, now), strict=True):
            detections += 1
            before, then = last.get(person, (identity, now))
            if before != identity and now - then <= MAX_TRACK_AGE:
                changed += 1
                swapped += owner.get(identity, person) != person
            last[person], owner[identity] = (identity, now), person
    return detections, changed, swapped


def tracker(layout: KeypointLayout) -> Callable[[], Identify]:
    """Return a function that makes the package's tracker for a layout."""
    tolerances = keypoint_tolerances(layout)

    def start() -> Identify:
        track = Tracker()
        return lambda observation, now: track(observation, now, tolerances=tolerances)

    return start


def clips(data: Path, scenes: Path) -> Iterator[tuple[str, str, list[Clip]]]:
    """Yield people, camera and clips of each row of the table."""
    for file in sorted(scenes.glob("shelf*.npz")):
        for name, clip in shelf_clips(file):
            people, _, camera = name.partition(", ")
            yield people, camera, [clip]
    if not (data / "cmu" / "61").exists():
        print(f"no {data / 'cmu' / '61'}, no rows of dancers")
        return
    dances = [dancers(data, trial) for trial in DANCES]
    for azimuth in AZIMUTHS:
        simulated = [simulated_clip(X, azimuth, 10 * i + azimuth) for i, X in enumerate(dances)]
        yield "CMU 60 and 61", f"{azimuth} degrees", simulated


def benchmark(data: Path, scenes: Path) -> Table:
    """Return the switches of each camera, with both methods."""
    table = Table(
        "identities",
        "Identity switches",
        ("people", "camera", "lost"),
        _FIGURES,
        LEGEND,
        bars("nearest", "similarity"),
    )
    total: dict[tuple[str, str, str], NDArray[np.int64]] = {}
    for people, camera, of_camera in clips(data, scenes):
        zero = np.zeros(3, np.int64)
        for lost in LOST:
            before = sum((switches(clip, Nearest, lost) for clip in of_camera), zero)
            after = sum((switches(c, tracker(c.layout), lost) for c in of_camera), zero)
            row = np.array([before[0], before[1], after[1], before[2], after[2]])
            share = f"{lost:.0%}"
            table.add((people, camera, share), dict(zip(_FIGURES, row.tolist(), strict=True)))
            summed = (people, "all", share)
            total[summed] = total.get(summed, 0) + row
    for labels, row in total.items():
        table.add(labels, dict(zip(_FIGURES, row.tolist(), strict=True)))
    return table


def timing() -> str:
    """Return the microseconds that identities take, for some numbers of objects at rest."""
    body = np.random.default_rng(0).uniform(-50, 50, (17, 2))
    lines = []
    for n in _OBJECTS:
        points = np.array([body + (300 * i, 0) for i in range(n)], np.float32)
        observation = Observation(points, np.ones((n, 17), np.float32))
        identify = tracker(HUMAN17)()
        durations = []
        for frame in range(1000):
            began = time.perf_counter()
            identify(observation, frame / 100)
            durations.append(time.perf_counter() - began)
        lines.append(f"{n} objects: {1e6 * float(np.percentile(durations, 10)):.0f} us")
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.real.identities")
    parser.description = __doc__
    parser.add_argument("--data", type=Path, required=True, help="folder that holds cmu/")
    parser.add_argument("--shelf", type=Path, help="folder of shelf*.npz; else DATA/scenes/shelf")
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks"))
    args = parser.parse_args(argv)
    table = benchmark(args.data, args.shelf or args.data / "scenes" / "shelf")
    table.write(args.output)
    print(table.markdown())
    print(timing())


if __name__ == "__main__":
    main()

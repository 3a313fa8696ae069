# SPDX-License-Identifier: Apache-2.0
"""People over time before calibrated cameras, with the truth; real and simulated detections."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.data.pose2sim_scenes import UP, Scene, scenes
from deep_nrsfm_ros.data.mocap import human17, read_amc, read_asf, trials
from deep_nrsfm_ros.data.pose2sim import JOINTS, RATE, View
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import BODY25, BODY25B, HUMAN17, MEDIAPIPE33
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics

Floats = NDArray[Any]

SHELF, CLIP, STANDING = "shelf_dev", "clip, balancing", "clip, standing"
HUMANEVA, HUMANEVA_NOISY = "humaneva_s1", "humaneva_s1, noise"
CMU, CMU_STILL = "CMU 03, 131", "CMU 03, 131, still"
CMU_LIGHT = "CMU 03, 131, light noise"
SHELF_RATE = 25.0  # Hz
HELD_OUT = ("03", "131")
"""CMU subjects that `human` was not trained on."""
CMU_STRIDE, CMU_RATE = 4, 30.0  # of the 120 Hz of the motion capture
AZIMUTHS = (0.0, 120.0, 240.0)  # degrees, of the cameras around the person
CMU_CAMERA = Intrinsics((900.0, 900.0), (640.0, 480.0))
HEIGHT, DISTANCE = 1.4, 4.0  # m, of the camera and from it to the nearest point of the motion
STILL_FRAMES, STILL_POSES = 45, 8  # frames that a pose is held, poses of a trial
NOISE, NEW_NOISE, NOISE_TIME = 0.032, 0.1, 0.4
"""Of simulated detections: standard deviation of a coordinate in RMS radii, share of its variance
that is new in each frame, seconds that the rest stays alike; as measured on shelf_dev, like the
next two lines."""
DROPOUTS, DROPOUT_TIME = 0.09, 0.37  # share of the keypoints, mean duration in seconds
WRONG, WRONG_TIME, WRONG_STEP = 0.01, 0.2, 0.25  # the same, and their error in RMS radii
LIGHT_NOISE, LIGHT_DROPOUTS = 0.02, 0.05
"""As above, of noise that is new in each frame; no keypoint is wrong."""
GROSS = 1.0
"""Standard deviation in RMS radii of a coordinate of a keypoint at a wrong place."""
_SIDES = ("left", "right")
HUMANEVA15 = KeypointLayout(
    "humaneva15",
    (
        *("mid_hip", "neck", "left_shoulder", "left_elbow", "left_wrist"),
        *("right_shoulder", "right_elbow", "right_wrist", "left_hip", "left_knee"),
        *("left_ankle", "right_hip", "right_knee", "right_ankle", "head_top"),
    ),
)
"""The joints of HumanEva; its pelvis and thorax are taken as mid-hip and neck."""


class Track(NamedTuple):
    """One person before one camera in f frames.

    Attributes:
        view: name of the camera.
        layout: of the detector's q keypoints.
        points: (f, q, 2) pixels, 0 where missing.
        confidence: (f, q), 0 where missing.
        seconds: (f,) stamps, ascending; frames without a detection are left out.
        intrinsics: of the camera.
        truth: (f, 12, 3) mm, `JOINTS` in the camera's axes; NaN where unknown.
        up: (3,) the direction against gravity in the camera's axes.
        reference_length: mm from the person's neck to mid-hip, median.
        world_landmarks: (f, 12, 3) MediaPipe's own 3D, m; None where there are no images.
    """

    view: str
    layout: KeypointLayout
    points: Floats
    confidence: Floats
    seconds: Floats
    intrinsics: Intrinsics
    truth: Floats
    up: Floats
    reference_length: float
    world_landmarks: Floats | None = None


def people_scenes(
    data: Path, output: Path, stride: int = 1, chosen: Sequence[str] = ()
) -> Iterator[tuple[str, list[Track]]]:
    """Yield the name and the tracks of each scene; scenes without data are left out, with a note.

    Args:
        data: folder that holds cmu/ and scenes/.
        output: folder of results, where MediaPipe's results on the clip are kept.
        stride: every n-th trial or sequence only, to shorten a run.
        chosen: names of the scenes; (): all.
    """

    def wanted(*names: str) -> bool:
        return not chosen or not set(names).isdisjoint(chosen)

    shelf, humaneva = (
        data / "scenes" / "shelf" / "shelf_dev.npz",
        data / "scenes" / "humaneva" / "humaneva_s1.npz",
    )
    if not wanted(SHELF):
        pass
    elif shelf.exists():
        yield SHELF, list(shelf_tracks(shelf))
    else:
        print(f"no {shelf}: no rows of {SHELF}")
    if not wanted(HUMANEVA, HUMANEVA_NOISY):
        pass
    elif humaneva.exists():
        exact = list(humaneva_tracks(humaneva, stride))
        if wanted(HUMANEVA):
            yield HUMANEVA, exact
        if wanted(HUMANEVA_NOISY):
            yield HUMANEVA_NOISY, [noisy(track, seed) for seed, track in enumerate(exact)]
    else:
        print(f"no {humaneva}: no rows of {HUMANEVA}")
    if wanted(CLIP, STANDING):
        try:
            balancing, standing, _ = scenes(output)
        except (ValueError, OSError) as error:
            print(f"no rows of the pose2sim clip: {error}")
        else:
            for name, views in ((CLIP, balancing), (STANDING, standing)):
                if wanted(name):
                    yield name, [clip_track(scene) for scene in views]
    if not wanted(CMU, CMU_LIGHT, CMU_STILL):
        return
    moving, light, still = [], [], []
    for seed, motion in enumerate(list(held_out_motions(data / "cmu"))[::stride]):
        poses = motion[np.linspace(0, len(motion) - 1, STILL_POSES + 2).astype(int)[1:-1]]
        exact = [filmed(motion, azimuth, seed) for azimuth in AZIMUTHS]
        moving += [noisy(track, seed) for track in exact]
        light += [lightly_noisy(track, seed) for track in exact]
        for i, pose in enumerate(poses):
            azimuth = AZIMUTHS[i % len(AZIMUTHS)]
            held = np.repeat(pose[None], STILL_FRAMES, 0)
            still.append(noisy(filmed(held, azimuth, seed), STILL_POSES * seed + i))
    for name, tracks in ((CMU, moving), (CMU_LIGHT, light), (CMU_STILL, still)):
        if wanted(name):
            yield name, tracks


def shelf_tracks(file: Path) -> Iterator[Track]:
    """Yield each person in each view of a file of Shelf."""
    with np.load(file) as arrays:
        a = dict(arrays)
    limbs = [BODY25.index(joint) for joint in JOINTS]
    for view in range(a["points"].shape[1]):
        for person in range(a["points"].shape[2]):
            points, confidence = a["points"][:, view, person], a["confidence"][:, view, person]
            visible = np.isfinite(points).all(-1)
            frames = np.flatnonzero(visible.any(1))
            if not len(frames):
                continue
            yield Track(
                f"camera {view}",
                BODY25,
                np.where(visible[..., None], points, 0)[frames],
                np.where(visible, confidence, 0)[frames],
                frames / SHELF_RATE,
                _intrinsics(a["K"][view], a["dist"][view]),
                1000 * (a["truth"][frames, person][:, limbs] @ a["R"][view].T + a["t"][view]),
                a["R"][view] @ [0.0, 0.0, 1.0],
                _torso(1000 * a["truth"][:, person], BODY25),
            )


def humaneva_tracks(file: Path, stride: int = 1) -> Iterator[Track]:
    """Yield every stride-th sequence in each view of a file of HumanEva."""
    with np.load(file) as arrays:
        a = dict(arrays)
    limbs = [HUMANEVA15.index(joint) for joint in JOINTS]
    for sequence in np.unique(a["sequence"])[::stride]:
        frames = np.flatnonzero(a["sequence"] == sequence)
        for view in range(a["points"].shape[1]):
            yield Track(
                f"camera {view}",
                HUMANEVA15,
                a["points"][frames, view, 0],
                np.ones((len(frames), len(HUMANEVA15))),
                frames / float(a["fps"]),
                _intrinsics(a["K"][view], a["dist"][view]),
                1000 * (a["truth"][frames, 0][:, limbs] @ a["R"][view].T + a["t"][view]),
                a["R"][view] @ [0.0, 0.0, 1.0],
                _torso(1000 * a["truth"][:, 0], HUMANEVA15),
            )


def clip_track(scene: Scene) -> Track:
    """Return the track of one camera of the pose2sim clip.

    The detections are those that come with the clip, else MediaPipe's.
    """
    mediapipe = scene.mediapipe
    world = mediapipe.world[:, [MEDIAPIPE33.index(joint) for joint in JOINTS]]
    if scene.detections is not None:
        return view_track(scene.detections)._replace(world_landmarks=world)
    return Track(
        scene.camera,
        MEDIAPIPE33,
        np.nan_to_num(mediapipe.points),
        mediapipe.confidence,
        np.arange(len(mediapipe.points)) / RATE,
        scene.intrinsics,
        scene.truth,
        scene.up,
        _torso(_with_middles(scene.truth), HUMAN17),
        world,
    )


def view_track(view: View) -> Track:
    """Return the track of the detections that come with the pose2sim clip."""
    return Track(
        view.camera.name,
        BODY25B,
        np.nan_to_num(view.points),
        view.confidence,
        np.arange(len(view.points)) / RATE,
        view.camera.intrinsics,
        view.truth,
        view.camera.rotation @ UP,
        _torso(_with_middles(view.truth), HUMAN17),
    )


def held_out_trials(folder: Path) -> Iterator[tuple[Path, Floats]]:
    """Yield the file of each held-out trial, and its motion as `held_out_motions` has it."""
    for subject in HELD_OUT:
        skeleton = read_asf(folder / subject / f"{subject}.asf")
        for trial in trials(folder, subject):
            yield trial, human17(read_amc(trial, skeleton))[::CMU_STRIDE].astype(float)


def held_out_motions(folder: Path) -> Iterator[Floats]:
    """Yield the trials (f, 17, 3) of the held-out subjects in m, y up, at `CMU_RATE`."""
    for _, motion in held_out_trials(folder):
        yield motion


def filmed(motion: Floats, azimuth: float, seed: int) -> Track:
    """Return a motion (f, 17, 3), m, y up, as a camera at rest sees it, without noise.

    The camera looks at the middle of the motion, `DISTANCE` from its nearest point, and rolls a
    little.
    """
    rng = np.random.default_rng((seed, int(azimuth)))
    middle = motion.mean((0, 1))
    radius = np.linalg.norm((motion.mean(1) - middle)[:, [0, 2]], axis=1).max()
    turned = (motion - middle) @ Rotation.from_euler("y", azimuth, degrees=True).as_matrix().T
    distance = DISTANCE + radius
    tilt = np.degrees(np.arctan2(HEIGHT - middle[1], distance))
    R = Rotation.from_euler("xz", [tilt, rng.normal(0, 3)], degrees=True).as_matrix()
    R = R @ np.diag([1.0, -1.0, -1.0])  # to y down and z away from the camera
    X = turned @ R.T + [0, 0, np.hypot(distance, HEIGHT - middle[1])]
    return Track(
        f"azimuth {azimuth:.0f}",
        HUMAN17,
        CMU_CAMERA.pixels(X[..., :2] / X[..., 2:]),
        np.ones(X.shape[:2]),
        np.arange(len(X)) / CMU_RATE,
        CMU_CAMERA,
        1000 * X[:, [HUMAN17.index(joint) for joint in JOINTS]],
        R @ [0.0, 1.0, 0.0],
        _torso(1000 * X, HUMAN17),
    )


def noisy(track: Track, seed: int) -> Track:
    """Return the track with noise like a detector's: lasting, with wrong and missing joints."""
    rng = np.random.default_rng(seed)
    f, q = track.confidence.shape
    steps = np.diff(track.seconds, prepend=track.seconds[0])
    missing = _bursts(rng, steps, q, DROPOUTS, DROPOUT_TIME)
    wrong = _bursts(rng, steps, q, WRONG, WRONG_TIME)
    lasting, value = np.zeros((f, q, 2)), rng.standard_normal((q, 2))
    for i, step in enumerate(steps):
        kept = np.exp(-step / NOISE_TIME)
        value = kept * value + np.sqrt(1 - kept**2) * rng.standard_normal((q, 2))
        lasting[i] = value
    scattered = rng.standard_normal((f, q, 2))
    error = np.sqrt(NEW_NOISE) * scattered + np.sqrt(1 - NEW_NOISE) * lasting
    error *= np.where(wrong, WRONG_STEP, NOISE)[..., None]
    return _detected(track, error, missing)


def lightly_noisy(track: Track, seed: int) -> Track:
    """Return the track with a little noise, new in each frame, and some missing joints."""
    rng = np.random.default_rng(seed)
    f, q = track.confidence.shape
    steps = np.diff(track.seconds, prepend=track.seconds[0])
    missing = _bursts(rng, steps, q, LIGHT_DROPOUTS, DROPOUT_TIME)
    return _detected(track, LIGHT_NOISE * rng.standard_normal((f, q, 2)), missing)


def displaced(track: Track, share: float, seed: int) -> Track:
    """Return the track with a share of the keypoints at wrong places, for a random time each.

    The places are as far from the right ones as the person is large: see `GROSS`.
    """
    rng = np.random.default_rng(seed)
    f, q = track.confidence.shape
    steps = np.diff(track.seconds, prepend=track.seconds[0])
    wrong = _bursts(rng, steps, q, share, WRONG_TIME) & (track.confidence > 0)
    offset = rng.standard_normal((f, q, 2))
    for i in range(1, f):
        offset[i] = np.where((wrong[i] & wrong[i - 1])[:, None], offset[i - 1], offset[i])
    moved = GROSS * _size(track)[:, None, None] * offset
    return track._replace(points=track.points + np.where(wrong[..., None], moved, 0))


def _size(track: Track) -> Floats:
    """Return the RMS radius (f,) of the visible keypoints in pixels."""
    shown = (track.confidence > 0)[..., None]
    count = np.maximum(shown.sum(1, keepdims=True), 1)
    apart = (track.points - (track.points * shown).sum(1, keepdims=True) / count) * shown
    size: Floats = np.sqrt(np.square(apart).sum((1, 2)) / count[:, 0, 0])
    return size


def _detected(track: Track, error: Floats, missing: NDArray[np.bool_]) -> Track:
    """Return the track with errors (f, q, 2) in RMS radii and missing keypoints (f, q).

    Neck and mid-hip follow from the other joints, as detectors have them.
    """
    points: Floats = track.points + _size(track)[:, None, None] * error
    confidence = np.where(missing, 0, track.confidence)
    at = track.layout.index
    for middle, part in (("neck", "shoulder"), ("mid_hip", "hip")):
        sides = [at(f"left_{part}"), at(f"right_{part}")]
        points[:, at(middle)] = points[:, sides].mean(1)
        confidence[:, at(middle)] = confidence[:, sides].min(1)
    shown = np.where(confidence[..., None] > 0, points, 0)
    return track._replace(points=shown, confidence=confidence)


def _bursts(
    rng: np.random.Generator, steps: Floats, q: int, share: float, duration: float
) -> NDArray[np.bool_]:
    """Return which of q keypoints are chosen at each of f frames, for a random time each.

    Args:
        rng: draws.
        steps: (f,) seconds since the frame before.
        q: number of keypoints.
        share: mean share of the chosen ones.
        duration: mean time in seconds for which a keypoint stays chosen.
    """
    chosen, state = np.zeros((len(steps), q), bool), rng.random(q) < share
    for i, step in enumerate(steps):
        ends = 1 - np.exp(-step / duration)
        begins = ends * share / (1 - share)
        state = np.where(state, rng.random(q) >= ends, rng.random(q) < begins)
        chosen[i] = state
    return chosen


def _with_middles(limbs: Floats) -> Floats:
    """Return `JOINTS` (f, 12, 3) with the neck and the mid-hip between their sides (f, 14, 3)."""
    sides = [JOINTS.index(f"{side}_{part}") for part in ("shoulder", "hip") for side in _SIDES]
    middles: Floats = limbs[:, sides].reshape(-1, 2, 2, 3).mean(2)
    return np.concatenate((limbs, middles), 1)


def _torso(shapes: Floats, layout: KeypointLayout) -> float:
    """Return the median distance of neck and mid-hip in shapes (f, p, 3) of a layout."""
    torso = shapes[:, layout.index("neck")] - shapes[:, layout.index("mid_hip")]
    lengths = np.linalg.norm(torso, axis=1)
    known = lengths[np.isfinite(lengths)]
    return float(np.median(known)) if len(known) else float("nan")


def _intrinsics(K: Floats, distortion: Floats) -> Intrinsics:
    """Return the intrinsics of a camera matrix (3, 3) and coefficients k1 k2 p1 p2 k3."""
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    return Intrinsics((fx, fy), (cx, cy), tuple(distortion.tolist()))

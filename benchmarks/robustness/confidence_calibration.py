# SPDX-License-Identifier: Apache-2.0
"""Calibration of the confidence: share of correct points against the published confidence.

With `--fit` the program fits the calibration to the first subject, prints the constants for
`lifting/confidence.py`, and rates nothing.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.harness import Session, run_program
from benchmarks.table import Table
from deep_nrsfm_ros.data.mocap import TrialSelection, read_split
from deep_nrsfm_ros.data.pose2sim import JOINTS, WHEEL, read_session
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import BODY25, BODY25B, COCO17
from deep_nrsfm_ros.lifting.confidence import (
    CALIBRATED,
    CORRECT_DISTANCE,
    Calibration,
    Coefficients,
    Evidence,
    log_odds_terms,
)
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter, lift_all
from deep_nrsfm_ros.lifting.numpy_backend import Float32
from deep_nrsfm_ros.lifting.perspective import lift_perspective
from deep_nrsfm_ros.lifting.weights import keypoint_weight, trusted
from deep_nrsfm_ros.model_files.folders import default_models_dir, model_folders
from deep_nrsfm_ros.model_files.model_file import Model, find_model, load_model
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras, rotation_from_camera
from deep_nrsfm_ros.nrsfm.network import point_precision

Floats = NDArray[Any]
Mask = NDArray[np.bool_]
Lift = Callable[[Float32, Float32], Lifted]

SUBJECTS = ("131", "03")
"""The calibration is fitted to the first, tested on the others; none was used in training."""
MODELS = ("human", "human17", "cmu31")
STRIDE = 8
SCENE_STRIDE = 30  # of humaneva's 60 frames a second
NOISE = (0.0, 0.02, 0.05, 0.1, 0.2)
HIDDEN = (0.0, 0.1, 0.2, 0.4, 0.6)
DISTANCE = (5.0, 20.0)
ASIDE = 15.0
CACHE = Path(".cache")
BINS = 10
GAPS, BORDER, ONE_SIDE, LEGS, EVERY = (
    *("random gaps", "at a border", "one side", "legs alone"),
    "every cut",
)
# Parts of a body from the waist down; a cut hides its part and all that follow.
_LOWER = {
    "at the waist": ("root", "hip", "hipjoint"),
    "at the hips": ("knee", "femur"),
    "at the knees": ("ankle", "tibia"),
    "at the ankles": ("toe", "toes", "heel", "foot"),
}
CUTS = (GAPS, *_LOWER, ONE_SIDE)
"""Cuts of which the table tells."""
FITTED_CUTS = (*CUTS, LEGS, BORDER)
_FEWEST = 30  # points in a bin to be shown
_FEWEST_VISIBLE = 3  # points of known truth in an object to be rated
_STEPS = 30  # of Newton's method
LEGEND = {
    "rated on": f"CMU subjects, each frame seen by a random perspective camera {DISTANCE[0]:g} to "
    f"{DISTANCE[1]:g} RMS radii away and up to {ASIDE:g} degrees beside the optical axis, with a "
    f"noise of {', '.join(f'{n:.0%}' for n in NOISE)} of the RMS radius, drawn for each frame; "
    "as coco17: without toes, and with neck and mid-hip only where the two points between which "
    "they lie are visible; detections of pose2sim, where `make demo-live` has fetched them, and of "
    "Shelf, and motion capture before HumanEva's cameras, where DATA/scenes has them: the 12 limb "
    "joints, Shelf and HumanEva with intrinsics. The fit saw none of them",
    "cut": f"{GAPS}: {', '.join(f'{h:.0%}' for h in HIDDEN)} of the points hidden, drawn for each "
    "frame; at the waist: the hips and all below hidden; at the hips, knees, ankles: all below "
    "them hidden; one side: all left or all right points hidden; as it is: as detected",
    "confidence": f"bin of the points of {EVERY}, or all",
    "points %": "share of the points whose confidence is in the bin",
    "confidence %": "their mean confidence",
    "near %": f"how many are in truth within {CORRECT_DISTANCE:.0%} of the object's size, 2 RMS "
    "radii, of where they should be, in the camera's axes, after the translation and the scale "
    "that fit the visible points best",
    "off %": "mean difference of confidence and share of correct points over the bins",
    "seen, missing": "the same of the points that the lifter was given, and of the others",
    "rank": "Spearman correlation of confidence and error of single points; -1 would be perfect",
}
_OF_PART = ("confidence %", "near %", "off %")
FIGURES = (
    "points %",
    *_OF_PART,
    *(f"{part} {name}" for part in ("seen", "missing") for name in _OF_PART),
    "rank",
)
ALL = "all"


class Predictions(NamedTuple):
    """Confidence and error of k points of n objects."""

    confidence: Floats  # (n, k)
    error: Floats  # (n, k) relative to the size of the object
    visible: Mask  # (n, k)


class Detections(NamedTuple):
    """Keypoints of n objects in a model's layout, and the truth of k of them."""

    points: Floats  # (n, p, 2)
    confidence: Floats  # (n, p)
    truth: Floats  # (n, k, 3) in camera axes
    keypoints: NDArray[np.int64]  # (k,) which ones
    lift: Lift


class RecordingLifter(Lifter):
    """A lifter with default options whose confidence is that of the odds `spread`.

    All other terms of the log odds follow from its shapes.
    """

    def __init__(self, model: Model) -> None:
        """Create the lifter of a model."""
        super().__init__(model)
        only_spread = Coefficients(0, 1, 0, 0, 0, 0, 0)
        constants = self.constants._replace(calibration=Calibration(only_spread, only_spread))
        self.backend = type(self.backend)(constants)
        self._precision = point_precision(model.network)

    def terms(self, lifted: Lifted, visible: Mask) -> Floats:
        """Return the terms (n, p, 7) of the log odds of all points.

        Args:
            lifted: n objects, lifted by this lifter from points of confidence 1 or 0.
            visible: (n, p).
        """
        spread = lifted.confidence / (1 - lifted.confidence)
        evidence = Evidence(visible.astype(float), visible, lifted.residual, lifted.shapes)
        seen, missing = log_odds_terms(evidence, np.ones(visible.shape[1]), self._precision)
        terms = np.where(visible[..., None], seen, missing)
        terms[..., 1] = np.log(spread)
        return terms


def benchmark(session: Session) -> Table:
    """Return the table of the shipped calibration on subjects and scenes that it has not seen."""
    session = dataclasses.replace(session, stride=max(session.stride, STRIDE))
    _, *others = session.subjects
    table = Table(
        "confidence_calibration",
        "Calibration of the confidence",
        ("model", "rated on", "cut", "confidence"),
        FIGURES,
        LEGEND | {f"shipped, fitted to subject {SUBJECTS[0]}": _as_text(CALIBRATED)},
        draw,
    )
    for model in _models():
        lifter = Lifter(model)
        for subject in others:
            _add(table, model, f"CMU {subject}", on_mocap(session, lifter, subject))
            if _of_people(model.layout):
                as_coco = on_mocap(session, lifter, subject, COCO17)
                _add(table, model, f"CMU {subject} as coco17", as_coco)
        if _of_people(model.layout):
            for name, detections in scenes(lifter, session.data / "scenes"):
                _add(table, model, name, on_detections(detections, model.layout))
    return table


def fit_shipped(session: Session) -> Calibration:
    """Return the calibration fitted to the first subject, with all models of `MODELS`."""
    session = dataclasses.replace(session, stride=max(session.stride, STRIDE))
    parts: list[tuple[Floats, Predictions]] = []
    for model in _models():
        lifter = RecordingLifter(model)
        detectors = (None, COCO17) if _of_people(model.layout) else (None,)
        for detector in detectors:
            views = mocap_views(session, lifter, session.subjects[0], FITTED_CUTS, detector)
            for _, detections in views:
                terms, predictions = rate(detections, lifter)
                parts.append((terms, predictions))
    return fit(parts)


def _models() -> list[Model]:
    folders = model_folders(default_models_dir())
    return [load_model(find_model(name, folders)) for name in MODELS]


def _of_people(layout: KeypointLayout) -> bool:
    """Return whether a layout has the joints that detectors of people share."""
    return set(JOINTS) <= set(layout.keypoints)


def hidden(layout: KeypointLayout, cut: str) -> list[Mask]:
    """Return masks (p,) of the points that a cut hides; each frame takes one of them.

    Args:
        layout: of people.
        cut: any of `FITTED_CUTS` but the random ones.
    """
    names = layout.keypoints
    if cut == ONE_SIDE:
        sides = [("left_", "right_"), ("right_", "left_"), ("l", "r"), ("r", "l")]
        masks = [
            np.array([n.startswith(a) and b + n[len(a) :] in names for n in names])
            for a, b in sides
        ]
        return [mask for mask in masks if mask.any()]
    levels = list(_LOWER)
    if cut == LEGS:
        return [~hidden(layout, levels[0])[0]]
    parts = tuple(part for level in levels[levels.index(cut) :] for part in _LOWER[level])
    return [np.array([name.endswith(parts) for name in names])]


def cut_off(points: Floats, layout: KeypointLayout, cut: str, rng: np.random.Generator) -> Mask:
    """Return which keypoints (n, p) of points (n, p, 2) a cut leaves visible."""
    n, p, _ = points.shape
    if cut == GAPS:
        left: Mask = rng.random((n, p)) >= rng.choice(HIDDEN, n)[:, None]
    elif cut == BORDER:
        angle, share = rng.uniform(0, 2 * np.pi, n), rng.uniform(0.1, 0.6, n)
        across = (points * np.stack((np.cos(angle), np.sin(angle)), 1)[:, None]).sum(2)
        left = across.argsort(1).argsort(1) < (1 - share)[:, None] * p
    else:
        masks = np.array(hidden(layout, cut))
        left = ~masks[rng.integers(0, len(masks), n)]
    return left


def mocap_views(
    session: Session,
    lifter: Lifter,
    subject: str,
    cuts: Sequence[str],
    detector: KeypointLayout | None = None,
) -> Iterator[tuple[str, Detections]]:
    """Yield each cut with random views of a subject's frames, with noise.

    Args:
        session: has the data.
        lifter: lifts them.
        subject: of CMU.
        cuts: of `FITTED_CUTS`.
        detector: its keypoints alone are seen, and those that follow from them. None: all.
    """
    layout, rng = lifter.model.layout, np.random.default_rng(int(subject))
    selection = TrialSelection(session.data / "cmu", [subject], "all", session.stride)
    shapes = read_split(selection, layout).shapes
    assert shapes is not None
    for cut in cuts:
        T, points = project(shapes, rng)
        visible = cut_off(points, layout, cut, rng)
        if detector:
            shared = [name for name in detector.keypoints if name in layout.keypoints]
            ours, theirs = ([x.index(name) for name in shared] for x in (layout, detector))
            detected = np.zeros((len(points), len(detector)), np.float32)
            detected[:, theirs] = visible[:, ours]
            filled = np.zeros((*detected.shape, 2), np.float32)
            filled[:, theirs] = points[:, ours]
            points, confidence = KeypointMap(detector, layout)(filled, detected)
        else:
            confidence = visible.astype(np.float32)
        yield cut, Detections(points, confidence, T, np.arange(len(layout)), lifter.lift)


def on_mocap(
    session: Session, lifter: Lifter, subject: str, detector: KeypointLayout | None = None
) -> dict[str, Predictions]:
    """Return the predictions of each cut of `CUTS`; see `mocap_views`."""
    views = mocap_views(session, lifter, subject, CUTS, detector)
    return {cut: rate(detections)[1] for cut, detections in views}


def project(truth: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return shapes (n, p, 3) in the axes of random cameras, and their noisy points (n, p, 2)."""
    n = len(truth)
    T = centre(truth @ rotation_from_camera(random_cameras(n, rng)).swapaxes(1, 2))
    T /= radius(T)[:, None, None]
    place = np.ones((n, 1, 3))
    place[:, 0, :2] = np.tan(np.radians(rng.uniform(-ASIDE, ASIDE, (n, 2)) / np.sqrt(2)))
    at = T + rng.uniform(*DISTANCE, (n, 1, 1)) * place / np.linalg.norm(place, axis=2)[..., None]
    W = at[..., :2] / at[..., 2:]
    noise = rng.choice(NOISE, n) * radius(centre(W))
    W += noise[:, None, None] * rng.standard_normal(W.shape) / np.sqrt(2)
    return T, W.astype(np.float32)


def scenes(lifter: Lifter, folder: Path) -> Iterator[tuple[str, list[Detections]]]:
    """Yield the real scenes that are there, each with the detections of its cameras."""
    layout = lifter.model.layout
    limbs = np.array([layout.index(joint) for joint in JOINTS])
    wheel = CACHE / WHEEL
    if wheel.exists():
        views = []
        for view in read_session(wheel).views:
            points, confidence = KeypointMap(BODY25B, layout)(view.points, view.confidence)
            views.append(Detections(points, confidence, view.truth, limbs, lifter.lift))
        yield "pose2sim", views
    else:
        print(f"no {wheel}, no rows of pose2sim; `make demo` downloads it")
    for name, file, detector, stride in (
        ("shelf", folder / "shelf" / "shelf_dev.npz", BODY25, 1),
        ("humaneva", folder / "humaneva" / "humaneva_s1.npz", None, SCENE_STRIDE),
    ):
        if file.exists():
            yield name, list(_scene_views(lifter, file, detector, stride))
        else:
            print(f"no {file}, no rows of {name}")


def _scene_views(
    lifter: Lifter, file: Path, detector: KeypointLayout | None, stride: int
) -> Iterator[Detections]:
    """Yield the views of a scene: points (frames, views, people, joints, 2), truth, K, dist, R, t.

    The detector None has the joints of the scene that are `COCO17`'s too.
    """
    layout = lifter.model.layout
    limbs = np.array([layout.index(joint) for joint in JOINTS])
    with np.load(file) as scene:
        names = [str(name) for name in scene["joint_names"]]
        shared = tuple(name for name in COCO17.keypoints if name in names)
        to = detector or KeypointLayout(file.stem, shared)
        lifter = Lifter(lifter.model, lifter.options, layout=to)
        at = [names.index(name) if name in names else -1 for name in to.keypoints]
        truth_at = [names.index(joint) for joint in JOINTS]
        points, confidence = scene["points"][::stride], scene["confidence"][::stride]
        confidence = np.where(np.isfinite(points).all(-1), confidence, 0)[..., at]
        confidence[..., [i < 0 for i in at]] = 0
        points = np.nan_to_num(points[..., at, :])
        truth = scene["truth"][::stride][..., truth_at, :].astype(float)
        for v, (K, dist, R, t) in enumerate(
            zip(*(scene[k] for k in ("K", "dist", "R", "t")), strict=True)
        ):
            camera = Intrinsics((K[0, 0], K[1, 1]), (K[0, 2], K[1, 2]), tuple(dist))
            flat = (-1, len(to))
            mapped = KeypointMap(to, layout)(
                points[:, v].reshape(*flat, 2).astype(np.float32),
                confidence[:, v].reshape(flat).astype(np.float32),
            )

            def lift(points: Float32, confidence: Float32, camera: Intrinsics = camera) -> Lifted:
                return lift_perspective(lifter, camera, points, confidence)

            in_camera = (truth @ R.T + t).reshape(-1, len(JOINTS), 3)
            yield Detections(*mapped, in_camera, limbs, lift)


def on_detections(views: Sequence[Detections], layout: KeypointLayout) -> dict[str, Predictions]:
    """Return the predictions of detections as they are, and with each cut of `CUTS`."""
    rng, result = np.random.default_rng(0), {}
    for cut in ("as it is", *CUTS[1:]):
        parts = []
        for view in views:
            known = np.isfinite(view.truth).all((1, 2)) & (view.confidence > 0).any(1)
            points, confidence = view.points[known], view.confidence[known]
            if cut in CUTS:
                confidence = confidence * cut_off(points, layout, cut, rng)
            cut_view = view._replace(
                points=points, confidence=confidence.astype(np.float32), truth=view.truth[known]
            )
            parts.append(rate(cut_view)[1])
        result[cut] = Predictions(*map(np.concatenate, zip(*parts, strict=True)))
    return result


def rate(
    detections: Detections, recording: RecordingLifter | None = None
) -> tuple[Floats, Predictions]:
    """Lift, and compare k points with the truth.

    Returns:
        The terms (n, k, 7) of the log odds, empty without a recording lifter, and the predictions,
        both of the objects that are lifted and of which enough visible points have a truth.
    """
    points, confidence, T, k, lift = detections
    lifted = lift_all(lift, points, confidence)
    seen = trusted(keypoint_weight(confidence))
    valid = ~np.isnan(lifted.residual) & (seen[:, k].sum(1) >= _FEWEST_VISIBLE)
    lifted, seen = lifted.at(valid), seen[valid]
    terms = recording.terms(lifted, seen)[:, k] if recording else np.zeros(0)
    S, T, visible = lifted.shapes[:, k], T[valid], seen[:, k]
    # The truth may lack points. Twice the RMS radius of all is so many of that of those it has.
    ratio = np.median(radius(centre(lifted.shapes)) / radius(centre(S)))
    error = errors(S, T, visible, 2 * ratio * radius(centre(T)))
    return terms, Predictions(lifted.confidence[:, k], error, visible)


def errors(S: Floats, T: Floats, visible: Mask, size: Floats) -> Floats:
    """Return the distances (n, k) of shapes S (n, k, 3) from the truth T, relative to size (n,).

    Translation and scale are those that fit the visible points best.
    """
    m = visible[..., None] / visible.sum(1)[:, None, None]
    S, T = (X.astype(float) - (m * X).sum(1)[:, None] for X in (S, T))
    scale = (m * S * T).sum((1, 2)) / (m * S * S).sum((1, 2))
    distance: Floats = np.linalg.norm(scale[:, None, None] * S - T, axis=2) / size[:, None]
    return distance


def fit(parts: Sequence[tuple[Floats, Predictions]]) -> Calibration:
    """Return the calibration with the highest likelihood, by two logistic regressions."""
    X = np.concatenate([terms.reshape(-1, len(Coefficients._fields)) for terms, _ in parts])
    y = np.concatenate([part.error.ravel() < CORRECT_DISTANCE for _, part in parts])
    visible = np.concatenate([part.visible.ravel() for _, part in parts])
    # The gap of a visible point is no evidence.
    seen = _logistic_regression(X[visible][:, :-1], y[visible])
    missing = _logistic_regression(X[~visible], y[~visible])
    return Calibration(Coefficients(*(*seen, 0.0)), Coefficients(*missing))


def _logistic_regression(X: Floats, y: Mask) -> list[float]:
    """Return the coefficients of the columns of X (m, c) that make y (m,) most likely."""
    w, ridge = np.zeros(X.shape[1]), 1e-6 * len(X)
    for _ in range(_STEPS):
        chance = 1 / (1 + np.exp(-X @ w))
        curvature = (X * (chance * (1 - chance))[:, None]).T @ X + ridge * np.eye(len(w))
        w += np.linalg.solve(curvature, X.T @ (y - chance) - ridge * w)
    coefficients: list[float] = w.tolist()
    return coefficients


def reliability(predictions: Predictions) -> Iterable[tuple[str, dict[str, float]]]:
    """Return the figures of each bin of confidence, then over all."""
    confidence, error, visible = predictions
    correct, bins = error < CORRECT_DISTANCE, _bins(confidence)
    for i in range(BINS):
        inside = bins == i
        if inside.sum() >= _FEWEST:
            figures = {"points %": inside.mean()} | _means(confidence[inside], correct[inside])
            yield f"{i / BINS:g} to {(i + 1) / BINS:g}", _percent(figures)
    yield ALL, overall(predictions)


def overall(predictions: Predictions) -> dict[str, float]:
    """Return all of `FIGURES` over all points."""
    confidence, error, visible = predictions
    correct = error < CORRECT_DISTANCE
    figures = {"points %": 1.0}
    for prefix, part in (("", np.ones_like(visible)), ("seen ", visible), ("missing ", ~visible)):
        if part.sum() >= _FEWEST:
            means = _means(confidence[part], correct[part])
            means["off %"] = off(confidence[part], correct[part])
            figures |= {prefix + name: value for name, value in means.items()}
    return _percent(figures) | {"rank": spearman(confidence.ravel(), error.ravel())}


def off(confidence: Floats, correct: Mask) -> float:
    """Return the mean difference of confidence (m,) and share of correct points over the bins."""
    bins, total = _bins(confidence), 0.0
    for i in range(BINS):
        inside = bins == i
        if inside.sum() >= _FEWEST:
            total += inside.mean() * abs(confidence[inside].mean() - correct[inside].mean())
    return total


def _bins(confidence: Floats) -> NDArray[np.int64]:
    index: NDArray[np.int64] = np.clip((confidence * BINS).astype(int), 0, BINS - 1)
    return index


def _means(confidence: Floats, correct: Mask) -> dict[str, float]:
    return {"confidence %": float(confidence.mean()), "near %": float(correct.mean())}


def _percent(figures: Mapping[str, float]) -> dict[str, float]:
    return {name: 100 * float(value) for name, value in figures.items()}


def spearman(a: Floats, b: Floats) -> float:
    """Return Spearman's rank correlation of a (n,) and b (n,), ties in order of appearance."""
    rank_a, rank_b = (np.argsort(np.argsort(x, kind="stable")) for x in (a, b))
    return float(np.corrcoef(rank_a, rank_b)[0, 1])


def draw(table: Table, figure: Figure) -> None:
    """Plot the share of correct points against the confidence, and how far each cut is off."""
    figure.set_size_inches(9, 5.5)
    figure.set_layout_engine("constrained")
    left, right = figure.subplots(1, 2)
    models, data = ([*dict.fromkeys(row.labels[i] for row in table.rows)] for i in range(2))
    cuts = list(dict.fromkeys(row.labels[2] for row in table.rows if row.labels[2] != EVERY))
    for labels in dict.fromkeys(row.labels[:2] for row in table.rows):
        rows = [row for row in table.rows if row.labels[:2] == labels]
        of_bins = [r.figures for r in rows if r.labels[2] == EVERY and r.labels[3] != ALL]
        at = {r.labels[2]: r.figures["off %"] for r in rows if r.labels[2] != EVERY}
        left.plot(
            [figures["confidence %"] for figures in of_bins],
            [figures["near %"] for figures in of_bins],
            color=(colour := f"C{data.index(labels[1])}"),
            marker=(marker := "os^"[models.index(labels[0]) % 3]),
            label=" on ".join(labels),
        )
        places = [cuts.index(cut) for cut in at]
        right.plot(list(at.values()), places, color=colour, marker=marker, linestyle="")
    left.plot([0, 100], [0, 100], color="0.7", linestyle="--", zorder=0)
    left.set(xlabel="confidence %", ylabel=f"within {CORRECT_DISTANCE:.0%} of the object's size, %")
    right.set(xlabel="off, mean over the bins, %", xlim=(0, None))
    right.set_yticks(range(len(cuts)), cuts)
    right.invert_yaxis()
    figure.legend(loc="outside lower center", ncols=3, fontsize="small")


def _add(table: Table, model: Model, test_data: str, cuts: Mapping[str, Predictions]) -> None:
    for cut, predictions in cuts.items():
        table.add((model.name, test_data, cut, ALL), overall(predictions))
    together = Predictions(*map(np.concatenate, zip(*cuts.values(), strict=True)))
    for label, figures in reliability(together):
        table.add((model.name, test_data, EVERY, label), figures)


def radius(S: Floats) -> Floats:
    """Return the RMS radius (n,) of centred shapes (n, p, d)."""
    radius: Floats = np.sqrt((S * S).sum(2).mean(1))
    return radius


def _as_text(calibration: Calibration) -> str:
    return "; ".join(
        f"{part}: " + ", ".join(f"{name} {value:.2f}" for name, value in row._asdict().items())
        for part, row in calibration._asdict().items()
    )


def _as_code(calibration: Calibration) -> str:
    """Return the lines of `lifting/confidence.py` that hold a calibration."""
    rows = (
        f"    {part}=Coefficients({', '.join(f'{value:.2f}' for value in row)}),"
        for part, row in calibration._asdict().items()
    )
    return "\n".join(("CALIBRATED = Calibration(", *rows, ")"))


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--fit", action="store_true")
    own, others = parser.parse_known_args(argv)
    if not own.fit:
        run_program(benchmark, __doc__, SUBJECTS, others)
        return
    parser = argparse.ArgumentParser(parents=[parser])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--subjects", nargs="+", default=list(SUBJECTS))
    parser.add_argument("--stride", type=int, default=1)
    args = parser.parse_args(["--fit", *others])
    session = Session(args.data, Path(), tuple(args.subjects), (), None, args.stride)
    start = time.process_time()
    print(_as_code(fit_shipped(session)))
    print(f"fitted in {time.process_time() - start:.0f} s of CPU time")


if __name__ == "__main__":
    main()

"""Calibration of the confidence: share of correct points against the published confidence."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.harness import Session, run_program
from benchmarks.table import Table
from deep_nrsfm_ros.commands.demo.__main__ import WHEEL
from deep_nrsfm_ros.data.mocap import TrialSelection, read_split
from deep_nrsfm_ros.data.pose2sim import JOINTS, read_session
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.presets import BODY25B
from deep_nrsfm_ros.lifting.confidence import (
    CALIBRATED,
    CORRECT_DISTANCE,
    Calibration,
    log_odds_terms,
)
from deep_nrsfm_ros.lifting.lifter import Lifter, lift_all
from deep_nrsfm_ros.lifting.numpy_backend import Float32, LifterConstants, NumpyBackend
from deep_nrsfm_ros.model_files.folders import default_models_dir, model_folders
from deep_nrsfm_ros.model_files.model_file import Model, find_model, load_model
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras, rotation_from_camera

Floats = NDArray[Any]

SUBJECTS = ("131", "03")
"""The calibration is fitted to the first, tested on the others; none was used in training."""
MODELS = ("human", "cmu31")
STRIDE = 8
NOISE = (0.0, 0.02, 0.05, 0.1, 0.2)
HIDDEN = (0.0, 0.1, 0.2, 0.4, 0.6)
DISTANCE = (5.0, 20.0)
ASIDE = 15.0
CACHE = Path(".cache")
BINS = 10
_FEWEST = 30  # points in a bin to be shown
_STEPS = 30  # of Newton's method
LEGEND = {
    "rated on": f"CMU subjects, each frame seen by a random perspective camera {DISTANCE[0]:g} to "
    f"{DISTANCE[1]:g} RMS radii away and up to {ASIDE:g} degrees beside the optical axis, with a "
    f"noise of {', '.join(f'{n:.0%}' for n in NOISE)} of the RMS radius and "
    f"{', '.join(f'{h:.0%}' for h in HIDDEN)} of the points hidden, drawn for each frame; or the "
    "real detections of pose2sim, where `make demo` has fetched them",
    "points %": "share of the points whose confidence is in the bin",
    "confidence %": "their mean confidence",
    "near %": f"how many are in truth within {CORRECT_DISTANCE:.0%} of the object's size, 2 RMS "
    "radii, of where they should be, in the camera's axes after the best scale",
    "error %": "their mean distance from there, in the object's size",
    "off %": "mean difference of confidence and share of correct points over the bins",
    "rank points, objects": "Spearman correlation of confidence and error, of single points, and "
    "of objects by the means over their points; -1 would be perfect",
}
FIGURES = (
    *("points %", "confidence %", "near %", "error %"),
    *("off %", "rank points", "rank objects"),
)
ALL = "all"


class Predictions(NamedTuple):
    """Confidence and error of k points of n objects."""

    confidence: Floats  # (n, k)
    error: Floats  # (n, k) relative to the size of the object
    log_odds_terms: Floats  # (n, k, 5) of which the log odds are a sum, ordered as `Calibration`


class EvidenceRecorder(NumpyBackend):
    """Keeps the terms of the log odds (n, p, 5) of what it has lifted, a part for each call."""

    def __init__(self, constants: LifterConstants) -> None:
        """Take model and options."""
        super().__init__(constants)
        self.recorded: list[Floats] = []

    def keypoint_confidence(self, confidence: Float32, residual: Float32, S: Float32) -> Float32:
        """Return the confidence, and keep what it comes from."""
        visible = confidence > 0
        valid = log_odds_terms(visible, residual, self.relative_error_std(S))
        self.recorded.append(np.concatenate([valid, ~visible[..., None]], 2))
        return super().keypoint_confidence(confidence, residual, S)


class RecordingLifter(Lifter):
    """A lifter with default options that records the evidence of its confidence."""

    def __init__(self, model: Model) -> None:
        """Create the lifter of a model."""
        super().__init__(model)
        self.backend = self.recorder = EvidenceRecorder(self.constants)

    def take_evidence(self) -> Floats:
        """Return the terms that were kept since the last call."""
        recorded, self.recorder.recorded = np.concatenate(self.recorder.recorded), []
        return recorded


def benchmark(session: Session) -> Table:
    """Fit the calibration to the first subject; return its table on the others and on pose2sim."""
    fitted_to, *others = session.subjects
    folders = model_folders(default_models_dir())
    lifters = [RecordingLifter(load_model(find_model(name, folders))) for name in MODELS]
    fitted = fit([on_mocap(session, lifter, fitted_to, 0) for lifter in lifters])
    table = Table(
        "confidence_calibration",
        "Calibration of the confidence",
        ("model", "rated on", "confidence"),
        FIGURES,
        LEGEND
        | {
            f"fitted to subject {fitted_to}": _as_text(fitted),
            "shipped, and rated here": _as_text(CALIBRATED),
        },
        draw,
    )
    for lifter in lifters:
        for subject in others:
            _add(table, lifter, f"CMU {subject}", on_mocap(session, lifter, subject, 1))
    wheel = CACHE / WHEEL
    if wheel.exists():
        _add(table, lifters[0], "pose2sim", on_detections(lifters[0], wheel))
    else:
        print(f"no {wheel}, no rows of pose2sim; `make demo` downloads it")
    return table


def on_mocap(session: Session, lifter: RecordingLifter, subject: str, seed: int) -> Predictions:
    """Lift a subject's frames with random views, noise and gaps; compare with the truth."""
    layout, rng = lifter.model.layout, np.random.default_rng(seed)
    stride = session.stride if session.stride > 1 else STRIDE
    truth = read_split(
        TrialSelection(session.data / "cmu", [subject], "all", stride), layout
    ).shapes
    assert truth is not None
    T, points, confidence = project(truth, rng)
    return compare(lifter, points, confidence, T, np.arange(len(layout)))


def project(truth: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """Return shapes (n, p, 3) in the axes of random cameras, points and confidence (0 or 1)."""
    n, p, _ = truth.shape
    T = centre(truth @ rotation_from_camera(random_cameras(n, rng)).swapaxes(1, 2))
    T /= radius(T)[:, None, None]
    place = np.ones((n, 1, 3))
    place[:, 0, :2] = np.tan(np.radians(rng.uniform(-ASIDE, ASIDE, (n, 2)) / np.sqrt(2)))
    at = T + rng.uniform(*DISTANCE, (n, 1, 1)) * place / np.linalg.norm(place, axis=2)[..., None]
    W = at[..., :2] / at[..., 2:]
    noise = rng.choice(NOISE, n) * radius(centre(W))
    W += noise[:, None, None] * rng.standard_normal(W.shape) / np.sqrt(2)
    visible = rng.random((n, p)) >= rng.choice(HIDDEN, n)[:, None]
    return T, W.astype(np.float32), visible.astype(np.float32)


def on_detections(lifter: RecordingLifter, wheel: Path) -> Predictions:
    """Lift the real detections of the four pose2sim cameras and compare with the truth."""
    to_model = KeypointMap(BODY25B, lifter.model.layout)
    limbs = np.array([lifter.model.layout.index(joint) for joint in JOINTS])
    parts = []
    for view in read_session(wheel).views:
        valid = np.isfinite(view.truth).all((1, 2))
        points, confidence = to_model(view.points[valid], view.confidence[valid])
        parts.append(compare(lifter, points, confidence, view.truth[valid], limbs))
    return Predictions(*map(np.concatenate, zip(*parts, strict=True)))


def compare(
    lifter: RecordingLifter,
    points: Floats,
    confidence: Floats,
    truth: Floats,
    keypoints: NDArray[np.int64],
) -> Predictions:
    """Lift points (n, p, 2) and compare k of them with the truth (n, k, 3), in camera axes."""
    lifted = lift_all(lifter.lift, points, confidence)
    recorded = lifter.take_evidence()
    lifted_objects = ~np.isnan(lifted.residual)
    S, T = (
        centre(lifted.shapes[lifted_objects][:, keypoints].astype(float)),
        centre(truth[lifted_objects]),
    )
    scale = (S * T).sum((1, 2)) / (S * S).sum((1, 2))
    size = 2 * radius(lifted.shapes[lifted_objects]) * radius(T) / radius(S)
    error = np.linalg.norm(scale[:, None, None] * S - T, axis=2) / size[:, None]
    return Predictions(
        lifted.confidence[lifted_objects][:, keypoints],
        error,
        recorded[lifted_objects][:, keypoints],
    )


def fit(parts: Sequence[Predictions]) -> Calibration:
    """Return the calibration with the highest likelihood, by logistic regression.

    Points must have a confidence of 1 or 0.
    """
    X = np.concatenate([part.log_odds_terms.reshape(-1, 5) for part in parts]).astype(float)
    y = np.concatenate([part.error.ravel() < CORRECT_DISTANCE for part in parts])
    w, ridge = np.zeros(5), 1e-6 * len(X)
    for _ in range(_STEPS):
        chance = 1 / (1 + np.exp(-X @ w))
        curvature = (X * (chance * (1 - chance))[:, None]).T @ X + ridge * np.eye(5)
        w += np.linalg.solve(curvature, X.T @ (y - chance) - ridge * w)
    return Calibration(*w.tolist())


def reliability(confidence: Floats, error: Floats) -> Iterable[tuple[str, dict[str, float]]]:
    """Return the `FIGURES` of each bin of confidence (n, k), then over all."""
    correct, bin_index = (
        error < CORRECT_DISTANCE,
        np.clip((confidence * BINS).astype(int), 0, BINS - 1),
    )
    calibration_error = 0.0
    for i in range(BINS):
        inside = bin_index == i
        if inside.sum() < _FEWEST:
            continue
        figures = _means(inside.mean(), confidence[inside], correct[inside], error[inside])
        calibration_error += inside.mean() * abs(figures["confidence %"] - figures["near %"])
        yield f"{i / BINS:g} to {(i + 1) / BINS:g}", figures
    ranks = {
        "rank points": spearman(confidence.ravel(), error.ravel()),
        "rank objects": spearman(confidence.mean(1), error.mean(1)),
    }
    yield ALL, _means(1.0, confidence, correct, error) | {"off %": calibration_error} | ranks


def spearman(a: Floats, b: Floats) -> float:
    """Return Spearman's rank correlation of a (n,) and b (n,), ties in order of appearance."""
    rank_a, rank_b = (np.argsort(np.argsort(x, kind="stable")) for x in (a, b))
    return float(np.corrcoef(rank_a, rank_b)[0, 1])


def draw(table: Table, figure: Figure) -> None:
    """Plot the share of correct points and the mean error against the confidence."""
    figure.set_size_inches(9, 4.5)
    left, right = figure.subplots(1, 2)
    for labels in dict.fromkeys(row.labels[:2] for row in table.rows):
        rows = [r.figures for r in table.rows if r.labels[:2] == labels and r.labels[2] != ALL]
        x = [figures["confidence %"] for figures in rows]
        for axes, name in ((left, "near %"), (right, "error %")):
            axes.plot(x, [figures[name] for figures in rows], "o-", label=" on ".join(labels))
    left.plot([0, 100], [0, 100], color="0.7", linestyle="--", zorder=0)
    left.set(xlabel="confidence %", ylabel=f"within {CORRECT_DISTANCE:.0%} of the object's size, %")
    right.set(xlabel="confidence %", ylabel="mean error, % of the object's size", ylim=(0, None))
    right.set_xlim(left.get_xlim())
    left.legend(fontsize="small")


def _add(table: Table, lifter: RecordingLifter, test_data: str, predictions: Predictions) -> None:
    for label, figures in reliability(predictions.confidence, predictions.error):
        table.add((lifter.model.name, test_data, label), figures)


def _means(
    bin_index: float, confidence: Floats, correct: Floats, error: Floats
) -> dict[str, float]:
    values = (bin_index, confidence.mean(), correct.mean(), error.mean())
    return {name: 100 * float(v) for name, v in zip(FIGURES, values, strict=False)}


def radius(S: Floats) -> Floats:
    """Return the RMS radius (n,) of centred shapes (n, p, d)."""
    radius: Floats = np.sqrt((S * S).sum(2).mean(1))
    return radius


def _as_text(predictions: Calibration) -> str:
    return ", ".join(f"{name}={value:.2f}" for name, value in predictions._asdict().items())


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    run_program(benchmark, __doc__, SUBJECTS, argv)


if __name__ == "__main__":
    main()

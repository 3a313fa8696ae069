"""The report of a training: one HTML file, with all it needs inside."""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from deep_nrsfm_ros.data.curation import Curated, spread_out
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.sufficiency import Sufficiency
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, Model, ModelFileError, load_model
from deep_nrsfm_ros.reporting.drawing import bars, curve, scene, skeleton
from deep_nrsfm_ros.reporting.shapes import (
    LiftedFrames,
    label_free_errors,
    lift_sample,
    shape_space,
)
from deep_nrsfm_ros.reporting.template import embedded, render

if TYPE_CHECKING:
    from deep_nrsfm_ros.training.progress import Progress

REPORT_SUFFIX = ".html"

_OTHERS = 12  # models that are compared with
_FRAMES = 6  # best and worst frames that are shown
_APART = 0.005  # of the data, by which they are
_CURVES = {
    "loss": "reprojection error",
    "cycle_error": "cycle error",
    "coherence": "coherence of the final dictionary",
}
_QUALITY = ("combined", "reprojection_error", "cycle_error", "coherence")
_CAMERA_TO_SCREEN = np.array([1, -1, -1])  # x right, y down, z forward to x right, y up, z back


@dataclass(frozen=True)
class Training:
    """What there is to report.

    model: as it was saved at `path`. dataset: what it was trained on, of which `curated` tells
    where it comes from. progress: every report of the training, in order. warnings: whatever else
    its user should know.
    """

    model: Model
    path: Path
    dataset: Dataset
    curated: Curated
    sufficiency: Sufficiency
    progress: Sequence[Progress]
    warnings: Sequence[str] = ()


def write_report(training: Training, folders: Sequence[Path]) -> Path:
    """Write the report next to the model and return its path; whole or not at all.

    folders: where the models are that this one is compared with. Raises OSError, and ValueError
    when the model lifts none of the frames.
    """
    path = training.path.with_suffix(REPORT_SUFFIX)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        partial.write_text(page(training, folders), encoding="utf-8")
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return path


def page(training: Training, folders: Sequence[Path] = ()) -> str:
    """Return the report as HTML; names and other data are escaped."""
    model, dataset, sufficiency = training.model, training.dataset, training.sufficiency
    found = lift_sample(model, dataset)
    scenes: list[dict[str, Any]] = []
    shapes = _shapes(model, found, dataset.visible.sum(0) > 0, scenes)
    order = np.argsort(found.lifted.residual, kind="stable")
    gap = _APART * len(dataset)
    frames = {
        title: _frames(spread_out(ranking, found.frames, gap, _FRAMES), found, training, scenes)
        for title, ranking in (("Best", order), ("Worst", order[::-1]))
    }
    return render(
        "report.html.j2",
        ["report.css"],
        ["orbit.js", "viewer.js"],
        model=model,
        name=training.path.stem,
        path=shlex.quote(str(training.path.resolve())),
        warnings=[*training.warnings, *training.curated.warnings, *sufficiency.warnings],
        curves=[_curve(training.progress, field, label) for field, label in _CURVES.items()],
        comparison=_comparison(training, folders),
        shapes=shapes,
        frames=frames,
        looked_at=len(found.frames),
        residual=float(found.lifted.residual.mean()),
        sufficiency=sufficiency,
        spectrum=bars(sufficiency.spectrum[:12], "spectrum of the stacked keypoints, %"),
        curated=training.curated,
        hidden=sorted(
            (row for row in training.curated.hidden_by_keypoint if row[1]), key=lambda row: -row[1]
        ),
        suspects=[
            (suspect, skeleton(suspect.points, suspect.visible, model.layout, suspect.outliers))
            for suspect in training.curated.outlier_frames
        ],
        provenance=_rows(model.provenance),
        scenes=embedded(scenes),
    )


def _curve(progress: Sequence[Progress], field: str, label: str) -> Markup:
    """Return the chart of one figure over the steps, a line for each seed."""
    lines: dict[str, list[tuple[float, float]]] = {}
    for record in progress:
        lines.setdefault(f"seed {record.seed}", []).append((record.step, getattr(record, field)))
    return curve(lines, label)


def _comparison(training: Training, folders: Sequence[Path]) -> list[dict[str, Any]]:
    """Return a row of label-free figures for this model and the others that are there."""
    models = [training.model]
    seen = {training.path.resolve()}
    for file in (f for folder in folders for f in sorted(folder.glob(f"*{MODEL_SUFFIX}"))):
        if file.resolve() not in seen and len(models) <= _OTHERS:
            seen.add(file.resolve())
            try:
                models.append(load_model(file))
            except ModelFileError:
                continue  # somebody else's file; this report is not about it
    rows = []
    for model in models:
        here = None
        if model.layout.keypoints == training.dataset.layout.keypoints:
            with suppress(ValueError):  # it lifts none of these frames
                here = label_free_errors(model, training.dataset)
        quality = [model.quality.get(key) for key in _QUALITY]
        rows.append({"model": model, "quality": quality, "here": here})
    return rows


def _shapes(
    model: Model, found: LiftedFrames, visible: NDArray[np.bool_], scenes: list[dict[str, Any]]
) -> list[Any]:
    """Return (caption, index of the scene) of the mean shape and of each mode."""
    space = shape_space(model, found.lifted)
    shown: list[Any] = [("mean shape", len(scenes))]
    scenes.append(scene(space.mean, model.layout, visible, turn=30))
    for k, (mode, share) in enumerate(zip(space.modes, space.shares, strict=True), 1):
        shown.append((f"mode {k}: {100 * share:.0f} %", len(scenes)))
        scenes.append(scene(space.mean, model.layout, visible, mode, turn=30))
    return shown


def _frames(
    chosen: Sequence[int], found: LiftedFrames, training: Training, scenes: list[dict[str, Any]]
) -> list[Any]:
    """Return (frame, residual, detections, index of the lifted scene) of the chosen places."""
    shown = []
    dataset, layout = training.dataset, training.model.layout
    for k in chosen:
        frame = int(found.frames[k])
        visible = dataset.visible[frame]
        drawing = skeleton(dataset.points[frame], visible, layout)
        place = int(training.curated.frames[frame])
        shown.append((place, float(found.lifted.residual[k]), drawing, len(scenes)))
        lifted = found.lifted.shapes[k] * _CAMERA_TO_SCREEN
        scenes.append(scene(lifted, layout, visible, turn=60))
    return shown


def _rows(values: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Return nested values as (dotted name, text)."""
    if not isinstance(values, dict):
        return [(prefix, str(values))]
    return [
        row
        for key, value in values.items()
        for row in _rows(value, f"{prefix}.{key}" if prefix else str(key))
    ]

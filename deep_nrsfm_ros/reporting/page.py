# SPDX-License-Identifier: Apache-2.0
"""The report of a training: one self-contained HTML file."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from deep_nrsfm_ros.data.curation import Curated, spread_out
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.held_out import Split
from deep_nrsfm_ros.data.lifted_sample import LiftedFrames, lift_sample
from deep_nrsfm_ros.data.sufficiency import Sufficiency
from deep_nrsfm_ros.layouts.presets import HUMAN25
from deep_nrsfm_ros.model_files.matching_model import knows
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, Model, ModelFileError, load_model
from deep_nrsfm_ros.reporting.drawing import bars, curve, scene, skeleton
from deep_nrsfm_ros.reporting.shapes import shape_space
from deep_nrsfm_ros.reporting.template import embedded, render
from deep_nrsfm_ros.training.learned_frames import LEARNED_FRAMES

if TYPE_CHECKING:
    from deep_nrsfm_ros.training.judge import Standing
    from deep_nrsfm_ros.training.progress import Progress

REPORT_SUFFIX = ".html"

_OTHERS = 12  # other models in the comparison
_FRAMES = 6  # best frames, and worst frames
_SAME_ERROR = 1e-4  # rounding, of the error of the same weights
_MIN_GAP = 0.005  # between two of these frames, as a share of the data
_CURVES = {
    "loss": "image error",
    "cycle_error": "cycle error",
    "coherence": "coherence of the final dictionary",
}
_QUALITY = {
    "reprojection_error": "image error",
    "cycle_error": "cycle",
    "coherence": "coherence",
    "mirrored_share": "mirrored",
}
_FIGURES = (
    *("image_error", "bone_variation", "misfit"),
    *("mirrored_share", "front_disagreement", "opposed"),
)
_CAMERA_TO_SCREEN = np.array([1, -1, -1])  # x right, y down, z forward to x right, y up, z back


@dataclass(frozen=True)
class Training:
    """The content of a report.

    Attributes:
        model: the trained model.
        path: its file.
        dataset: the frames it was trained on.
        curated: what was dropped from the data.
        sufficiency: how much the data varies.
        progress: every progress report of the training, in order.
        warnings: further sentences for the user.
        detector_layout: value of `keypoint_layout` for the detector of the data; "" where its
            keypoints are those of the model.
        input_type: value of `input_type` for its messages, e.g. a field mapping; "" where it need
            not be set.
        held_out: the frames on which models are compared; None: those of the training.
        rival: the model at hand, with which they are compared; None: there is none.
    """

    model: Model
    path: Path
    dataset: Dataset
    curated: Curated
    sufficiency: Sufficiency
    progress: Sequence[Progress]
    warnings: Sequence[str] = ()
    detector_layout: str = ""
    input_type: str = ""
    held_out: Split | None = None
    rival: Model | None = None


def write_report(training: Training, folders: Sequence[Path]) -> Path:
    """Write the report next to the model, atomically, and return its path.

    Args:
        training: the content.
        folders: folders with the models to compare with; those of other keypoints are left out.

    Raises:
        OSError: the file cannot be written.
        ValueError: the model lifts none of the frames.
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
    """Return the report as HTML, see `write_report`; names and other data are escaped."""
    model, dataset, sufficiency = training.model, training.dataset, training.sufficiency
    lifted = lift_sample(model, dataset)
    scenes: list[dict[str, Any]] = []
    shapes = _shapes(model, lifted, dataset.visible.sum(0) > 0, scenes)
    order = np.argsort(lifted.lifted.residual, kind="stable")
    gap = _MIN_GAP * len(dataset)
    frames = {
        title: _frames(spread_out(ranking, lifted.frames, gap, _FRAMES), lifted, training, scenes)
        for title, ranking in (("Best", order), ("Worst", order[::-1]))
    }
    return render(
        "report.html.j2",
        ["report.css"],
        ["orbit.js", "viewer.js"],
        model=model,
        name=training.path.stem,
        start_share=_start_share(training),
        other_object=not knows(model.layout, HUMAN25),
        path=shlex.quote(str(training.path.resolve())),
        input_parameters=[
            (name, shlex.quote(value))
            for name, value in (
                ("keypoint_layout", training.detector_layout),
                ("input_type", training.input_type),
            )
            if value
        ],
        warnings=[*training.warnings, *training.curated.warnings, *sufficiency.warnings],
        curves=[_curve(training.progress, field, label) for field, label in _CURVES.items()],
        comparison=_comparison(training, folders),
        compared_frames=_compared_frames(training),
        held_out=training.held_out is not None,
        compared_kind="the training" if training.held_out is None else "this data",
        quality=[(title, model.quality.get(key)) for key, title in _QUALITY.items()],
        shapes=shapes,
        frames=frames,
        sample=len(lifted.frames),
        residual=float(lifted.lifted.residual.mean()),
        sufficiency=sufficiency,
        spectrum=bars(sufficiency.spectrum[:12], "spectrum of the stacked keypoints, %"),
        curated=training.curated,
        hidden=sorted(
            (row for row in training.curated.hidden_by_keypoint if row[1]), key=lambda row: -row[1]
        ),
        outliers=[
            (each, skeleton(each.points, each.visible, model.layout, each.outliers))
            for each in training.curated.outlier_frames
        ],
        provenance=_rows({k: v for k, v in model.provenance.items() if k != LEARNED_FRAMES}),
        scenes=embedded(scenes),
    )


def _start_share(training: Training) -> float:
    """Return the share of its start in a model's weights; 0 where it is not their mean."""
    said, combined = training.model.provenance, training.model.quality.get("combined")
    if "from" not in said or combined is None or not training.progress:
        return 0.0
    last = training.progress[-1]
    is_mean = abs(math.hypot(last.loss, last.cycle_error) - combined) > _SAME_ERROR
    return float(said["recipe"]["start_share"]) if is_mean else 0.0


def _curve(progress: Sequence[Progress], field: str, label: str) -> Markup:
    """Return the chart of a figure over the steps, with a line for each seed."""
    lines: dict[str, list[tuple[float, float]]] = {}
    for record in progress:
        lines.setdefault(f"seed {record.seed}", []).append((record.step, getattr(record, field)))
    return curve(lines, label)


def _split(training: Training) -> Split:
    """Return the frames on which models are compared."""
    return training.held_out or Split(training.dataset, training.dataset)


def _compared_frames(training: Training) -> int:
    """Return the number of frames on which models are compared."""
    from deep_nrsfm_ros.training.judge import comparable  # imports torch

    return len(comparable(_split(training), training.rival).frames.held_out)


def _comparison(training: Training, folders: Sequence[Path]) -> list[dict[str, Any]]:
    """Return a row for this model and each other one of its keypoints, the best first."""
    from deep_nrsfm_ros.training.judge import standings  # imports torch

    models, rival = [training.model], training.rival
    resolved = {training.path.resolve()}
    names = {training.model.name} | ({rival.name} if rival else set())
    for file in (f for folder in folders for f in sorted(folder.glob(f"*{MODEL_SUFFIX}"))):
        if file.resolve() not in resolved and len(models) <= _OTHERS:
            resolved.add(file.resolve())
            try:
                model = load_model(file)
            except ModelFileError:
                continue  # a damaged file of another model is no error of this report
            if model.name not in names and knows(model.layout, training.dataset.layout):
                models.append(model)
    return [
        {
            "name": standing.model.name,
            "is_this": standing.model is training.model,
            "verdict": _verdict(standing, training.model),
            "has_learned": standing.has_learned,
            "figures": [getattr(standing.figures, name) for name in _FIGURES],
        }
        for standing in standings(_split(training), models, rival)
    ]


def _verdict(standing: Standing, model: Model) -> str:
    """Return the verdict on a model; that on the one of the page is what its training said."""
    said = model.provenance.get("judgement", {}) if standing.model is model else {}
    return str(said.get("verdict", standing.verdict))


def _shapes(
    model: Model, sample: LiftedFrames, visible: NDArray[np.bool_], scenes: list[dict[str, Any]]
) -> list[Any]:
    """Return (caption, index of its scene) of mean shape and modes; append the scenes."""
    space = shape_space(model, sample.lifted)
    shown: list[Any] = [("mean shape", len(scenes))]
    scenes.append(scene(space.mean, model.layout, visible, yaw=30))
    for k, (mode, share) in enumerate(zip(space.modes, space.shares, strict=True), 1):
        shown.append((f"mode {k}: {100 * share:.0f} %", len(scenes)))
        scenes.append(scene(space.mean, model.layout, visible, mode, yaw=30))
    return shown


def _frames(
    chosen: Sequence[int], sample: LiftedFrames, training: Training, scenes: list[dict[str, Any]]
) -> list[Any]:
    """Return (frame, residual, drawing, index of its scene) of frames; append the scenes."""
    shown = []
    dataset, layout = training.dataset, training.model.layout
    for k in chosen:
        frame = int(sample.frames[k])
        visible = dataset.visible[frame]
        drawing = skeleton(dataset.points[frame], visible, layout)
        number = int(training.curated.frames[frame])  # before curation
        shown.append((number, float(sample.lifted.residual[k]), drawing, len(scenes)))
        lifted = sample.lifted.shapes[k] * _CAMERA_TO_SCREEN
        scenes.append(scene(lifted, layout, visible, yaw=60))
    return shown


def _rows(values: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Return nested values as pairs (dotted name, text)."""
    if not isinstance(values, dict):
        return [(prefix, str(values))]
    return [
        row
        for key, value in values.items()
        for row in _rows(value, f"{prefix}.{key}" if prefix else str(key))
    ]

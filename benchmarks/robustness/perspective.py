# SPDX-License-Identifier: Apache-2.0
"""People in front of a perspective camera, lifted without and with its intrinsics."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import Session, run_program
from benchmarks.table import Table, bars
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.mocap import TrialSelection, read_split
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifter, lift_all
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.lifting.perspective import lift_perspective
from deep_nrsfm_ros.model_files.folders import model_folders
from deep_nrsfm_ros.model_files.model_file import Model, find_model, load_model
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras, rotation_from_camera
from deep_nrsfm_ros.nrsfm.metrics import camera_errors

SUBJECTS = ("03", "131")
MODEL = "human"
CAMERA = Intrinsics((1700.0, 1700.0), (540.0, 960.0), (-0.05, 0.14, 0.0006, 0.0007))
"""Similar to the cameras of the pose2sim clip."""
DISTANCE = 3.5
SPREAD = np.array([0.25, 0.35])
"""Largest offset of people from the optical axis, relative to their distance."""
NOISE = 0.02
FIGURES = {
    "PA mm": "mean distance of the points after the best similarity with a proper rotation",
    "camera mm": "the same, after the best scale and translation only: in the camera's frame",
    "rotation deg": "between the two, median",
    "mirrored %": "frames that a reflection would fit better",
    "place mm": "mean distance of the centroids in the camera's frame, the reference length being "
    "the subject's own",
}
LEGEND = {
    "subject": f"of CMU, all trials, none used in training; random rotations and image positions, "
    f"{DISTANCE} m away, {NOISE:.0%} noise",
    "without": "as shipped, from pixels",
    "with": "as shipped, with the camera's intrinsics",
    **FIGURES,
}


class Scene(NamedTuple):
    """People in front of the camera.

    Attributes:
        shapes: (f, p, 3) metres in the camera's optical frame.
        pixels: (f, p, 2) keypoints with noise.
        reference_length: metres.
    """

    shapes: NDArray[np.float64]
    pixels: NDArray[np.float32]
    reference_length: float


def benchmark(session: Session) -> Table:
    """Return the table of errors of each subject without and with intrinsics."""
    drawn = bars("PA mm", "camera mm")
    table = Table("perspective", "Intrinsics", ("subject", "lifted"), tuple(FIGURES), LEGEND, drawn)
    model = load_model(find_model(MODEL, model_folders(Path("models"))))
    for subject in session.subjects:
        folder = session.data / "cmu"
        dataset = read_split(TrialSelection(folder, [subject], "all", session.stride), model.layout)
        for seed in session.seeds:
            scene = random_scene(dataset, seed)
            for word, intrinsics in {"without": None, "with": CAMERA}.items():
                table.add((subject, word), lifting_errors(model, scene, intrinsics), seed)
    return table


def random_scene(dataset: Dataset, seed: int) -> Scene:
    """Return the frames with random rotations at random places in front of the camera."""
    rng = np.random.default_rng(seed)
    shapes = centre(np.asarray(dataset.shapes, np.float64))
    pair = dataset.layout.reference
    assert pair, f"layout {dataset.layout.name!r} has no reference pair"
    a, b = (shapes[:, dataset.layout.index(name)] for name in pair)
    rotations = rotation_from_camera(random_cameras(len(shapes), rng)).astype(np.float64)
    places = np.ones((len(shapes), 1, 3))
    places[:, 0, :2] = rng.uniform(-SPREAD, SPREAD, (len(shapes), 2))
    placed = shapes @ rotations.swapaxes(1, 2) + DISTANCE * places
    pixels = CAMERA.pixels(placed[..., :2] / placed[..., 2:])
    size = np.sqrt((centre(pixels) ** 2).mean((1, 2), keepdims=True))
    pixels = pixels + NOISE * size * rng.standard_normal(pixels.shape)
    length = float(np.linalg.norm(a - b, axis=1).mean())
    return Scene(placed, pixels.astype(np.float32), length)


def lifting_errors(model: Model, scene: Scene, intrinsics: Intrinsics | None) -> dict[str, float]:
    """Return the `FIGURES` of lifting with the intrinsics, or without if None."""
    lifter = Lifter(model, LiftingOptions(reference_length=scene.reference_length))
    confidence = np.ones(scene.pixels.shape[:2], np.float32)
    if intrinsics is None:
        shapes: NDArray[Any] = lift_all(lifter.lift, scene.pixels, confidence).shapes
        places = {}
    else:
        parts = np.array_split(np.arange(len(confidence)), len(confidence) // 64 + 1)
        shapes = np.concatenate(
            [
                lift_perspective(lifter, intrinsics, scene.pixels[i], confidence[i]).shapes
                for i in parts
            ]
        )
        distances = np.linalg.norm(shapes.mean(1) - scene.shapes.mean(1), axis=1)
        places = {"place mm": 1000 * float(distances.mean())}
    errors = camera_errors(shapes, 1000 * scene.shapes)
    values = (errors.aligned, errors.in_camera, errors.rotation, 100 * errors.mirrored)
    return dict(zip(FIGURES, values, strict=False)) | places


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    run_program(benchmark, __doc__, SUBJECTS, argv)


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: Apache-2.0
"""Models of objects that are no people, from real 2D points: a mouse, a fly, chairs, birds, cars.

And of a synthetic excavator. One row of a table and one picture an object. Scenes are divided by
time: the model learns the first 80 % of the frames and is compared on the rest.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot
from numpy.typing import NDArray

from benchmarks.data import synthetic_excavator
from benchmarks.paper.table2_categories import read_chairs
from benchmarks.table import Table, bars, print_tables
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.layout_file import read_layout
from deep_nrsfm_ros.lifting.lifter import Lifter, lift_all
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, Model, load_model, save_model
from deep_nrsfm_ros.nrsfm.factorisation.consensus import image_scales
from deep_nrsfm_ros.nrsfm.factorisation.rigid import rigid_rotations, rigid_shape
from deep_nrsfm_ros.nrsfm.geometry import align, centre, random_cameras
from deep_nrsfm_ros.nrsfm.metrics import procrustes_distances, shape_errors
from deep_nrsfm_ros.nrsfm.recipe import PRESETS

Floats = NDArray[Any]

LAYOUTS = Path(__file__).parents[2] / "config/layouts"
TRAINING_SHARE = 0.8
CAMERAS = 5
"""Random cameras of each chair."""
EXCAVATOR_FRAMES = 6000, 1000
"""For training and for the test."""
COLUMNS = {
    "frames": "images that the model learned from; each view of a frame is one",
    "CPU minutes": "of the training",
    "PA %": "mean distance of a point after the best similarity transform, relative to the RMS "
    "radius of the object",
    "proper %": "error of the rescaled and rotated shape relative to the norm of the truth; one "
    "reflection for all frames is allowed",
    "mirrored %": "frames that a reflection would fit better than the majority",
    "rigid PA %": "PA of the rigid shape that factorisation finds in the learned images, in every "
    "frame: what is to be had without deformation and without truth",
    "true mean PA %": "PA of the mean of the test's true shapes: low where an object hardly "
    "deforms, but nobody who sees images alone has it",
    "image error %": "what one pass of the network leaves of the image; the only figure without "
    "truth",
}
_REFLECTIONS = [1, 1, 1], [1, 1, -1]
_LEGEND = COLUMNS | {
    "mouse": "DANNCE, six cameras; truth by DANNCE's network from all of them",
    "fly": "EKS example, three cameras, detections with their noise; truth triangulated",
    "excavator": "synthetic, one camera that moves around it; tested on other work",
    "chairs": "KeypointNet, real shapes, random cameras; every fifth chair is kept back",
    "birds, cars": "photographs with annotated points, CUB-200-2011 and VeRi-776; no truth",
}


@dataclasses.dataclass(frozen=True)
class Object:
    """What is learned of an object, and what it is compared with.

    Attributes:
        training: frames to learn from.
        test: frames of the comparison; `shapes` are the truth in the camera's axes, or None.
    """

    training: Dataset
    test: Dataset


def mouse(folder: Path) -> Object:
    """Return the mouse of six cameras."""
    return _scene(folder / "mouse_dannce" / "mouse_dannce_predicted.npz", "mouse22", stride=3)


def fly(folder: Path) -> Object:
    """Return the fly of three cameras."""
    return _scene(folder / "fly_eks" / "fly_eks.npz", "fly12")


def excavator(folder: Path) -> Object:
    """Return a synthetic excavator at work, and at other work."""
    del folder
    layout = _layout("excavator")
    parts = []
    for seed, frames in enumerate(EXCAVATOR_FRAMES):
        record = synthetic_excavator.record(frames, seed)
        parts.append(_dataset(record.points, layout, "synthetic excavator", record.truth))
    return Object(*parts)


def chairs(folder: Path) -> Object:
    """Return chairs before random cameras; every fifth one is for the test."""
    shapes = centre(read_chairs(folder / "chairs_keypointnet" / "chairs_keypointnet_dev.npz"))
    rng, layout = np.random.default_rng(0), _layout("chair10")
    kept = np.arange(len(shapes)) % 5 == 4
    parts = []
    for chosen in (shapes[~kept], shapes[kept]):
        S = np.repeat(chosen, CAMERAS, 0)
        R = random_cameras(len(S), rng)
        M = np.concatenate((R, np.cross(R[..., 0], R[..., 1])[..., None]), 2)
        seen = S @ M
        parts.append(_dataset(seen[..., :2], layout, "KeypointNet chairs", seen))
    return Object(*parts)


def birds(folder: Path) -> Object:
    """Return photographs of birds; every tenth one is for the test."""
    return _photographs(folder / "birds_cub" / "birds_cub.npz", "bird15")


def cars(folder: Path) -> Object:
    """Return photographs of cars; every tenth one is for the test."""
    return _photographs(folder / "cars_veri" / "cars_veri.npz", "car20")


OBJECTS: dict[str, Callable[[Path], Object]] = {
    function.__name__: function for function in (mouse, fly, excavator, chairs, birds, cars)
}


def _layout(name: str) -> KeypointLayout:
    return read_layout(LAYOUTS / f"{name}.yaml")


def _dataset(
    points: Floats, layout: KeypointLayout, source: str, shapes: Floats | None = None
) -> Dataset:
    """Return points (f, p, 2), NaN where missing, as a dataset."""
    visible = np.asarray(np.isfinite(points).all(2), bool)
    kept = visible.sum(1) >= 4
    points = np.where(visible[..., None], points, 0).astype(np.float32)[kept]
    truth = None if shapes is None else shapes[kept].astype(np.float32)
    return Dataset(points, visible[kept], layout, source, truth)


def _scene(path: Path, layout: str, stride: int = 1) -> Object:
    """Return the views of every `stride`-th frame, the first 80 % of the time to learn from."""
    scene = np.load(path)
    truth = np.einsum("vij,fpj->fvpi", scene["R"], scene["truth"][:, 0].astype(float))
    points, first = scene["points"][:, :, 0], round(TRAINING_SHARE * len(scene["points"]))
    parts = []
    for rows in (slice(None, first, stride), slice(first, None)):
        flat = [x[rows].reshape(-1, *x.shape[2:]) for x in (points, centre_scene(truth))]
        parts.append(_dataset(flat[0], _layout(layout), path.stem, flat[1]))
    return Object(*parts)


def centre_scene(truth: Floats) -> Floats:
    """Return shapes (f, v, p, 3), each centred."""
    centred: Floats = truth - truth.mean(2, keepdims=True)
    return centred


def _photographs(path: Path, layout: str) -> Object:
    points = np.load(path)["points"]
    kept = np.arange(len(points)) % 10 == 9
    return Object(*(_dataset(points[k], _layout(layout), path.stem) for k in (~kept, kept)))


def trained(thing: Object, name: str, path: Path, steps: int) -> tuple[Model, float]:
    """Return the model of an object and the CPU minutes of its training, kept in a file."""
    from deep_nrsfm_ros.training.finish import finish
    from deep_nrsfm_ros.training.loop import train

    if path.exists():
        model = load_model(path)
        return model, float(model.provenance["cpu_minutes"])
    began, default = time.process_time(), PRESETS["default"]
    recipe = dataclasses.replace(default.recipe, steps=steps)
    training = thing.training
    trainer = train(training.points, training.visible, default._replace(recipe=recipe))
    model = finish(trainer, name, training.layout, training.source)
    model.provenance["cpu_minutes"] = round((time.process_time() - began) / 60, 2)
    save_model(path, model)
    return model, float(model.provenance["cpu_minutes"])


def figures(thing: Object, S: Floats, residual: Floats) -> dict[str, float]:
    """Return the errors of shapes S (f, p, 3) of the test, as far as there is truth."""
    shown = {"image error %": 100 * float(np.nanmean(residual))}
    truth = thing.test.shapes
    if truth is None:
        return shown
    errors = shape_errors(S, truth)
    rigid = np.broadcast_to(rigid_factorised(thing.training), truth.shape)
    return shown | {
        "PA %": relative_distance(_majority(S, truth), truth),
        "proper %": 100 * errors.proper,
        "mirrored %": 100 * errors.mirrored,
        "rigid PA %": min(relative_distance(rigid * mirror, truth) for mirror in _REFLECTIONS),
        "true mean PA %": relative_distance(rigid_mean(truth), truth),
    }


def _majority(S: Floats, truth: Floats) -> Floats:
    """Return the shapes, all reflected if that fits most of them better."""
    mirrored = align(centre(S), centre(truth), allow_reflection=True).mirrored.mean()
    return S * [1, 1, -1] if mirrored > 0.5 else S


def relative_distance(S: Floats, truth: Floats) -> float:
    """Return the mean distance after a similarity transform, in % of the RMS radius."""
    radius = np.sqrt((centre(truth) ** 2).sum(2).mean(1))
    return float(100 * (procrustes_distances(S, truth).mean(1) / radius).mean())


def rigid_factorised(training: Dataset) -> Floats:
    """Return the rigid shape (p, 3), up to a reflection, of the complete images, without truth."""
    W = centre(training.points[training.visible.all(1)].astype(float))
    W = W / image_scales(W)[:, None, None]
    return rigid_shape(W, rigid_rotations(W))


def rigid_mean(truth: Floats) -> Floats:
    """Return the mean of the shapes, aligned to each other, once a frame."""
    unit = centre(truth) / np.linalg.norm(centre(truth), axis=(1, 2), keepdims=True)
    mean = unit[0]
    for _ in range(3):
        mean = align(unit, np.broadcast_to(mean, unit.shape)).aligned.mean(0)
    return np.broadcast_to(mean, unit.shape)


def draw(thing: Object, S: Floats, path: Path) -> None:
    """Draw keypoints of four test frames, and their shapes from the camera and from the side."""
    test, figure = thing.test, pyplot.figure(figsize=(10, 7.5), layout="constrained")
    rows = np.linspace(0, len(S) - 1, 6).astype(int)[1:5]
    pairs, axes = test.layout.edge_indices(), figure.subplots(3, 4)
    for column, row in enumerate(rows):
        visible = test.visible[row]
        views = (test.points[row], S[row, :, :2], S[row][:, [2, 1]])
        for axis, X, title in zip(
            axes[:, column], views, ("keypoints", "lifted: camera", "lifted: side"), strict=True
        ):
            drawn = [p for p in pairs if title != "keypoints" or visible[list(p)].all()]
            for a, b in drawn:
                axis.plot(*X[[a, b]].T, color="0.5", linewidth=1)
            shown = X[visible] if title == "keypoints" else X
            axis.scatter(
                *shown.T,
                s=10,
                c=np.arange(len(X))[visible] if len(shown) < len(X) else np.arange(len(X)),
                cmap="viridis",
            )
            axis.set_aspect("equal")
            axis.invert_yaxis()
            axis.set_xticks([])
            axis.set_yticks([])
            axis.set_title(title, fontsize="small")
    figure.savefig(path, dpi=70)
    pyplot.close(figure)


def benchmark(data: Path, output: Path, names: Sequence[str], steps: int) -> Table:
    """Train on each object, draw it, and return the table."""
    table = Table(
        "zoo",
        "Objects that are no people",
        ("object",),
        tuple(COLUMNS),
        _LEGEND,
        bars("PA %", "rigid PA %"),
    )
    output.mkdir(parents=True, exist_ok=True)
    for name in names:
        thing = OBJECTS[name](data)
        model, minutes = trained(thing, name, output / f"zoo_{name}{MODEL_SUFFIX}", steps)
        lifter = Lifter(model, LiftingOptions())
        lifted = lift_all(lifter.lift, thing.test.points, thing.test.visible.astype(np.float32))
        S = np.nan_to_num(lifted.shapes)
        row = {"frames": float(len(thing.training)), "CPU minutes": minutes}
        table.add((name,), row | figures(thing, S, lifted.residual))
        draw(thing, S, output / f"zoo_{name}.png")
        print(f"{name}: {table.rows[-1].figures}", file=sys.stderr, flush=True)
    return table


def main(argv: Sequence[str] | None = None) -> None:
    """Run the benchmark; trained models are kept in the output folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of the scenes")
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks"))
    parser.add_argument("--objects", nargs="+", default=list(OBJECTS), choices=OBJECTS)
    parser.add_argument("--steps", type=int, default=2000)
    args = parser.parse_args(argv)
    print_tables(lambda: [benchmark(args.data, args.output, args.objects, args.steps)], args.output)


if __name__ == "__main__":
    main()

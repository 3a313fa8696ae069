"""What a model makes of the frames it was trained on: mean shape, modes, best and worst."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter, lift_all
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.geometry import (
    align,
    centre,
    random_cameras,
    rotation_from_camera,
)
from deep_nrsfm_ros.nrsfm.handedness import disagreement
from deep_nrsfm_ros.nrsfm.network import forward
from deep_nrsfm_ros.nrsfm.normalisation import normalise

Floats = NDArray[np.float64]

_SAMPLE = 500  # frames that are lifted
_ROUNDS = 3  # of alignment to the mean


class ShapeSpace(NamedTuple):
    """A mean shape (p, 3), unit RMS radius, and its principal deformations.

    modes: (m, p, 3), each one standard deviation. shares: (m,) of the variance.
    Axes as on a screen: x right, y up, z towards the viewer, who stands before the object.
    """

    mean: Floats
    modes: Floats
    shares: Floats


class LiftedFrames(NamedTuple):
    """Frames (n,) of a dataset as a model lifts them, the ones that cannot be lifted left out."""

    frames: NDArray[np.int64]
    lifted: Lifted


class LabelFreeErrors(NamedTuple):
    """Label-free errors of a model on given frames, means; relative to the size of the object.

    cycle: of the shape, as training measures it: the network alone on its own shapes, seen by
    random cameras. turned: the same of shape and camera together, by the lifter.
    """

    reprojection: float
    cycle: float
    turned: float


def lift_sample(model: Model, dataset: Dataset, most: int = _SAMPLE) -> LiftedFrames:
    """Lift up to `most` frames, evenly spread; raise ValueError if none can be lifted."""
    frames = np.unique(np.linspace(0, len(dataset) - 1, min(most, len(dataset))).astype(int))
    chosen = dataset[frames]
    lifted = lift_all(Lifter(model).lift, chosen.points, chosen.visible.astype(np.float32))
    sound = np.isfinite(lifted.shapes).all((1, 2)) & np.isfinite(lifted.residual)
    if not sound.any():
        raise ValueError(f"model {model.name!r} lifts none of the {len(frames)} frames looked at")
    return LiftedFrames(frames[sound], Lifted(*(array[sound] for array in lifted)))


def handedness_warning(model: Model, dataset: Dataset) -> str:
    """Return what the lifted frames say against the model's depth, "" if nothing.

    See `handedness.disagreement`; only keypoints that were seen count.
    """
    try:
        frames, lifted = lift_sample(model, dataset)
    except ValueError:
        return ""  # no frame is lifted: there is no depth to handedness_warning
    return disagreement(lifted.shapes, model.layout, dataset.visible[frames])


def shape_space(model: Model, lifted: Lifted, modes: int = 4) -> ShapeSpace:
    """Return the mean and the first modes of lifted shapes, aligned by proper rotations alone."""
    S = centre(lifted.shapes.astype(np.float64) @ lifted.rotations)  # camera's axes to object's
    S /= np.maximum(np.sqrt((S * S).sum(2).mean(1)), 1e-9)[:, None, None]
    # Of shapes from a network that failed the mean may vanish; one of them never does.
    mean = S[int(np.argmin(lifted.residual))]
    for _ in range(_ROUNDS):
        S = align(S, np.broadcast_to(mean, S.shape)).aligned
        mean = S.mean(0)
    mean = align(mean, (lifted.shapes @ lifted.rotations).mean(0)).aligned
    S = align(S, np.broadcast_to(mean, S.shape)).aligned @ _to_screen(model, mean)
    mean = S.mean(0)
    _, values, axes = np.linalg.svd((S - mean).reshape(len(S), -1), full_matrices=False)
    variances = values**2 / max(len(S) - 1, 1)
    m = min(modes, len(values))
    deviations = np.sqrt(variances[:m])[:, None] * axes[:m]
    return ShapeSpace(
        mean,
        deviations.reshape(m, *mean.shape),
        variances[:m] / max(float(variances.sum()), 1e-12),
    )


def _to_screen(model: Model, mean: Floats) -> Floats:
    """Return the rotation (3, 3), applied on the right, from object axes to those of a screen.

    An object without a known front stands upright along its longest extent.
    """
    if model.layout.handedness:
        return np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # x front, y left, z up
    axes = np.linalg.eigh(mean.T @ mean)[1]  # shortest first
    turn: Floats = axes[:, [1, 2, 0]]
    turn[:, 2] *= np.sign(np.linalg.det(turn))
    return turn


def label_free_errors(model: Model, dataset: Dataset, most: int = 128) -> LabelFreeErrors:
    """Return how well a model explains up to `most` frames of its own layout.

    Raises ValueError if it lifts none of them.
    """
    frames, found = lift_sample(model, dataset, most)
    T = centre(found.shapes) @ _turns(len(frames))
    views, confidence = T[..., :2].astype(np.float32), np.ones(T.shape[:2], np.float32)
    again = lift_all(Lifter(model).lift, views, confidence)
    sound = np.isfinite(again.scale)
    after = again.shapes[sound] * again.scale[sound, None, None]
    return LabelFreeErrors(
        float(found.residual.mean()),
        cycle_error(model, dataset[frames]),
        _difference(after, T[sound]),
    )


def cycle_error(model: Model, dataset: Dataset) -> float:
    """Return the mean of ||S' - S|| / ||S||: S' is the network's shape of S seen from elsewhere."""
    mask = dataset.visible[..., None].astype(np.float32)
    seen = normalise(model.network, model.normaliser, dataset.points, mask)
    S, M = forward(model.network, seen.W * seen.gain)
    residual = (seen.W - S @ M) * mask
    residual -= mask * residual.sum(1, keepdims=True) / np.maximum(mask.sum(1, keepdims=True), 1)
    S = centre(S + residual @ M.swapaxes(1, 2))
    again = model.normaliser.encode(S @ _turns(len(S))[..., :2], np.ones_like(mask))
    S_again, _ = forward(model.network, again.W)
    return _difference(centre(S_again), S / again.unit)


def _turns(n: int) -> NDArray[np.float32]:
    """Return n rotations (n, 3, 3), always the same."""
    M = random_cameras(n, np.random.default_rng(0))
    return rotation_from_camera(M).swapaxes(1, 2)


def _difference(S: NDArray[Any], T: NDArray[Any]) -> float:
    """Return the mean of ||S - T|| / ||T|| over frames (f, p, 3)."""
    size = np.maximum(np.linalg.norm(T, axis=(1, 2)), 1e-12)
    return float((np.linalg.norm(S - T, axis=(1, 2)) / size).mean()) if len(T) else float("nan")

"""A model on its training frames: mean shape, modes of deformation, errors without labels."""

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
    centre_visible,
    random_cameras,
    rotation_from_camera,
)
from deep_nrsfm_ros.nrsfm.handedness import disagreement
from deep_nrsfm_ros.nrsfm.network import forward
from deep_nrsfm_ros.nrsfm.normalisation import normalise

Floats = NDArray[np.float64]

_SAMPLE = 500  # frames that are lifted
_ROUNDS = 3  # rounds of alignment to the mean shape


class ShapeSpace(NamedTuple):
    """The mean shape and the principal deformations, in screen axes.

    The axes are x right, y up, z to a viewer in front of the object. The mean has RMS radius 1.

    Attributes:
        mean: (p, 3).
        modes: (m, p, 3) one standard deviation of each principal component.
        shares: (m,) shares of the variance, descending.
    """

    mean: Floats
    modes: Floats
    shares: Floats


class LiftedFrames(NamedTuple):
    """The n frames of a sample that a model lifts.

    Attributes:
        frames: (n,) indices into the dataset.
        lifted: n objects.
    """

    frames: NDArray[np.int64]
    lifted: Lifted


class LabelFreeErrors(NamedTuple):
    """Mean errors of a model that need no labels, relative to the size of the object; 0 = perfect.

    Attributes:
        reprojection: of the network, before correction; 0.05 typical.
        cycle: difference between a lifted shape and the shape that the network lifts from a random
            view of it, as training measures it.
        lifter_cycle: the same by the whole lifter, including the rotation of the camera.
    """

    reprojection: float
    cycle: float
    lifter_cycle: float


def lift_sample(model: Model, dataset: Dataset, most: int = _SAMPLE) -> LiftedFrames:
    """Return up to `most` evenly spread frames of a dataset, lifted.

    Raises:
        ValueError: the model lifts none of them.
    """
    frames = np.unique(np.linspace(0, len(dataset) - 1, min(most, len(dataset))).astype(int))
    chosen = dataset[frames]
    lifted = lift_all(Lifter(model).lift, chosen.points, chosen.visible.astype(np.float32))
    sound = np.isfinite(lifted.shapes).all((1, 2)) & np.isfinite(lifted.residual)
    if not sound.any():
        raise ValueError(f"model {model.name!r} lifts none of the {len(frames)} frames looked at")
    return LiftedFrames(frames[sound], Lifted(*(array[sound] for array in lifted)))


def handedness_warning(model: Model, dataset: Dataset) -> str:
    """Return a warning if keypoints of lifted frames disagree on the depth, "" if they agree.

    See `nrsfm.handedness.disagreement`.
    """
    try:
        frames, lifted = lift_sample(model, dataset)
    except ValueError:
        return ""  # no frame is lifted: without a lifted frame there is no depth
    return disagreement(lifted.shapes, model.layout, dataset.visible[frames])


def shape_space(model: Model, lifted: Lifted, modes: int = 4) -> ShapeSpace:
    """Return the mean and the principal components of lifted shapes.

    Shapes are centred, scaled to RMS radius 1 and aligned by rotations without reflection.

    Args:
        model: its layout determines the screen axes.
        lifted: n objects.
        modes: number of components at most.
    """
    S = centre(lifted.shapes.astype(np.float64) @ lifted.rotations)  # in the object's axes
    S /= np.maximum(np.sqrt((S * S).sum(2).mean(1)), 1e-9)[:, None, None]
    # Start from a single shape: the mean of a failed network's shapes may be zero.
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
    """Return the rotation (3, 3), applied on the right, from object axes to screen axes.

    An object without a handedness is upright along its longest extent.
    """
    if model.layout.handedness:
        return np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # x front, y left, z up
    axes = np.linalg.eigh(mean.T @ mean)[1]  # shortest first
    rotation: Floats = axes[:, [1, 2, 0]]
    rotation[:, 2] *= np.sign(np.linalg.det(rotation))
    return rotation


def label_free_errors(model: Model, dataset: Dataset, most: int = 128) -> LabelFreeErrors:
    """Return the errors of a model on up to `most` frames of its own layout.

    Raises:
        ValueError: the model lifts none of them.
    """
    frames, lifted = lift_sample(model, dataset, most)
    T = centre(lifted.shapes) @ _fixed_rotations(len(frames))
    views, confidence = T[..., :2].astype(np.float32), np.ones(T.shape[:2], np.float32)
    again = lift_all(Lifter(model).lift, views, confidence)
    sound = np.isfinite(again.scale)
    lifted_again = again.shapes[sound] * again.scale[sound, None, None]
    return LabelFreeErrors(
        float(lifted.residual.mean()),
        cycle_error(model, dataset[frames]),
        _difference(lifted_again, T[sound]),
    )


def cycle_error(model: Model, dataset: Dataset) -> float:
    """Return the mean of ||S' - S|| / ||S||, S' being the network's shape of a random view of S."""
    mask = dataset.visible[..., None].astype(np.float32)
    W, gain, _, _ = normalise(model.network, model.normaliser, dataset.points, mask)
    S, M = forward(model.network, W * gain)
    S = centre(S + centre_visible(W - S @ M, mask) @ M.swapaxes(1, 2))
    again = model.normaliser.encode(S @ _fixed_rotations(len(S))[..., :2], np.ones_like(mask))
    S_again, _ = forward(model.network, again.W)
    return _difference(centre(S_again), S / again.unit)


def _fixed_rotations(n: int) -> NDArray[np.float32]:
    """Return n random rotations (n, 3, 3), the same in each call."""
    M = random_cameras(n, np.random.default_rng(0))
    return rotation_from_camera(M).swapaxes(1, 2)


def _difference(S: NDArray[Any], T: NDArray[Any]) -> float:
    """Return the mean of ||S - T|| / ||T|| over frames (f, p, 3)."""
    size = np.maximum(np.linalg.norm(T, axis=(1, 2)), 1e-12)
    return float((np.linalg.norm(S - T, axis=(1, 2)) / size).mean()) if len(T) else float("nan")

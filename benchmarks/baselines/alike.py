# SPDX-License-Identifier: Apache-2.0
"""Factorisation of frames that look alike, which needs neither labels nor their order.

Two orthographic images of one rigid shape, stacked, are a matrix (4, p) of rank three. Frames of
one subject in which this nearly holds are like views of one pose. The block-matrix method on such
frames is a baseline of its own: in the paper's protocol each frame of a 120 Hz motion has a random
camera, so that neighbours in time are nearly several views of one pose.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.nrsfm.factorisation.block_matrix import block_matrix

Floats = NDArray[Any]


def dissimilarity(image: Floats, others: Floats) -> Floats:
    """Return the smallest singular value squared (f,) of each pair of images as a matrix (4, p).

    0 if the two images can be views of one rigid shape.

    Args:
        image: (p, 2) centred.
        others: (f, p, 2) centred.
    """
    A, B = (_of_unit_size(W).swapaxes(-1, -2) for W in (image, others))
    gram = np.empty((len(B), 4, 4))
    gram[:, :2, :2], gram[:, 2:, 2:] = A @ A.T, B @ B.swapaxes(1, 2)
    gram[:, 2:, :2] = B @ A.T
    gram[:, :2, 2:] = gram[:, 2:, :2].swapaxes(1, 2)
    smallest: Floats = np.linalg.eigvalsh(gram)[:, 0]
    return smallest


def _of_unit_size(W: Floats) -> Floats:
    """Return images (..., p, 2) divided by their norms."""
    unit: Floats = W / np.maximum(np.linalg.norm(W, axis=(-2, -1), keepdims=True), 1e-12)
    return unit.astype(np.float64)


def nearest(W: Floats, frames: Floats, count: int) -> NDArray[np.int64]:
    """Return the indices (n, count) of the `frames` (f, p, 2) most like each image W (n, p, 2).

    An image that is one of the frames is not its own neighbour.
    """
    found = np.empty((len(W), min(count, len(frames) - 1)), np.int64)
    for i, image in enumerate(W):
        distance = dissimilarity(image, frames)
        distance[(frames == image).all((1, 2))] = np.inf
        found[i] = np.argsort(distance)[: found.shape[1]]
    return found


def block_matrix_of_neighbours(
    W: Floats, frames: Floats, *, neighbours: int, K: int, weighted: bool = False
) -> Floats:
    """Return the shape (n, p, 3) of each image, solved together with the frames most like it.

    Each is a problem of its own, with an object frame and a reflection of its own.

    Args:
        W: (n, p, 2) images.
        frames: (f, p, 2) to look for neighbours in.
        neighbours: number of neighbours.
        K: rank of the block-matrix method.
        weighted: with the weighted nuclear norm.
    """
    found = nearest(W, frames, neighbours)
    batches = [
        np.concatenate([image[None], frames[of]]) for image, of in zip(W, found, strict=True)
    ]
    return np.stack([block_matrix(batch, K, weighted=weighted)[0] for batch in batches])

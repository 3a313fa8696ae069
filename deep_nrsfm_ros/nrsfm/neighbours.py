# SPDX-License-Identifier: Apache-2.0
"""Which frames are lifted with a mirrored depth, found without labels.

1. `nearest`: two images W_a = S M_a and W_b = S M_b of one shape S span planes that share a
   direction, whatever the cameras are. So the neighbours of a frame, images of nearly the same
   shape, are found without its shape.
2. `rigid_shapes`: a frame and its neighbours are images of one nearly rigid shape. Factorisation
   gives that shape, up to its mirror image.
3. `join`: the shapes of neighbouring frames must be alike, which tells whether one of the two has
   to be mirrored. Over the graph of all pairs the shapes come to one handedness, in few parts.
4. `mirrored_frames`: a network's shape of a frame is compared with the rigid shape. Frames that
   vote against the majority of their part are mirrored.

Steps 1 to 3 need no network: they are computed once for all seeds of a training.

Source: Tomasi and Kanade (1992) for the factorisation; the rest is ours.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.batched import Progress, no_progress, slices
from deep_nrsfm_ros.nrsfm.geometry import centre

Floats = NDArray[Any]

SAME_VIEW = 0.95
"""Cosine of the second angle between two planes from which both frames are one view: no depth."""

_ROWS = 256  # of the search at a time: 90 MB for 15000 frames
_TINY = 1e-12
_RIGID = 0.02  # distance of a neighbour at which its weight in the factorisation is 1 / e
_MISFIT = 0.1  # residual of a factorisation at which the weight of its shape is 1 / e
_FLAT = 0.1  # least over largest eigenvalue of the metric below which a shape counts less
_NEAR = 0.06  # distance of a pair at which its weight is 1 / e
_STRICT = 0.08  # distance of two shapes of norm 1 at which the weight of a certain pair is 1 / e
_LOOSE = 0.3  # the same where parts are joined by many pairs together
_MIN_PAIR = 0.02  # weight from which a pair joins two frames by itself
_MIN_JOINT = 0.5  # sum of the weights from which pairs join two parts
_MOST_PARTS = 4000  # that are joined by many pairs: their table takes 130 MB


class Neighbours(NamedTuple):
    """The k nearest neighbours of each of n frames, the nearest first.

    Attributes:
        frames: (n, k) indices of frames.
        distances: (n, k) 1 - the largest cosine between the planes of both images: 0 = both can be
            images of one shape, 0.01 typical, 0.1 far. Infinite where a frame has fewer than k
            others that are not the same view of it.
    """

    frames: NDArray[np.int64]
    distances: NDArray[np.float32]


def nearest(W: Floats, k: int, on_progress: Progress = no_progress) -> Neighbours:
    """Return the k nearest neighbours of each frame that are not the same view of it.

    All pairs are compared: 0.5 s for 4000 frames of 31 keypoints on one core, 6 s for 15000.

    Args:
        W: (n, p, 2) centred, completed and whitened keypoints.
        k: neighbours of each frame, 16 typical; at most n - 1 are returned.
        on_progress: called with the frames done and n.
    """
    n = len(W)
    k = min(k, max(n - 1, 0))
    result = Neighbours(np.zeros((n, k), np.int64), np.zeros((n, k), np.float32))
    if not k:
        return result
    Q = _orthonormal(W)
    for rows in slices(n, _ROWS):
        cosine, second = _cosines(Q[:, rows], Q)
        cosine[second > SAME_VIEW] = -np.inf
        cosine[np.arange(len(cosine)), np.arange(rows.start, rows.stop)] = -np.inf
        best = np.argpartition(-cosine, k - 1, 1)[:, :k]
        distances = 1 - np.take_along_axis(cosine, best, 1)
        order = np.argsort(distances, 1, kind="stable")
        result.frames[rows] = np.take_along_axis(best, order, 1)
        result.distances[rows] = np.take_along_axis(distances, order, 1)
        on_progress(rows.stop, n)
    return result


def _orthonormal(W: Floats) -> NDArray[np.float32]:
    """Return an orthonormal basis (2, n, p) of the plane of the columns of each W (n, p, 2)."""
    W = W.astype(np.float64)
    values, axes = np.linalg.eigh(W.swapaxes(1, 2) @ W)
    axes /= np.sqrt(np.maximum(values, _TINY))[:, None]
    return np.ascontiguousarray((W @ axes).transpose(2, 0, 1), np.float32)


def _cosines(
    P: NDArray[np.float32], Q: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return both singular values (m, n) of the 2 x 2 products of planes P (2, m, p), Q (2, n, p).

    They are the cosines of the two angles between the planes, the larger one first.
    """
    (a, b), (c, d) = [[u @ v.T for v in Q] for u in P]
    determinant = np.abs(a * d - b * c)
    squares = a * a
    for entry in (b, c, d):
        squares += entry * entry
    root = np.sqrt(np.maximum(squares * squares - 4 * determinant * determinant, 0))
    largest = np.sqrt(np.minimum((squares + root) / 2, 1))
    return largest, determinant / np.maximum(largest, _TINY)


class RigidShapes(NamedTuple):
    """A shape for each of n frames, from its own image and those of its neighbours.

    Attributes:
        shapes: (n, p, 3) centred, of norm 1, in any axes and either handedness.
        weights: (n,) from 0, no shape, to 1, an exact one.
    """

    shapes: Floats
    weights: Floats


def rigid_shapes(W: Floats, pairs: Neighbours) -> RigidShapes:
    """Return the rigid shape of each frame and its neighbours, by weighted factorisation.

    The images of a frame and its k neighbours, stacked to 2 (k + 1) rows, are a motion times a
    shape. The metric makes both rows of each camera orthogonal and equally long, so that each image
    has a scale of its own.

    Args:
        W: (n, p, 2) centred and completed keypoints, in any unit, not whitened.
        pairs: neighbours of the n frames.
    """
    n, p, _ = W.shape
    result = RigidShapes(np.zeros((n, p, 3)), np.zeros(n))
    if pairs.frames.shape[1] < 2:  # two images have a shape for every angle between them
        return result
    for rows in slices(n, 1024):
        members = np.concatenate([np.arange(n)[rows, None], pairs.frames[rows]], 1)
        near = np.exp(-((pairs.distances[rows] / _RIGID) ** 2)) + 1e-6
        weights = np.concatenate([np.ones((len(near), 1)), near], 1)[..., None, None]
        X, result.weights[rows] = _factorise(W[members].swapaxes(2, 3), weights)
        result.shapes[rows] = _unit(centre(X))
    return result


def _factorise(W: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return shapes (m, p, 3) and their weights (m,) of images W (m, v, 2, p) of v views each.

    Args:
        W: centred images.
        weights: (m, v, 1, 1) of the views.
    """
    m, v, _, p = W.shape
    W = W / np.maximum(np.linalg.norm(W, axis=(2, 3), keepdims=True), _TINY)
    A = (W * weights).reshape(m, 2 * v, p).astype(np.float64)
    values, vectors = np.linalg.eigh(A @ A.swapaxes(1, 2))
    U = vectors[..., -3:]
    residual = np.sqrt(np.maximum(values[:, :-3], 0).sum(1) / np.maximum(values.sum(1), _TINY))
    motion = U.reshape(m, v, 2, 3) / weights
    a, b = motion[:, :, 0], motion[:, :, 1]
    length = np.maximum((a * a).sum(-1) + (b * b).sum(-1), _TINY)[..., None]
    equations = np.concatenate([2 * _quadratic(a, b), _quadratic(a, a) - _quadratic(b, b)], 2)
    equations = (equations / length * weights[..., 0]).reshape(m, v, 2, 6).reshape(m, 2 * v, 6)
    _, solutions = np.linalg.eigh(equations.swapaxes(1, 2) @ equations)
    Q = solutions[:, _METRIC, 0]
    Q = Q * np.sign(np.trace(Q, axis1=1, axis2=2))[:, None, None]
    values, axes = np.linalg.eigh(Q)
    root = axes / np.sqrt(np.maximum(values, 1e-9))[:, None]
    X = (A.swapaxes(1, 2) @ U) @ root
    sound = np.clip(values[:, 0] / np.maximum(values[:, 2], _TINY) / _FLAT, 0, 1)
    return X, sound * np.exp(-((residual / _MISFIT) ** 2))


_METRIC = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])  # entries of the symmetric Q in its vector


def _quadratic(x: Floats, y: Floats) -> Floats:
    """Return the coefficients (..., 6) of x^T Q y in the entries of a symmetric Q (3, 3)."""
    products = x[..., :, None] * y[..., None, :]
    diagonal = [products[..., i, i] for i in range(3)]
    others = [products[..., i, j] + products[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2))]
    return np.stack(diagonal + others, -1)


class Reference(NamedTuple):
    """A shape for each of n frames, of one handedness within each part.

    Attributes:
        shapes: (n, p, 3) centred, of norm 1, in any axes.
        parts: (n,) part of each frame; frames without a weight are parts of their own.
        weights: (n,) of `RigidShapes`.
    """

    shapes: Floats
    parts: NDArray[np.int64]
    weights: Floats


def join(rigid: RigidShapes, pairs: Neighbours) -> Reference:
    """Return the rigid shapes mirrored to one handedness, as far as pairs of neighbours tell it.

    First each part of frames is joined to the part with which it shares the most certain pair
    (Boruvka's spanning forest). Then parts are joined by the sum of all pairs between them, the
    largest sum first.

    Args:
        rigid: shapes of the n frames.
        pairs: neighbours of the n frames.
    """
    strict, loose = (np.zeros(pairs.frames.shape) for _ in range(2))
    for rows in slices(len(rigid.shapes), 1024):
        others = pairs.frames[rows]
        proper, improper = distances(rigid.shapes[rows, None], rigid.shapes[others])
        weight = _contrast(proper, improper) * np.exp(-((pairs.distances[rows] / _NEAR) ** 2))
        weight *= rigid.weights[rows, None] * rigid.weights[others]
        misfit = np.minimum(proper, improper)
        strict[rows] = weight * np.exp(-((misfit / _STRICT) ** 2))
        loose[rows] = weight * np.exp(-((misfit / _LOOSE) ** 2))
    certain = _edges(strict, pairs)
    forest = _spanning_forest(len(rigid.shapes), certain.of(np.abs(certain.weight) > _MIN_PAIR))
    signs, parts = _join_parts(forest, _edges(loose, pairs))
    mirror = np.where(signs[:, None, None] < 0, np.array([1, 1, -1]), 1)
    return Reference(rigid.shapes * mirror, parts, rigid.weights)


def distances(X: Floats, Y: Floats) -> tuple[Floats, Floats]:
    """Return the distances (...) after the best rotation, and after the best reflection.

    Args:
        X: (..., p, 3) centred shapes of norm 1.
        Y: (..., p, 3) the same.
    """
    C = X.swapaxes(-1, -2) @ Y
    values = np.linalg.svd(C, compute_uv=False)
    common, last = values[..., 0] + values[..., 1], values[..., 2]
    last = np.where(np.linalg.det(C) < 0, -last, last)
    proper, improper = (np.sqrt(np.maximum(2 - 2 * (common + s * last), 0)) for s in (1, -1))
    return proper, improper


def _contrast(proper: Floats, improper: Floats) -> Floats:
    """Return 1 where shapes agree exactly, -1 where they are mirror images, 0 for undecided."""
    contrast: Floats = (improper - proper) / np.maximum(improper + proper, _TINY)
    return contrast


class _Edges(NamedTuple):
    """Edges of a graph: both ends (e,) and the signed weight (e,) of each."""

    a: NDArray[np.int64]
    b: NDArray[np.int64]
    weight: Floats

    def of(self, chosen: NDArray[Any]) -> _Edges:
        """Return the chosen edges."""
        return _Edges(*(array[chosen] for array in self))


def _edges(weights: Floats, pairs: Neighbours) -> _Edges:
    """Return the pairs with a weight (n, k) as edges."""
    a, column = np.nonzero(weights)
    return _Edges(a, pairs.frames[a, column], weights[a, column])


class _Forest(NamedTuple):
    """Trees of frames.

    Attributes:
        signs: (n,) sign of each frame in its tree, 1 or -1.
        trees: (n,) tree of each frame, named after one of its frames.
    """

    signs: Floats
    trees: NDArray[np.int64]


def _spanning_forest(n: int, edges: _Edges) -> _Forest:
    """Return the forest of the largest absolute weights, with signs carried along its edges."""
    forest = _Forest(np.ones(n), np.arange(n))
    edges = edges.of(np.argsort(-np.abs(edges.weight), kind="stable"))
    while (apart := forest.trees[edges.a] != forest.trees[edges.b]).any():
        edges = edges.of(apart)
        forest = _round(forest, edges)
    return forest


def _round(forest: _Forest, edges: _Edges) -> _Forest:
    """Return the forest with each tree joined to another by its first edge (Boruvka)."""
    n, count = len(forest.trees), len(edges.a)
    a, b = forest.trees[edges.a], forest.trees[edges.b]
    first = np.full(n, count)
    for end in (a, b):
        np.minimum.at(first, end, np.arange(count))
    roots = np.flatnonzero(first < count)
    best = first[roots]
    parent, relative = np.arange(n), np.ones(n)
    parent[roots] = np.where(a[best] == roots, b[best], a[best])
    ends = forest.signs[edges.a[best]] * forest.signs[edges.b[best]]
    relative[roots] = ends * np.sign(edges.weight[best])
    # Two trees that choose each other would be each other's parent.
    mutual = np.flatnonzero((parent[parent] == np.arange(n)) & (np.arange(n) < parent))
    parent[mutual], relative[mutual] = mutual, 1
    while (parent[parent] != parent).any():
        parent, relative = parent[parent], relative * relative[parent]
    return _Forest(forest.signs * relative[forest.trees], parent[forest.trees])


def _join_parts(forest: _Forest, edges: _Edges) -> _Forest:
    """Return the forest with its largest trees joined by the sums of the edges between them."""
    names, part = np.unique(forest.trees, return_inverse=True)
    largest = np.argsort(-np.bincount(part), kind="stable")[:_MOST_PARTS]
    place = np.full(len(names), -1)
    place[largest] = np.arange(len(largest))
    a, b = place[part[edges.a]], place[part[edges.b]]
    inside = (a >= 0) & (b >= 0) & (a != b)
    weight = (edges.weight * forest.signs[edges.a] * forest.signs[edges.b])[inside]
    sums = np.zeros((len(largest), len(largest)))
    np.add.at(sums, (a[inside], b[inside]), weight)
    sums += sums.T
    sign, top = np.ones(len(largest)), np.arange(len(largest))
    best = np.abs(sums).argmax(1) if len(sums) else largest  # of each part
    strength = np.abs(sums).max(1, initial=0)
    while strength.max(initial=0) >= _MIN_JOINT:
        i = int(strength.argmax())
        j = int(best[i])
        turned = np.sign(sums[i, j])
        members = top == j
        sign[members] *= turned
        top[members] = i
        sums[i] += turned * sums[j]
        sums[j] = 0
        sums[i, [i, j]] = 0
        sums[:, i], sums[:, j] = sums[i], 0
        stale = np.flatnonzero((best == i) | (best == j) | (sums[i] != 0))
        stale = np.union1d(stale, [i, j])
        best[stale] = np.abs(sums[stale]).argmax(1)
        strength[stale] = np.abs(sums[stale]).max(1)
    names_of, signs_of = names.copy(), np.ones(len(names))
    names_of[largest], signs_of[largest] = names[largest][top], sign
    return _Forest(forest.signs * signs_of[part], names_of[part])


class MirrorTest(NamedTuple):
    """Which frames of a model are mirrored.

    Attributes:
        mirrored: (n,) frames whose depth is mirrored against the majority of their part.
        tested: (n,) frames that the reference tells something about.
        handedness: (n,) 1 where the model's majority has the handedness of the reference shape, -1
            where it has that of its mirror image.
    """

    mirrored: NDArray[np.bool_]
    tested: NDArray[np.bool_]
    handedness: Floats

    @property
    def share(self) -> float:
        """Return the share of the tested frames that are mirrored, 0 to 0.5; 0 without any."""
        return float(self.mirrored[self.tested].mean()) if self.tested.any() else 0.0


def mirrored_frames(X: Floats, visible: NDArray[np.bool_], reference: Reference) -> MirrorTest:
    """Return which lifted shapes are mirrored against the majority of their part.

    Args:
        X: (n, p, 3) lifted shapes of the frames of the reference, in any axes and unit.
        visible: (n, p) visible keypoints; only those are compared.
        reference: of the same frames.
    """
    n = len(X)
    mask = visible[..., None]
    votes = _contrast(*distances(_masked(X, mask), _masked(reference.shapes, mask)))
    votes *= reference.weights
    majority = np.sign(np.bincount(reference.parts, votes, n))
    majority[majority == 0] = 1
    handedness = majority[reference.parts]
    alone = np.bincount(reference.parts, minlength=n) < 2
    tested = (reference.weights > 0) & ~alone[reference.parts]
    return MirrorTest(tested & (votes * handedness < 0), tested, handedness)


def _masked(X: Floats, mask: NDArray[np.bool_]) -> Floats:
    """Return X (..., p, 3) centred over the mask (..., p, 1), 0 elsewhere, of norm 1."""
    count = np.maximum(mask.sum(-2, keepdims=True), 1)
    return _unit((X - (X * mask).sum(-2, keepdims=True) / count) * mask)


def _unit(X: Floats) -> Floats:
    """Return shapes (..., p, 3) scaled to norm 1; a point stays one."""
    unit: Floats = X / np.maximum(np.linalg.norm(X, axis=(-2, -1), keepdims=True), _TINY)
    return unit

# SPDX-License-Identifier: Apache-2.0
"""New shapes of known ones: limbs are exchanged between shapes and turned at the joints.

A limb is what hangs on one side of an edge of the layout. As known shapes of the cycle loss the
new ones teach a network that limbs move apart from each other, which the poses of its training
frames may not show. They need no 3D label, since they are made of the network's own shapes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.nrsfm.geometry import Floats, align, centre, rotation_from_vector
from deep_nrsfm_ros.nrsfm.network import Network
from deep_nrsfm_ros.nrsfm.recipe import AUTOMATIC, Recipe

_LIMBS = 3  # of each shape that are exchanged and turned, one after the other
_ANGLE = 0.35  # standard deviation of a limb's rotation vector, per axis, in radians
_LENGTHS = 0.1  # standard deviation of the logarithm of each edge's length
_REACH = 1.5  # edges between the joint and a keypoint that has the weight 1 / e in the alignment
_TINY = 1e-9


class LimbExchange:
    """The limbs of a layout, and shapes recombined of them.

    Attributes:
        limbs: (e, p) bool, the keypoints on the smaller side of each edge that divides the layout.
        joints: (e,) the end of each of these edges on its other side.
    """

    def __init__(self, layout: KeypointLayout) -> None:
        """Find the limbs.

        An edge divides the layout where no other way leads from one of its ends to the other: an
        upper arm does, an edge of the palm does not.

        Raises:
            ValueError: no edge divides the layout.
        """
        edges, p = layout.edge_indices(), len(layout)
        limbs, joints, ends = [], [], []
        for i, (a, b) in enumerate(edges):
            others = [*edges[:i], *edges[i + 1 :]]
            side_a, side_b = (np.isfinite(_distances(others, end, p)) for end in (a, b))
            if side_a[b]:
                continue
            if side_b.sum() > side_a.sum():
                a, b, side_b = b, a, side_a
            limbs.append(side_b)
            joints.append(a)
            ends.append(b)
        if not limbs:
            raise ValueError(
                f"layout {layout.name!r} has no limbs: none of its {len(edges)} edges divides it"
            )
        self.limbs: NDArray[np.bool_] = np.array(limbs)
        self.joints: NDArray[np.intp] = np.array(joints)
        distance = np.array([_distances(edges, joint, p) for joint in joints])
        self._weights = (np.exp(-distance / _REACH) * ~self.limbs)[..., None]
        self._ends = np.array(ends)

    @classmethod
    def of(cls, layout: KeypointLayout) -> LimbExchange | None:
        """Return the limbs of a layout; None if it has none."""
        try:
            return cls(layout)
        except ValueError:
            return None

    def recombine(self, S: Floats, count: int, rng: np.random.Generator) -> Floats:
        """Return shapes that are recombined of the first `count` and of limbs of all.

        A shape takes over the limb of another one, which is scaled to its size and aligned with
        what surrounds the joint. The limb is turned about the joint, and in the end each edge gets
        another length.

        Args:
            S: (b, p, 3) shapes in common axes.
            count: 0 to b.
            rng: source of all random numbers.

        Returns:
            (count, p, 3) centred.
        """
        X, size = S[:count], self._size(S)
        for _ in range(_LIMBS):
            edge, other = (
                rng.integers(len(self.limbs), size=count),
                rng.integers(len(S), size=count),
            )
            Y = S[other] * (size[:count] / np.maximum(size[other], _TINY))
            weights = self._weights[edge]
            weights = weights / weights.sum(1, keepdims=True)
            near_X, near_Y = ((weights * Z).sum(1, keepdims=True) for Z in (X, Y))
            Q = align(weights * (Y - near_Y), X - near_X).rotation
            R = rotation_from_vector(_ANGLE * rng.standard_normal((count, 3)))
            joint = self.joints[edge][:, None, None]
            at_X, at_Y = (np.take_along_axis(Z, joint, 1) for Z in (X, Y))
            X = np.where(self.limbs[edge][..., None], at_X + (Y - at_Y) @ (Q @ R), X)
        longer = np.exp(_LENGTHS * rng.standard_normal((count, len(self.limbs), 1))) - 1
        return centre(X + self.limbs.T @ (longer * self._edges(X)))

    def _edges(self, S: Floats) -> Floats:
        """Return the vectors (b, e, 3) of shapes S (b, p, 3) from each joint to its limb."""
        vectors: Floats = S[:, self._ends] - S[:, self.joints]
        return vectors

    def _size(self, S: Floats) -> Floats:
        """Return the total length (b, 1, 1) of the edges of shapes S (b, p, 3)."""
        total: Floats = np.linalg.norm(self._edges(S), axis=2).sum(1)[:, None, None]
        return total


def _distances(edges: Sequence[tuple[int, int]], start: int, p: int) -> NDArray[np.float64]:
    """Return the number of edges (p,) from a keypoint to each other, inf without a path."""
    distance, found, steps = np.full(p, np.inf), {start}, 0
    while found:
        distance[list(found)] = steps
        steps += 1
        near = {b for edge in edges for a, b in (edge, edge[::-1]) if a in found}
        found = {keypoint for keypoint in near if np.isinf(distance[keypoint])}
    return distance


def with_limb_exchange(
    recipe: Recipe, start: Network | None, limb_exchange: LimbExchange | None
) -> Recipe:
    """Return the recipe with the share of shapes with exchanged limbs in place of `AUTOMATIC`.

    Frames of a training that starts from a model are often of one person or of few motions, from
    which the network would learn that limbs move together.

    Args:
        recipe: whose `limb_exchange` may be `AUTOMATIC`.
        start: the network that the training starts from; None: random weights.
        limb_exchange: the limbs of the layout; None: it has none.

    Raises:
        ValueError: the recipe exchanges limbs, and the layout has none; or the share is no share.
    """
    share = recipe.limb_exchange
    check_limb_exchange(share)
    if share == AUTOMATIC:
        share = float(start is not None and limb_exchange is not None)
    if share and limb_exchange is None:
        raise ValueError(
            f"limb_exchange is {share:g}, but there are no limbs to exchange: no edge of the "
            "layout divides it"
        )
    return dataclasses.replace(recipe, limb_exchange=share)


def check_limb_exchange(share: float, name: str = "limb_exchange") -> None:
    """Raise ValueError unless a share is `AUTOMATIC` or from 0 to 1.

    Args:
        share: `Recipe.limb_exchange`.
        name: of the option, for the message.
    """
    if share != AUTOMATIC and not 0 <= share <= 1:
        raise ValueError(f"{name} is {share:g}; it must be {AUTOMATIC} or from 0 to 1")

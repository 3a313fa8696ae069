# SPDX-License-Identifier: Apache-2.0
"""Frames and angles of the joints of lifted objects in closed form, and forward kinematics.

Joints of one kind are computed together, for all objects at once, as soon as their parents' frames
are there. Their kinds:

- free: the frame follows the directions of the joint; three angles or none lead to it.
- aimed: two angles take the first direction to the measured one.
- hinge: one angle takes it to the plane of the measured one.
- fixed: the frame of the parent.

Source: ours, not in the paper. Names, axes and signs of a person's angles are those of REP-155.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros import kernel
from deep_nrsfm_ros.layouts.joints import MAX_ANGLES, WORDS, Joint, direction_vector
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.nrsfm.geometry import quaternion, rotation_from_vector

Floats = NDArray[Any]

FREE, AIMED, HINGE, FIXED = "free", "aimed", "hinge", "fixed"
STRAIGHT = np.sin(np.radians(10.0))
"""Sine of the angle between the first two directions of a frame below which others count more."""
_PARENT = 0.25
"""Weight of the parent's frame for the twist, relative to that of further directions."""
_SMALL = 1e-9
_TINIEST = 1e-300
_GIMBAL = 1e-6  # sine or cosine of the second angle below which the first and third are locked
_FAR = np.radians(120.0)
"""First angle beyond which the other solution for three angles is taken."""
_ORDER = (FREE, HINGE, AIMED)  # as in kernel/joints.h, which also has the next one
_MAX_OTHERS = 3
_UNTURNED = np.eye(3).reshape(1, 1, 3, 3)
_NEXT, _LAST = [1, 2, 0], [2, 0, 1]
_NO_TWIST = np.array([1.0, 0.0])


class Pose(NamedTuple):
    """The pose of n objects.

    Attributes:
        origins: (n, j, 3) origins of the joints' frames, in the axes and unit of the points.
        rotations: (n, j, 3, 3) from each frame to the axes of the points.
        angles: (n, a) in radians, in the order of `KinematicTree.angle_names`.
    """

    origins: Floats
    rotations: Floats
    angles: Floats


class _Group(NamedTuple):
    """k joints that are computed together.

    Attributes:
        kind: how.
        proper: whether the third angle's axis is that of the first.
        joints: (k,) indices.
        parents: (k,) indices of the frames that they turn in; -1 for the root.
        angles: (k, m) columns of their angles; of aimed joints, of the last two.
        leads: (k,) column of the first of three angles of an aimed joint, which is 0 where it is
            measured; else -1.
        to_axes: (k, 3, 3) orthonormal matrix Q from canonical axes to those of the angles.
        signs: (k, 3) of the angles in canonical axes.
        first: (k, 3) the first direction d, as a unit vector in the frame.
        pairs: (k,) rows of the directions' pairs.
        others: (k, s, 3) further directions, across the first.
        other_pairs: (k, s) rows of their pairs.
        weights: (k, s) of further directions for the twist; 0: there is none.
        basis: (k, 3, 3) columns d, the first of `others`, and their cross product.
        parent_weight: of the parent's frame for the twist.
        max_twist: (k,) radians.
        elevation: (k,) radians of d above the plane across the first of two angles' axes.
    """

    kind: str
    proper: bool
    joints: NDArray[np.intp]
    parents: NDArray[np.intp]
    angles: NDArray[np.intp]
    leads: NDArray[np.intp]
    to_axes: Floats
    signs: Floats
    first: Floats
    pairs: NDArray[np.intp]
    others: Floats
    other_pairs: NDArray[np.intp]
    weights: Floats
    basis: Floats
    parent_weight: float
    max_twist: Floats
    elevation: Floats


class KinematicTree:
    """The kinematic tree of a layout.

    Attributes:
        joints: of the layout, parents first.
        names: j names of joints.
        parents: j indices of parents; -1 for the root.
        angle_names: a names of angles.
        angle_joints: a indices of the joints that they belong to.
        angle_axes: (a, 3) axes in the frame before the rotation.
    """

    def __init__(self, layout: KeypointLayout) -> None:
        """Prepare the tree of a layout.

        Raises:
            ValueError: the layout names no joints.
        """
        if not layout.joints:
            raise ValueError(f"layout {layout.name!r} names no joints; a layout file can name them")
        self.joints = layout.joints
        self.names = tuple(joint.name for joint in self.joints)
        self.parents = tuple(
            self.names.index(joint.parent) if joint.parent else -1 for joint in self.joints
        )
        angles = [(i, *angle) for i, joint in enumerate(self.joints) for angle in joint.angles]
        self.angle_names = tuple(name for _, name, _ in angles)
        self.angle_joints = tuple(i for i, _, _ in angles)
        self.angle_axes = np.array([WORDS[word] for *_, word in angles], float).reshape(-1, 3)
        weights = np.zeros((len(self.joints), len(layout)))
        for row, joint in zip(weights, self.joints, strict=True):
            row[[layout.index(name) for name in joint.at]] = 1 / len(joint.at)
        pairs: list[Floats] = []

        def row_of(ends: Sequence[str]) -> int:
            """Return the row of a pair in `pairs`, which it is added to."""
            point = [
                np.eye(len(layout))[layout.index(end)]
                if end in layout.keypoints
                else weights[self.names.index(end)]
                for end in ends
            ]
            pairs.append(point[1] - point[0])
            return len(pairs) - 1

        kinds = [_kind(joint) for joint in self.joints]
        self._frames = self._frame_owners([kind for kind, _ in kinds])
        self._groups = [
            self._group(*kinds[members[0]], members, row_of) for members in self._schedule(kinds)
        ]
        self._weights = np.concatenate([weights, np.reshape(pairs, (-1, len(layout)))])
        self._compiled = _compiled_groups(self._groups) if kernel.AVAILABLE else None
        self._along, self._first = self._bones()

    def __len__(self) -> int:
        """Return the number of joints."""
        return len(self.joints)

    def _frame_owners(self, kinds: Sequence[str]) -> NDArray[np.intp]:
        """Return for each joint (j,) the one whose frame it has: its own, or an ancestor's."""
        owners: list[int] = []
        for i, (kind, parent) in enumerate(zip(kinds, self.parents, strict=True)):
            owners.append(owners[parent] if kind == FIXED else i)
        return np.array(owners)

    def _schedule(self, kinds: Sequence[tuple[str, bool]]) -> list[list[int]]:
        """Return the joints with frames of their own in groups of one kind, parents first."""
        left = [i for i, (kind, _) in enumerate(kinds) if kind != FIXED]
        done: set[int] = set()
        groups = []
        while left:
            ready = [
                i for i in left if self.parents[i] < 0 or self._frames[self.parents[i]] in done
            ]
            first = min((_ORDER.index(kinds[i][0]), kinds[i][1]) for i in ready)
            group = [i for i in ready if (_ORDER.index(kinds[i][0]), kinds[i][1]) == first]
            groups.append(group)
            done |= set(group)
            left = [i for i in left if i not in done]
        return groups

    def _bones(self) -> tuple[NDArray[np.bool_], Floats]:
        """Return which joints (j,) end the bone that their parent's first direction follows.

        And that direction (j, 3) in the parent's frame.
        """
        along, first = np.zeros(len(self), bool), np.zeros((len(self), 3))
        for i, (joint, parent) in enumerate(zip(self.joints, self.parents, strict=True)):
            if parent < 0 or not self.joints[parent].directions:
                continue
            direction, pair = self.joints[parent].directions[0]
            along[i] = self.joints[parent].at == (pair[0],) and joint.at == (pair[1],)
            first[i] = direction_vector(direction)
        return along, first

    def _group(
        self, kind: str, proper: bool, members: list[int], row_of: Callable[[Sequence[str]], int]
    ) -> _Group:
        """Return the group of joints of one kind; `row_of` gives the row of a pair."""
        k, joints = len(members), [self.joints[i] for i in members]
        most = max(len(joint.directions) for joint in joints) if kind == FREE else 0
        first, others = np.zeros((k, 3)), np.zeros((k, max(most - 1, 1), 3))
        pairs, other_pairs = np.zeros(k, int), np.zeros(others.shape[:2], int)
        weights, elevation = np.zeros(others.shape[:2]), np.zeros(k)
        signs, to_axes = np.ones((k, 3)), np.tile(np.eye(3), (k, 1, 1))
        columns = [[a for a, i in enumerate(self.angle_joints) if i == each] for each in members]
        for row, joint in enumerate(joints):
            first[row] = direction_vector(joint.directions[0][0])
            pairs[row] = row_of(joint.directions[0][1])
            others[row, 0] = _across(first[row])
            for s, (direction, pair) in enumerate(joint.directions[1:] if kind == FREE else ()):
                others[row, s] = _across(first[row], direction_vector(direction))
                other_pairs[row, s] = row_of(pair)
                weights[row, s] = STRAIGHT**2 if s else 1.0
            if joint.angles:
                axes = self.angle_axes[columns[row]]
                axes = axes[-2:] if kind == AIMED else axes
                to_axes[row], signs[row] = _canonical_axes(kind, axes, first[row])
                elevation[row] = np.arcsin(np.clip(axes[0] @ first[row], -1, 1))
        basis = np.stack([first, others[:, 0], np.cross(first, others[:, 0])], -1)
        parents = [self.parents[i] for i in members]
        is_root = parents[0] < 0
        return _Group(
            kind,
            proper,
            np.array(members),
            np.array(parents if is_root else self._frames[parents]),
            np.array([c[-2:] if kind == AIMED else c for c in columns], int).reshape(k, -1),
            np.array([c[0] if kind == AIMED and len(c) == MAX_ANGLES else -1 for c in columns]),
            to_axes,
            signs,
            first,
            pairs,
            others,
            other_pairs,
            weights,
            basis,
            0.0 if is_root else _PARENT * float(STRAIGHT) ** 2,
            np.radians([joint.max_twist for joint in joints]),
            elevation,
        )

    def __call__(self, points: Floats) -> Pose:
        """Return the pose of n objects.

        Objects with NaN have NaN. Where a direction has no length, its frame follows the parent's.

        Args:
            points: (n, p, 3) in the layout's order, in right-handed axes.
        """
        n, j = len(points), len(self)
        vectors = self._weights @ points.astype(np.float64)
        origins, directions = vectors[:, :j], vectors[:, j:]
        rotations = np.empty((n, j, 3, 3))
        angles = np.zeros((n, len(self.angle_names)))
        if self._compiled and n:
            measured = np.ascontiguousarray(directions)
            kernel._kernel.joint_frames(*self._compiled, measured, rotations, angles, (n, j))
        else:
            self._fill(directions, rotations, angles)
        return Pose(origins, rotations[:, self._frames], angles)

    def _fill(self, directions: Floats, rotations: Floats, angles: Floats) -> None:
        """Fill frames (n, j, 3, 3) and angles (n, a), as the kernel does: for reading and tests."""
        for group in self._groups:
            parents = _UNTURNED if group.parents[0] < 0 else rotations[:, group.parents]
            v = directions[:, group.pairs]
            if group.kind == FREE:
                R, theta = _free(group, parents, v, directions[:, group.other_pairs])
            else:
                theta = (_hinge if group.kind == HINGE else _aimed)(group, parents, v)
                R = parents @ _rotation(group, theta)
            rotations[:, group.joints] = R
            if theta.size:
                angles[:, group.angles] = theta

    def offsets(self, pose: Pose) -> Floats:
        """Return the origin (n, j, 3) of each joint in its parent's frame; 0 for the root.

        A joint at the end of a bone lies on the line of the bone's direction, at the bone's length.
        """
        parents = list(self.parents)
        step = pose.origins - pose.origins[:, parents]
        step[:, 0] = 0
        local = (step[..., None, :] @ pose.rotations[:, parents])[..., 0, :]
        length = np.linalg.norm(local, axis=-1, keepdims=True)
        return np.where(self._along[:, None], self._first * length, local)

    def forward(self, origin: Floats, rotation: Floats, angles: Floats, offsets: Floats) -> Pose:
        """Return the pose of n objects from their angles: forward kinematics.

        Args:
            origin: (n, 3) of the root.
            rotation: (n, 3, 3) of the root's frame.
            angles: (n, a) radians.
            offsets: (n, j, 3) or (j, 3) as `offsets` returns them.
        """
        n = len(angles)
        offsets = np.broadcast_to(offsets, (n, len(self), 3))
        origins = np.empty((n, len(self), 3))
        rotations: Floats = np.empty((n, len(self), 3, 3))
        for group in self._groups:
            if group.parents[0] < 0:
                rotations[:, 0] = rotation
                continue
            parents, theta = rotations[:, group.parents], angles[:, group.angles]
            if (group.leads >= 0).any():
                lead = np.where(group.leads >= 0, angles[:, group.leads], 0.0)
                parents = parents @ rotation_from_vector(
                    self.angle_axes[group.leads] * lead[..., None]
                )
            rotations[:, group.joints] = parents @ _rotation(group, theta)
        rotations = rotations[:, self._frames]
        origins[:, 0] = origin
        for i, parent in enumerate(self.parents[1:], 1):
            step = (rotations[:, parent] @ offsets[:, i, :, None])[..., 0]
            origins[:, i] = origins[:, parent] + step
        return Pose(origins, rotations, angles)


def _compiled_groups(groups: Sequence[_Group]) -> tuple[NDArray[np.int32], Floats] | None:
    """Return indices (k, 12) and constants (k, 39) as the kernel takes them; None: too many."""
    indices, constants = [], []
    for group in groups:
        k, s = group.weights.shape
        if s > _MAX_OTHERS:
            return None
        others, weights = np.zeros((k, _MAX_OTHERS, 3)), np.zeros((k, _MAX_OTHERS))
        others[:, :s], weights[:, :s] = group.others, group.weights
        for i in range(k):
            pairs, angles = np.zeros(_MAX_OTHERS, int), np.full(MAX_ANGLES, -1)
            pairs[:s] = group.other_pairs[i]
            angles[: group.angles.shape[1]] = group.angles[i]
            count = int((weights[i] > 0).sum())
            head = (_ORDER.index(group.kind), group.proper, group.joints[i], group.parents[i])
            indices.append([*head, group.pairs[i], count, *pairs, *angles])
            parts = (group.first[i], others[i], weights[i], group.basis[i], group.to_axes[i])
            last = (group.max_twist[i], group.parent_weight, group.elevation[i])
            constants.append(np.concatenate([*map(np.ravel, parts), group.signs[i], last]))
    return np.array(indices, np.int32), np.array(constants)


def _across(first: Floats, direction: Sequence[float] | None = None) -> Floats:
    """Return the unit vector (3,) across `first` that is nearest to a direction; None: any."""
    d = np.eye(3)[np.abs(first).argmin()] if direction is None else np.array(direction)
    d = d - (d @ first) * first
    length = float(np.linalg.norm(d))
    if length < _SMALL:
        raise ValueError("two directions of a joint are on one line")
    return np.asarray(d / length)


def _kind(joint: Joint) -> tuple[str, bool]:
    """Return the kind of a joint, and whether its third angle has the axis of the first."""
    count = len(joint.angles)
    if not joint.directions or (joint.parent and not count):
        return FIXED, False
    if count in (1, 2):
        return HINGE if count == 1 else AIMED, False
    if not count:
        return FREE, False
    axes = [int(np.abs(WORDS[word]).argmax()) for _, word in joint.angles]
    proper = axes[0] == axes[2]
    first = direction_vector(joint.directions[0][0])
    if len(joint.directions) == 1 and not proper and abs(first[axes[2]]) < _SMALL:
        return AIMED, False  # nothing shows the first angle
    return FREE, proper


def _canonical_axes(kind: str, axes: Floats, first: Floats) -> tuple[Floats, Floats]:
    """Return Q (3, 3) from canonical axes to those of the angles, and signs (3,) of the angles.

    Canonical are rotations about x, y, z (or about x, y, x), those of aimed joints about z, then y,
    and those of hinges about z, with the first direction along x. A rotation about Q e by an angle
    is Q R(e, det(Q) angle) Q^T.
    """
    if kind == HINGE:
        Q = np.stack([first, np.cross(axes[0], first), axes[0]], 1)
    elif kind == AIMED:
        Q = np.stack([np.cross(axes[1], axes[0]), axes[1], axes[0]], 1)
        # The first direction has a positive component along canonical x.
        if first @ Q[:, 0] < 0:
            Q[:, 0] *= -1
    elif abs(axes[0] @ axes[2]) > 0.5:
        Q = np.stack([axes[0], axes[1], np.cross(axes[0], axes[1])], 1)
        return Q, np.array([1.0, 1.0, axes[0] @ axes[2]])
    else:
        Q = axes.T
    return Q, np.full(3, np.linalg.det(Q))


def _dot(a: Floats, b: Floats) -> Floats:
    """Return the dot product (...) of vectors (..., 3)."""
    product: Floats = np.einsum("...i,...i->...", a, b)
    return product


def _cross(a: Floats, b: Floats) -> Floats:
    """Return the cross product (..., 3); np.cross takes four times as long."""
    product: Floats = a[..., _NEXT] * b[..., _LAST] - a[..., _LAST] * b[..., _NEXT]
    return product


def quaternions(R: Floats) -> Floats:
    """Return the unit quaternions (..., 4), x y z w, w >= 0, of rotations (..., 3, 3)."""
    if kernel.AVAILABLE:
        q = np.empty((*R.shape[:-2], 4))
        kernel._kernel.quaternions(np.ascontiguousarray(R, np.float64), q)
        return q
    return _quaternions(R)


def _quaternions(R: Floats) -> Floats:
    """Return unit quaternions, as the kernel does: for reading and tests."""
    return np.reshape([quaternion(each) for each in R.reshape(-1, 3, 3)], (*R.shape[:-2], 4))


def _free(group: _Group, parents: Floats, v: Floats, w: Floats) -> tuple[Floats, Floats]:
    """Return frames (n, k, 3, 3) that follow measured directions, and their angles (n, k, m).

    The parent's frame is swung so that its first direction d meets the measured one, u, by the
    smallest rotation; this takes a vector e across d to e - (u e) (d + u) / (1 + d u). The twist
    about u follows from the further directions.

    Args:
        group: k joints.
        parents: (n, k, 3, 3) frames of their parents.
        v: (n, k, 3) measured first directions, of any length.
        w: (n, k, s, 3) measured further directions.
    """
    start = (parents @ group.first[..., None])[..., 0]
    length = np.sqrt(_dot(v, v))[..., None]
    u = v / np.maximum(length, _SMALL)
    if (length < _SMALL).any():
        u = np.where(length < _SMALL, start, u)
    e = group.others @ parents.swapaxes(-1, -2)  # (n, k, s, 3)
    u_ = u[:, :, None]
    share = (e @ u[..., None]) / np.maximum(1 + _dot(start, u), _SMALL)[..., None, None]
    e = e - share * (start + u)[:, :, None]
    across = w - (w @ u[..., None]) * u_
    scale = np.sqrt(_dot(across, across)) / np.maximum(_dot(w, w), _SMALL**2) * group.weights
    cosine, sine = scale * _dot(across, e), scale * _dot(across, _cross(u_, e))
    far = np.abs(np.arctan2(sine[..., 0], cosine[..., 0])) > group.max_twist
    if far.any():
        cosine[..., 0][far] *= -1
        sine[..., 0][far] *= -1
    twist = np.stack((cosine.sum(-1) + group.parent_weight, sine.sum(-1)), -1)
    size = np.sqrt(_dot(twist, twist))[..., None]
    twist = np.where(size > 0, twist / np.maximum(size, _TINIEST), _NO_TWIST)
    a = e[:, :, 0]
    a = twist[..., :1] * a + twist[..., 1:] * _cross(u, a)
    B = np.stack((u, a, _cross(u, a)), -1)
    R = B @ group.basis.swapaxes(-1, -2)
    if not group.angles.size:
        return R, np.zeros((len(v), 0))
    N = (parents @ group.to_axes).swapaxes(-1, -2) @ R @ group.to_axes
    return R, _euler(group, N)


def _rotation(group: _Group, theta: Floats) -> Floats:
    """Return the rotations (n, k, 3, 3) of the angles (n, k, m) of a group."""
    t = theta * group.signs[:, : theta.shape[-1]]
    c, s = np.cos(t), np.sin(t)
    R: Floats = np.zeros((*theta.shape[:-1], 3, 3))
    if group.kind == HINGE:  # about z
        R[..., 0, 0] = R[..., 1, 1] = c[..., 0]
        R[..., 1, 0], R[..., 0, 1], R[..., 2, 2] = s[..., 0], -s[..., 0], 1
    elif group.kind == AIMED:  # about z, then y
        (c1, c2), (s1, s2) = np.moveaxis(c, -1, 0), np.moveaxis(s, -1, 0)
        R[..., 0, 0], R[..., 0, 1], R[..., 0, 2] = c1 * c2, -s1, c1 * s2
        R[..., 1, 0], R[..., 1, 1], R[..., 1, 2] = s1 * c2, c1, s1 * s2
        R[..., 2, 0], R[..., 2, 2] = -s2, c2
    else:  # about x, y and x or z
        x, y, z = np.eye(3)
        R = rotation_from_vector(t[..., 0, None] * x) @ rotation_from_vector(t[..., 1, None] * y)
        R = R @ rotation_from_vector(t[..., 2, None] * (x if group.proper else z))
    rotations: Floats = group.to_axes @ R @ group.to_axes.swapaxes(-1, -2)
    return rotations


def _canonical(group: _Group, parents: Floats, v: Floats) -> Floats:
    """Return measured directions v (n, k, 3) in canonical axes."""
    canonical: Floats = (v[..., None, :] @ (parents @ group.to_axes))[..., 0, :]
    return canonical


def _hinge(group: _Group, parents: Floats, v: Floats) -> Floats:
    """Return the angle (n, k, 1) of hinges from measured directions (n, k, 3)."""
    w = _canonical(group, parents, v)
    return np.asarray(np.arctan2(w[..., 1:2], w[..., :1]) * group.signs[:, :1])


def _aimed(group: _Group, parents: Floats, v: Floats) -> Floats:
    """Return two angles (n, k, 2) that take the first direction to measured ones (n, k, 3).

    The second is an elevation; the first, an azimuth, is badly determined near 90 degrees of
    elevation.
    """
    w = _canonical(group, parents, v)
    azimuth = np.arctan2(w[..., 1], w[..., 0])
    elevation = np.arctan2(w[..., 2], np.hypot(w[..., 0], w[..., 1]))
    theta = np.stack((azimuth, group.elevation - elevation), -1)  # about y: x turns to -z
    return theta * group.signs[:, :2]


def _euler(group: _Group, N: Floats) -> Floats:
    """Return the three angles (n, k, 3) of relative rotations N (n, k, 3, 3) in canonical axes.

    At a gimbal lock, the second angle at 90 degrees or, where the first and the third have one
    axis, at 0, only the sum or the difference of these two is determined: the first is 0.
    """
    if group.proper:  # about x, y, x
        sine = np.hypot(N[..., 1, 0], N[..., 2, 0])
        a = np.arctan2(N[..., 1, 0], -N[..., 2, 0])
        b = np.arctan2(sine, N[..., 0, 0])
        c = np.arctan2(N[..., 0, 1], N[..., 0, 2])
        other = np.abs(a) > _FAR  # the other solution has it near 0
        a = np.where(other, a - np.copysign(np.pi, a), a)
        b = np.where(other, -b, b)
        c = np.where(other, c - np.copysign(np.pi, c), c)
        locked, free = sine < _GIMBAL, (2, 1)
    else:
        cosine = np.hypot(N[..., 0, 0], N[..., 0, 1])
        a = np.arctan2(-N[..., 1, 2], N[..., 2, 2])
        b = np.arctan2(N[..., 0, 2], cosine)
        c = np.arctan2(-N[..., 0, 1], N[..., 0, 0])
        locked, free = cosine < _GIMBAL, (1, 0)
    if locked.any():
        a = np.where(locked, 0.0, a)
        c = np.where(locked, np.arctan2(N[..., free[0], free[1]], N[..., 1, 1]), c)
    return np.stack((a, b, c), -1) * group.signs

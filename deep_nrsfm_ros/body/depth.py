# SPDX-License-Identifier: Apache-2.0
"""Place and size of lifted objects from measured depth.

The keypoints fix the rays on which a lifted object lies, so that its place and its size have one
factor in common. A depth sensor measures the surface m in front of a keypoint. The lifted surface
is at z - r, with the depth z of the keypoint and the radius r of the body around it; the factor is
that with which s (z - r) = m. Each confident keypoint gives one, and the factor with which most
agree is kept: a keypoint in front of which something nearer is measured is occluded, and where
something farther is measured, the pixel is beside the body.

Source: ours, not in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.body.mean_scale import RANGE, MeanScale
from deep_nrsfm_ros.layouts.layout import TRUNK, KeypointLayout
from deep_nrsfm_ros.nrsfm.geometry import finite_median

Floats = NDArray[Any]
Masks = NDArray[np.bool_]

_RADII = {
    "neck": 0.06,
    "shoulder": 0.06,
    "elbow": 0.045,
    "wrist": 0.03,
    "hip": 0.1,
    "knee": 0.06,
    "ankle": 0.045,
    "ear": 0.02,
    "heel": 0.03,
    "toe": 0.02,
}
"""Metres from a keypoint to the body's surface, by the last word of its name; other names: 0.

They are rounded measures of an adult with a trunk of `_TRUNK`; nose and eyes are on the surface.
"""
_PREFERRED = 3  # times as many keypoints may agree with another scale than that of the identity
_TRUNK = 0.5  # m
_TRUNKS = (0.2, 0.65)  # m, of people: from a small child to a height of 2.3 m
_BEAM_STEPS = 9  # points along a bone
AGREEMENT = 0.2
"""Metres between measured and lifted surface of a person up to which they agree."""
MIN_KEYPOINTS = 3
"""Fewest keypoints of an object that must agree."""
MIN_CONFIDENCE = 0.3
"""Least confidence of a point that may vote on the scale."""
_SAME_SIZE = 0.1  # log of the factor by which a scale may differ from that of its identity


class Agreement(NamedTuple):
    """When measured and lifted depth agree.

    Attributes:
        metres: between the two surfaces, at most.
        min_keypoints: fewest of an object that must agree.
        scales: least and largest factor of place and size that is believed.
    """

    metres: float = AGREEMENT
    min_keypoints: int = MIN_KEYPOINTS
    scales: tuple[float, float] = RANGE


class DepthFit(NamedTuple):
    """Measured depth of n objects with p keypoints against their lifted depth.

    Attributes:
        scales: (n,) factor of place and size; NaN: too few keypoints agree.
        agree: (n, p) keypoints in front of which the body's surface is measured.
        occluded: (n, p) something nearer is measured: it hides the keypoint.
        beside: (n, p) something farther is measured: the pixel is not on the body.
        measured: (n,) number of keypoints with a depth and enough confidence.
    """

    scales: Floats
    agree: Masks
    occluded: Masks
    beside: Masks
    measured: NDArray[np.int64]


def surface_radii(layout: KeypointLayout, reference_length: float) -> Floats:
    """Return the distance (p,) of each keypoint from the body's surface, in units of the shape.

    Args:
        layout: keypoints of people have names as in `human17`; others have radius 0.
        reference_length: of the shapes, neck to mid-hip of people.
    """
    words = [name.rsplit("_", 1)[-1] for name in layout.keypoints]
    return np.array([_RADII.get(word, 0.0) for word in words]) * reference_length / _TRUNK


def believed_scales(layout: KeypointLayout, reference_length: float) -> tuple[float, float]:
    """Return the least and the largest factor that depth may give to a shape.

    A person with a trunk of more than 0.65 m does not exist: there, the measured depth is that of
    the wall behind, as of an image that is not registered to the camera of the keypoints.

    Args:
        layout: of the shape.
        reference_length: of the shape, neck to mid-hip of people.
    """
    if layout.reference != TRUNK:
        return RANGE
    low, high = _TRUNKS
    return low / reference_length, high / reference_length


def fit_depth(
    surface: Floats,
    measured: Floats,
    confident: Masks,
    known: Floats,
    agreement: Agreement,
) -> DepthFit:
    """Return the scales with which lifted and measured surfaces agree best.

    Args:
        surface: (n, p) lifted depth of the surface, z - r.
        measured: (n, p) depth along the optical axis in metres; NaN: a hole.
        confident: (n, p) keypoints that may vote.
        known: (n,) scale of each object from earlier messages; NaN: none. It is preferred unless
            three times as many keypoints agree with another one: an occluder of most of a person
            does not make the person smaller.
        agreement: when the two surfaces agree.
    """
    metres, min_keypoints, (low, high) = agreement
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.where(surface > 0, measured / surface, np.nan)
        believed = confident & (ratios >= low) & (ratios <= high)
        ratios[~believed] = np.nan
        votes = np.where(believed, measured, np.nan)
        # residual[n, i, j]: of keypoint j with the scale of keypoint i
        residuals = ratios[:, :, None] * surface[:, None] - votes[:, None]
        scores = np.fmax(1 - np.square(residuals / metres), 0).sum(2)
        best = scores.max(1, keepdims=True)
        familiar = np.abs(np.log(ratios / known[:, None])) < _SAME_SIZE
        scores[familiar & (_PREFERRED * scores >= best)] += surface.shape[1]
        chosen = scores.argmax(1)
        rows = np.arange(len(surface))
        members = np.abs(residuals[rows, chosen]) <= metres
        scales = finite_median(np.where(members, ratios, np.nan))
        gap = measured - scales[:, None] * surface
        agree = believed & (np.abs(gap) <= metres)
        scales[agree.sum(1) < min_keypoints] = np.nan
        fitted = np.isfinite(scales)[:, None]
        return DepthFit(
            scales,
            agree & fitted,
            (gap < -metres) & fitted,
            (gap > metres) & fitted,
            (confident & np.isfinite(measured)).sum(1),
        )


class DepthScale:
    """The scale of each object from measured depth; the mean of its identity without."""

    def __init__(self, radii: Floats, agreement: Agreement) -> None:
        """Start without identities.

        Args:
            radii: (p,) as of `surface_radii`.
            agreement: when measured and lifted depth agree.
        """
        self._radii, self._agreement = radii, agreement
        self._mean = MeanScale()

    def __call__(
        self,
        identities: Sequence[str],
        shapes: Floats,
        confidence: Floats,
        measured: Floats,
        seconds: float,
    ) -> tuple[Floats, DepthFit]:
        """Return the factors (n,) of the objects of a message, and how they were found.

        A factor is that of this message, else the mean of the identity, and NaN without either.

        Args:
            identities: n; "" has no memory.
            shapes: (n, p, 3) at their positions, z forward.
            confidence: (n, p) of the points.
            measured: (n, p) depth at their pixels in metres; NaN: a hole.
            seconds: time of the message.
        """
        known = np.array([self._mean(identity) for identity in identities])
        fit = fit_depth(
            shapes[..., 2].astype(float) - self._radii,
            measured,
            confidence >= MIN_CONFIDENCE,
            known,
            self._agreement,
        )
        for identity, scale in zip(identities, fit.scales.tolist(), strict=True):
            self._mean.update(identity, scale, seconds)
        return np.where(np.isnan(fit.scales), known, fit.scales), fit


class RangeScale:
    """The scale of each object from one distance along the optical axis, as of a range finder."""

    def __init__(
        self,
        radii: Floats,
        edges: Sequence[tuple[int, int]],
        scales: tuple[float, float] = RANGE,
    ) -> None:
        """Start without identities.

        Args:
            radii: (p,) as of `surface_radii`.
            edges: pairs of keypoint indices, the bones that the beam may meet.
            scales: least and largest factor that is believed.
        """
        self._radii, self._scales = radii, scales
        self._ends = np.array([*edges, *((i, i) for i in range(len(radii)))], int).T
        self._mean = MeanScale()

    def __call__(
        self,
        identities: Sequence[str],
        shapes: Floats,
        distance: float,
        half_angle: float,
        seconds: float,
    ) -> tuple[Floats, int]:
        """Return the factors (n,) of the objects of a message, and which one the beam meets.

        A factor is the mean of its identity in the last seconds, and NaN without one.

        Args:
            identities: n; "" has no memory.
            shapes: (n, p, 3) at their positions, z forward.
            distance: to the first surface in metres; NaN: nothing is measured.
            half_angle: of the beam in radians.
            seconds: time of the message.

        Returns:
            The factors, and the index of the object; -1: none.
        """
        a, b = self._ends
        share = np.linspace(0, 1, _BEAM_STEPS)[:, None, None]
        # (steps, n, bones, 3): points along the bones
        points = (1 - share[..., None]) * shapes[:, a] + share[..., None] * shapes[:, b]
        radii = ((1 - share) * self._radii[a] + share * self._radii[b]) * np.ones((len(shapes), 1))
        with np.errstate(invalid="ignore", divide="ignore"):
            far = np.linalg.norm(points, axis=-1)
            beside = np.hypot(points[..., 0], points[..., 1]) - radii
            in_beam = (points[..., 2] > 0) & (beside <= points[..., 2] * np.tan(half_angle))
            nearest = np.where(in_beam, far - radii, np.inf).min((0, 2))
        met = int(nearest.argmin()) if np.isfinite(nearest).any() else -1
        scale = distance / nearest[met] if met >= 0 else np.nan
        if not self._scales[0] <= scale <= self._scales[1]:
            met, scale = -1, np.nan
        scales = np.empty(len(shapes))
        for i, identity in enumerate(identities):
            own = scale if i == met else np.nan
            self._mean.update(identity, own, seconds)
            mean = self._mean(identity)
            scales[i] = own if np.isnan(mean) else mean
        return scales, met

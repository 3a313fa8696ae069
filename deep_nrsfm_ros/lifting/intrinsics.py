# SPDX-License-Identifier: Apache-2.0
"""Intrinsics of a camera: from pixels to rays and back.

Source: the lens models of sensor_msgs/CameraInfo, as OpenCV defines them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array: TypeAlias = NDArray[np.float64]

PLUMB_BOB = "plumb_bob"
RATIONAL = "rational_polynomial"
EQUIDISTANT = "equidistant"
COEFFICIENTS = {PLUMB_BOB: (0, 4, 5), RATIONAL: (0, 4, 5, 8), EQUIDISTANT: (0, 4)}
"""Numbers of coefficients that each lens model may have; those left out are 0."""

MIN_FIELD_OF_VIEW = 10.0
"""Smallest angle of view in degrees of a camera that is not calibrated: less is a long lens."""
MAX_FIELD_OF_VIEW = 150.0
"""Largest angle of view in degrees; wider lenses are far from a pinhole."""

_MAX_STEPS = 20  # of Newton's method; a usual lens takes 5, the border of a fisheye more
_TOLERANCE = 1e-9  # last step in the plane z = 1, or in radians, of a search that has converged


def check_field_of_view(degrees: float) -> None:
    """Raise ValueError unless an angle is from `MIN_FIELD_OF_VIEW` to `MAX_FIELD_OF_VIEW`."""
    if MIN_FIELD_OF_VIEW <= degrees <= MAX_FIELD_OF_VIEW:
        return
    in_degrees, hint = math.degrees(degrees), ""
    if MIN_FIELD_OF_VIEW <= in_degrees <= MAX_FIELD_OF_VIEW:
        hint = f": give degrees; {degrees:g} radians are {in_degrees:.0f} degrees"
    elif 0 < degrees < MIN_FIELD_OF_VIEW:
        hint = ": give degrees; a camera that sees less must be calibrated (CameraInfo)"
    raise ValueError(
        f"field of view is {degrees:g} degrees; it must be at least {MIN_FIELD_OF_VIEW:g} and at "
        f"most {MAX_FIELD_OF_VIEW:g}{hint}"
    )


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera with lens distortion.

    Attributes:
        focal: focal lengths (fx, fy) in pixels, above 0.
        principal: principal point (cx, cy) in pixels.
        distortion: k1 k2 p1 p2 [k3 [k4 k5 k6]] of `plumb_bob` and `rational_polynomial`,
            k1 k2 k3 k4 of `equidistant` (fisheye); (): no distortion.
        lens: one of `COEFFICIENTS`.

    `from_matrix` takes a camera matrix and the distortion as OpenCV and ROS have them.

    Raises:
        ValueError: unknown lens, wrong number of coefficients, of focal lengths or of coordinates,
            a number that is not finite, or a focal length that is not above 0.
    """

    focal: tuple[float, float]
    principal: tuple[float, float]
    distortion: tuple[float, ...] = ()
    lens: str = PLUMB_BOB

    def __post_init__(self) -> None:
        """Check the numbers, and keep them as tuples."""
        for name in ("focal", "principal"):
            object.__setattr__(self, name, _pair(name, getattr(self, name)))
        object.__setattr__(self, "distortion", _coefficients(self.distortion))
        if self.lens not in COEFFICIENTS:
            raise ValueError(f"lens is {self.lens!r}; choose one of {', '.join(COEFFICIENTS)}")
        if len(self.distortion) not in COEFFICIENTS[self.lens]:
            counts = " or ".join(map(str, COEFFICIENTS[self.lens]))
            raise ValueError(
                f"lens {self.lens!r} has {len(self.distortion)} coefficients; it must have {counts}"
            )
        if not np.isfinite([*self.focal, *self.principal, *self.distortion]).all():
            raise ValueError(f"camera has a number that is not finite: {self}")
        if min(self.focal) <= 0:
            raise ValueError(f"focal length is {min(self.focal)}; it must be above 0 pixels")

    @classmethod
    def from_matrix(
        cls, matrix: ArrayLike, distortion: ArrayLike = (), lens: str = ""
    ) -> Intrinsics:
        """Return the camera of a camera matrix K, as camera calibration writes it.

        Args:
            matrix: (3, 3) with rows (fx, 0, cx), (0, fy, cy), (0, 0, 1) in pixels: `K` of OpenCV,
                or the 9 numbers of `k` of a CameraInfo.
            distortion: coefficients in any shape, as for the attribute: `dist` of OpenCV, `d` of a
                CameraInfo. (): no distortion.
            lens: one of `COEFFICIENTS`; "": `rational_polynomial` for 8 coefficients, else
                `plumb_bob`. Of a fisheye camera say `equidistant`.

        Raises:
            ValueError: the matrix is none of a camera without skew, or as of the class.
        """
        K = np.asarray(matrix, np.float64)
        K = K.reshape(3, 3) if K.shape == (9,) else K
        if K.shape != (3, 3):
            raise ValueError(f"camera matrix is of shape {K.shape}; it must be (3, 3)")
        if not np.allclose(K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], (0, 0, 0, 0, 1)):
            raise ValueError(
                f"camera matrix is {K.tolist()}; it must have the rows (fx, 0, cx), (0, fy, cy) "
                "and (0, 0, 1)"
            )
        coefficients = _coefficients(distortion)
        usual = RATIONAL if len(coefficients) == COEFFICIENTS[RATIONAL][-1] else PLUMB_BOB
        return cls((K[0, 0], K[1, 1]), (K[0, 2], K[1, 2]), coefficients, lens or usual)

    @classmethod
    def from_field_of_view(cls, degrees: float, size: tuple[int, int]) -> Intrinsics:
        """Return a camera without distortion whose principal point is the middle of the image.

        Args:
            degrees: angle of view of the image's width, also of an upright image.
            size: width and height of the whole image in pixels.

        Raises:
            ValueError: as `check_field_of_view`, or a side of the image is not above 0.
        """
        check_field_of_view(degrees)
        width, height = size
        if min(size) <= 0:
            raise ValueError(f"image is {width} x {height}; both sides must be above 0 pixels")
        focal = width / 2 / math.tan(math.radians(degrees) / 2)
        return cls((focal, focal), (width / 2, height / 2))

    def rays(self, pixels: NDArray[np.floating]) -> Array:
        """Return the intersections (..., 2) of the pixels' rays with the plane z = 1.

        The axes are those of the optical frame, x right and y down. NaN where no ray in front of
        the camera reaches the pixel.

        Args:
            pixels: (..., 2).
        """
        distorted = (np.asarray(pixels, np.float64) - self.principal) / self.focal
        if self.lens != EQUIDISTANT and not any(self.distortion):
            return distorted
        # With coefficients that no lens has, the search may diverge and end in NaN.
        with np.errstate(over="ignore", invalid="ignore"):
            undistort = self._undistort_fisheye if self.lens == EQUIDISTANT else self._undistort
            return undistort(distorted)

    def pixels(self, rays: NDArray[np.floating]) -> Array:
        """Return the pixels (..., 2) of the rays through (x, y, 1); the inverse of `rays`.

        Args:
            rays: (..., 2) x and y on the plane z = 1.
        """
        plane = np.asarray(rays, np.float64)
        if self.lens == EQUIDISTANT:
            radius = np.linalg.norm(plane, axis=-1, keepdims=True)
            distorted = plane * _ratio(self._fisheye_distance(np.arctan(radius))[0], radius)
        else:
            distorted = self._distort(plane)[0] if any(self.distortion) else plane
        pixels: Array = distorted * self.focal + self.principal
        return pixels

    def without_lens(self) -> Intrinsics:
        """Return the same camera without distortion."""
        return replace(self, distortion=(), lens=PLUMB_BOB)

    def _distort(self, plane: Array) -> tuple[Array, Array]:
        """Return distorted points (..., 2) and the derivative xx, xy = yx, yy (..., 3).

        x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + 2 p1 x y
        + p2 (r^2 + 2 x^2), and y with x and y, p1 and p2 exchanged.
        """
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.distortion, *(0.0,) * (8 - len(self.distortion)))
        x, y = plane[..., 0], plane[..., 1]
        r2 = x * x + y * y
        numerator = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = numerator / denominator
        slope = k1 + r2 * (2 * k2 + 3 * r2 * k3) - radial * (k4 + r2 * (2 * k5 + 3 * r2 * k6))
        slope = 2 * slope / denominator  # 2 d radial / d r^2
        distorted = (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )
        derivative = (
            radial + x * x * slope + 2 * p1 * y + 6 * p2 * x,
            x * y * slope + 2 * p1 * x + 2 * p2 * y,
            radial + y * y * slope + 6 * p1 * y + 2 * p2 * x,
        )
        return np.stack(distorted, -1), np.stack(derivative, -1)

    def _undistort(self, distorted: Array) -> Array:
        """Return the points (..., 2) that `_distort` takes to `distorted`, by Newton's method."""
        plane = distorted
        for _ in range(_MAX_STEPS):
            reached, derivative = self._distort(plane)
            a, b, d = np.moveaxis(derivative, -1, 0)
            determinant = a * d - b * b
            u, v = np.moveaxis(distorted - reached, -1, 0)
            # Where the lens folds the image there is no ray; NaN persists to the last step.
            determinant = np.where((determinant > 0) & (a + d > 0), determinant, np.nan)
            step = np.stack((d * u - b * v, a * v - b * u), -1) / determinant[..., None]
            plane = plane + step
            if not (np.abs(step) > _TOLERANCE).any():
                break
        converged = np.abs(step).max(-1, keepdims=True) <= _TOLERANCE
        undistorted: Array = np.where(converged, plane, np.nan)
        return undistorted

    def _fisheye_distance(self, theta: Array) -> tuple[Array, Array]:
        """Return the distance from a fisheye image's centre at angle theta, and its derivative.

        theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).
        """
        k1, k2, k3, k4 = self.distortion or (0.0,) * 4
        t2 = theta * theta
        distance = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        return distance, slope

    def _undistort_fisheye(self, distorted: Array) -> Array:
        """Return the points (..., 2) of the plane z = 1 that a fisheye takes to `distorted`."""
        radius = np.linalg.norm(distorted, axis=-1, keepdims=True)
        theta = radius
        for _ in range(_MAX_STEPS):
            distance, slope = self._fisheye_distance(theta)
            step = (radius - distance) / np.where(slope > 0, slope, np.nan)
            theta = theta + step
            if not (np.abs(step) > _TOLERANCE).any():
                break
        converged = (np.abs(step) <= _TOLERANCE) & (theta < np.pi / 2)
        plane: Array = distorted * _ratio(np.tan(np.where(converged, theta, np.nan)), radius)
        return plane


def _pair(name: str, value: object) -> tuple[float, float]:
    """Return two numbers; raise ValueError that says what to give instead."""
    wanted = {"focal": "(fx, fy)", "principal": "(cx, cy)"}[name]
    array = np.asarray(value)
    if array.dtype.kind not in "fiu" or array.shape != (2,):
        is_matrix = array.ndim == 2 or array.size == 9
        given = f"of shape {array.shape}" if array.size > 4 else repr(value)
        remedy = "Intrinsics.from_matrix(K, distortion)" if is_matrix else f"{wanted} in pixels"
        raise ValueError(f"{name} of Intrinsics is {given}; give {remedy}")
    return float(array[0]), float(array[1])


def _coefficients(distortion: ArrayLike) -> tuple[float, ...]:
    """Return the coefficients of a lens, in whatever shape they come: OpenCV's are (1, 5)."""
    array = np.asarray(distortion)
    if array.size and array.dtype.kind not in "fiu":
        raise ValueError(f"distortion of Intrinsics is {distortion!r}; give numbers")
    return tuple(array.ravel().astype(np.float64).tolist())


def _ratio(a: Array, b: Array) -> Array:
    """Return a / b, and its limit 1 where both are near zero."""
    is_zero = b < 1e-12
    return np.where(is_zero & ~np.isnan(a), 1.0, a / np.where(is_zero, 1.0, b))

"""The camera's intrinsics: from pixels to the rays on which the points lie, and back.

Lens models are those of sensor_msgs/CameraInfo, as OpenCV defines them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]

PLUMB_BOB = "plumb_bob"
RATIONAL = "rational_polynomial"
EQUIDISTANT = "equidistant"
COEFFICIENTS = {PLUMB_BOB: (0, 4, 5), RATIONAL: (0, 4, 5, 8), EQUIDISTANT: (0, 4)}
"""How many coefficients each lens model may have; the others are 0."""

_STEPS = 20  # of Newton's method; five do for a usual lens, a fisheye's border takes more
_EXACT = 1e-9  # distance in the image plane below which a point counts as met


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole with a lens.

    focal: focal lengths (fx, fy) and principal: principal point (cx, cy), in pixels.
    distortion: k1 k2 p1 p2 [k3 [k4 k5 k6]] of `plumb_bob` and `rational_polynomial`, k1 k2 k3 k4
        of `equidistant` (fisheye).
    lens: one of `COEFFICIENTS`.
    Raises ValueError for another lens, and for numbers that no camera has.
    """

    focal: tuple[float, float]
    principal: tuple[float, float]
    distortion: tuple[float, ...] = ()
    lens: str = PLUMB_BOB

    def __post_init__(self) -> None:
        """Refuse what is no camera."""
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

    def rays(self, pixels: NDArray[np.floating]) -> Array:
        """Return where the rays of pixels (..., 2) meet the plane z = 1 of the optical frame.

        (..., 2): x right, y down; NaN where no ray in front of the camera leads to the pixel.
        """
        bent = (np.asarray(pixels, np.float64) - self.principal) / self.focal
        if self.lens != EQUIDISTANT and not any(self.distortion):
            return bent
        # With coefficients that no lens has the search may go to infinity, and ends in NaN.
        with np.errstate(over="ignore", invalid="ignore"):
            return (self._unbend_fisheye if self.lens == EQUIDISTANT else self._unbend)(bent)

    def pixels(self, rays: NDArray[np.floating]) -> Array:
        """Return the pixels (..., 2) of rays through (x, y, 1): the inverse of `rays`."""
        plane = np.asarray(rays, np.float64)
        if self.lens == EQUIDISTANT:
            radius = np.linalg.norm(plane, axis=-1, keepdims=True)
            bent = plane * _ratio(self._angle(np.arctan(radius))[0], radius)
        else:
            bent = self._bend(plane)[0] if any(self.distortion) else plane
        pixels: Array = bent * self.focal + self.principal
        return pixels

    def without_lens(self) -> Intrinsics:
        """Return the pinhole alone."""
        return replace(self, distortion=(), lens=PLUMB_BOB)

    def _bend(self, plane: Array) -> tuple[Array, Array]:
        """Return plane (..., 2) as the lens bends it, and the derivative: xx, xy = yx, yy (..., 3).

        x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + 2 p1 x y
        + p2 (r^2 + 2 x^2), and y with x and y, p1 and p2 exchanged.
        """
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.distortion, *(0.0,) * (8 - len(self.distortion)))
        x, y = plane[..., 0], plane[..., 1]
        r2 = x * x + y * y
        above, below = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = above / below
        slope = k1 + r2 * (2 * k2 + 3 * r2 * k3) - radial * (k4 + r2 * (2 * k5 + 3 * r2 * k6))
        slope = 2 * slope / below  # 2 d radial / d r^2
        bent = (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )
        derivative = (
            radial + x * x * slope + 2 * p1 * y + 6 * p2 * x,
            x * y * slope + 2 * p1 * x + 2 * p2 * y,
            radial + y * y * slope + 6 * p1 * y + 2 * p2 * x,
        )
        return np.stack(bent, -1), np.stack(derivative, -1)

    def _unbend(self, bent: Array) -> Array:
        """Return what `_bend` takes to bent (..., 2), by Newton's method from there."""
        plane = bent
        for _ in range(_STEPS):
            reached, derivative = self._bend(plane)
            a, b, d = np.moveaxis(derivative, -1, 0)
            determinant = a * d - b * b
            u, v = np.moveaxis(bent - reached, -1, 0)
            # Where the lens folds the image over there is no ray; NaN goes through to the end.
            determinant = np.where((determinant > 0) & (a + d > 0), determinant, np.nan)
            step = np.stack((d * u - b * v, a * v - b * u), -1) / determinant[..., None]
            plane = plane + step
            if not (np.abs(step) > _EXACT).any():
                break
        met = np.abs(step).max(-1, keepdims=True) <= _EXACT
        unbent: Array = np.where(met, plane, np.nan)
        return unbent

    def _angle(self, theta: Array) -> tuple[Array, Array]:
        """Return the distance from the centre of a fisheye's image at angle theta, and its slope.

        theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).
        """
        k1, k2, k3, k4 = self.distortion or (0.0,) * 4
        t2 = theta * theta
        distance = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        return distance, slope

    def _unbend_fisheye(self, bent: Array) -> Array:
        """Return where the rays of a fisheye's image (..., 2) meet the plane z = 1."""
        radius = np.linalg.norm(bent, axis=-1, keepdims=True)
        theta = radius
        for _ in range(_STEPS):
            distance, slope = self._angle(theta)
            step = (radius - distance) / np.where(slope > 0, slope, np.nan)
            theta = theta + step
            if not (np.abs(step) > _EXACT).any():
                break
        seen = (np.abs(step) <= _EXACT) & (theta < np.pi / 2)
        plane: Array = bent * _ratio(np.tan(np.where(seen, theta, np.nan)), radius)
        return plane


def _ratio(a: Array, b: Array) -> Array:
    """Return a / b, and 1 where both go to zero together."""
    near = b < 1e-12
    return np.where(near & ~np.isnan(a), 1.0, a / np.where(near, 1.0, b))

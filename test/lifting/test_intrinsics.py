# SPDX-License-Identifier: Apache-2.0
"""Lenses are undone as OpenCV defines them, and no ray is made up."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros.lifting.intrinsics import EQUIDISTANT, PLUMB_BOB, RATIONAL, Intrinsics

FOCAL, PRINCIPAL = (600.0, 610.0), (320.0, 236.0)
LENSES = {
    "webcam": (PLUMB_BOB, (-0.28, 0.09, 0.0008, -0.0005, -0.012)),
    "four coefficients": (PLUMB_BOB, (0.12, -0.25, -0.001, 0.002)),
    "rational": (RATIONAL, (0.6, -2.1, 0.0004, -0.0003, 1.3, 0.5, -1.9, 1.2)),
    "fisheye": (EQUIDISTANT, (-0.02, 0.004, -0.003, 0.0005)),
    "ideal fisheye": (EQUIDISTANT, ()),
    "none": (PLUMB_BOB, ()),
}
every_lens = pytest.mark.parametrize("lens", LENSES)
sides = st.floats(-0.6, 0.6)


def camera(lens: str) -> Intrinsics:
    name, distortion = LENSES[lens]
    return Intrinsics(FOCAL, PRINCIPAL, distortion, name)


@every_lens
@settings(max_examples=50, deadline=None)
@given(ray=st.tuples(sides, sides))
def test_pixels_lead_back_to_their_rays(lens: str, ray: tuple[float, float]) -> None:
    there = camera(lens).pixels(np.array(ray))
    np.testing.assert_allclose(camera(lens).rays(there), ray, atol=1e-7)


def test_a_field_of_view_is_that_of_the_width_of_the_image() -> None:
    for size in ((1280, 720), (720, 1280)):
        rough = Intrinsics.from_field_of_view(90, size)
        width, height = size
        edges = rough.rays(np.array([(0, height / 2), (width, height / 2), (width / 2, height)]))
        np.testing.assert_allclose(edges, [(-1, 0), (1, 0), (0, height / width)], atol=1e-12)
    assert Intrinsics.from_field_of_view(69.4, (1920, 1080)).focal[0] == pytest.approx(1386.4, 1e-3)


@pytest.mark.parametrize("degrees", [0, -60, 150.1, 180, float("nan")])
def test_no_camera_has_such_a_field_of_view(degrees: float) -> None:
    with pytest.raises(ValueError, match=r"field of view is .* must be at least 10 and at most 15"):
        Intrinsics.from_field_of_view(degrees, (640, 480))
    with pytest.raises(ValueError, match="image is 640 x 0"):
        Intrinsics.from_field_of_view(60, (640, 0))


@pytest.mark.parametrize(
    ("degrees", "said"),
    [(1.13, "give degrees; 1.13 radians are 65 degrees"), (5, "give degrees; a camera that sees")],
)
def test_radians_are_no_degrees(degrees: float, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Intrinsics.from_field_of_view(degrees, (640, 480))


def explicit(lens: str, distortion: tuple[float, ...], x: float, y: float) -> tuple[float, float]:
    """Return the bent point by OpenCV's documentation, letter by letter."""
    r = np.hypot(x, y)
    if lens == EQUIDISTANT:
        k1, k2, k3, k4 = distortion or (0, 0, 0, 0)
        t = np.arctan(r)
        share = t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8) / r
        return x * share, y * share
    k1, k2, p1, p2, k3, k4, k5, k6 = (*distortion, *[0.0] * (8 - len(distortion)))
    radial = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    return (
        x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
        y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y,
    )


@every_lens
def test_the_lens_is_that_of_the_documentation(lens: str) -> None:
    rays = np.random.default_rng(0).uniform(-0.6, 0.6, (20, 2))
    bent = np.array([explicit(*LENSES[lens], x, y) for x, y in rays])
    np.testing.assert_allclose(camera(lens).pixels(rays), bent * FOCAL + PRINCIPAL, rtol=1e-12)


@every_lens
def test_as_opencv(lens: str) -> None:
    cv2: Any = pytest.importorskip("cv2", reason="OpenCV is not installed")
    name, distortion = LENSES[lens]
    pixels = np.random.default_rng(1).uniform(150, 450, (50, 1, 2))
    matrix = np.array([[FOCAL[0], 0, PRINCIPAL[0]], [0, FOCAL[1], PRINCIPAL[1]], [0, 0, 1]])
    if name == EQUIDISTANT:
        rays = cv2.fisheye.undistortPoints(pixels, matrix, np.array(distortion or [0.0] * 4))
    else:
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        given = np.array(distortion or [0.0] * 4)
        rays = cv2.undistortPointsIter(pixels, matrix, given, None, None, criteria)
    np.testing.assert_allclose(camera(lens).rays(pixels), rays, atol=1e-6)


def test_where_no_ray_leads_is_nan() -> None:
    barrel = Intrinsics(FOCAL, PRINCIPAL, (-0.3, 0.0, 0.0, 0.0))
    # r (1 - 0.3 r^2) is never more than 0.7027.
    pixels = np.array(PRINCIPAL) + [[0.70 * 600, 0], [0.71 * 600, 0], [0, 3000], [-9e8, 9e8]]
    rays = barrel.rays(pixels)
    assert np.isfinite(rays[0]).all() and np.isnan(rays[1:]).all()
    assert rays[0, 0] < (1 / 0.9) ** 0.5
    fisheye = Intrinsics(FOCAL, PRINCIPAL, (), EQUIDISTANT)
    sideways = fisheye.rays(np.array(PRINCIPAL) + [[1.5 * 600, 0], [1.6 * 600, 0]])
    np.testing.assert_allclose(sideways[0], [np.tan(1.5), 0])
    assert np.isnan(sideways[1]).all()


def test_one_pixel_does_not_touch_another() -> None:
    lens = camera("webcam")
    pixels = np.array([[100.0, 50], [np.nan, 3], [1e7, 1e7], [400, 300]])
    rays = lens.rays(pixels)
    assert np.isnan(rays[1:3]).all()
    for i in (0, 3):
        np.testing.assert_allclose(rays[i], lens.rays(pixels[i]), atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"lens": "pinhole"}, "'pinhole'; choose one of plumb_bob, rational_polynomial, equidis"),
        ({"distortion": (0.1, 0.2, 0.3)}, "has 3 coefficients; it must have 0 or 4 or 5"),
        ({"focal": (0.0, 600.0)}, "focal length is 0.0; it must be above 0"),
        ({"principal": (np.nan, 1.0)}, "not finite"),
    ],
)
def test_what_is_no_camera_is_refused(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        Intrinsics(**{"focal": FOCAL, "principal": PRINCIPAL} | changes)


K = np.array([[600.0, 0, 320], [0, 610, 236], [0, 0, 1]])
MADE: Any = Intrinsics  # of arguments of other types, too


@every_lens
def test_a_camera_matrix_is_what_calibration_gives(lens: str) -> None:
    name, distortion = LENSES[lens]
    expected = camera(lens)
    word = name if name == EQUIDISTANT else ""
    assert Intrinsics.from_matrix(K, np.array([distortion]), word) == expected  # (1, n) of OpenCV
    assert Intrinsics.from_matrix(K.ravel().tolist(), distortion, word) == expected  # of CameraInfo
    arrays = MADE(np.array(FOCAL), list(PRINCIPAL), np.array([distortion]).T, name)
    assert arrays == expected and hash(arrays) == hash(expected)


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (
            lambda: MADE((1000,), (640, 360)),
            r"focal of Intrinsics is \(1000,\); give \(fx, fy",
        ),
        (lambda: MADE(1000, (640, 360)), r"focal of Intrinsics is 1000; give \(fx, fy\)"),
        (lambda: MADE((1, 1), 640), r"principal of Intrinsics is 640; give \(cx, cy\)"),
        (lambda: MADE(K, (640, 360)), r"shape \(3, 3\); give Intrinsics.from_matrix\(K, d"),
        (lambda: MADE("ab", (1, 1)), r"focal of Intrinsics is 'ab'"),
        (lambda: MADE((1, 1), (1, 1), ("a",) * 4), "distortion of Intrinsics is .*numbers"),
        (lambda: Intrinsics.from_matrix(K[:2]), r"is of shape \(2, 3\); it must be \(3, 3\)"),
        (lambda: Intrinsics.from_matrix(K.T), r"must have the rows \(fx, 0, cx\)"),
        (lambda: Intrinsics.from_matrix(K, [0.1] * 3), "'plumb_bob' has 3 coefficients"),
    ],
)
def test_what_is_no_camera_says_what_to_give(make: Any, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        make()

# SPDX-License-Identifier: Apache-2.0
"""Values that look wrong are found, and sound ones are not."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.lifting.sanity import (
    check,
    find_origin,
    is_person,
    looks_normalised,
    orientation,
    pose,
    wrong_keypoints,
    wrong_keypoints_text,
)

CAMERA = Intrinsics((1000.0, 1000.0), (640.0, 360.0))
SIZE = (1280, 720)
N, Q = 60, 17


def people() -> np.ndarray:
    """Return pixels (60, 17, 2) of people in an image of 1280 x 720."""
    rng = np.random.default_rng(0)
    return rng.uniform((500, 150), (720, 600), (N, Q, 2))


def lifted(place: tuple[float, float, float] = (0, 0, 4), residual: float = 0.05) -> Lifted:
    shapes = np.full((N, Q, 3), place, np.float32)
    return Lifted(
        shapes,
        np.tile(np.eye(3, dtype=np.float32), (N, 1, 1)),
        np.ones(N, np.float32),
        np.ones((N, 2), np.float32),
        np.full(N, residual, np.float32),
        np.full((N, Q), 0.8, np.float32),
        np.zeros((N, Q), np.bool_),
    )


ALL = np.ones((N, Q))
STAMPS = np.arange(N) * 33_333_333


def codes(points: np.ndarray, **options: object) -> list[str]:
    return [finding.code for finding in check(points, ALL, **options)]  # type: ignore[arg-type]


def test_sound_values_are_found_nothing_of() -> None:
    points = people()
    for camera in (None, CAMERA):
        for size in (None, SIZE):
            assert not check(points, ALL, camera, size, STAMPS, lifted())
    assert not check(points[:0], ALL[:0], CAMERA, SIZE, STAMPS[:0], lifted()._replace())
    assert not codes(points - 500)  # a person at the left border, half outside


@pytest.mark.parametrize("camera", [None, CAMERA])
def test_normalised_points(camera: Intrinsics | None) -> None:
    points = people() / SIZE
    (finding,) = check(points, ALL, camera)
    assert finding.code == "normalised" and "image_width" in finding.message
    assert looks_normalised(points, ALL > 0) and not looks_normalised(people(), ALL > 0)
    (finding,) = check(2 * points - 1, ALL, camera)
    assert finding.code == "normalised" and "convert them to pixels" in finding.message
    assert not looks_normalised(2 * points - 1, ALL > 0)
    points[0, :2] = -0.1  # a few points beyond the border
    assert looks_normalised(points, ALL > 0)


def test_a_camera_of_normalised_coordinates() -> None:
    assert not check(people() / SIZE, ALL, Intrinsics((0.8, 1.4), (0.5, 0.5)))


def test_pixels_called_normalised() -> None:
    assert codes(people() * SIZE, image_size=SIZE) == ["pixels-called-normalised"]


@pytest.mark.parametrize("options", [{"image_size": (320, 240)}, {"intrinsics": CAMERA}])
def test_points_far_outside_the_image(options: dict[str, object]) -> None:
    points = people() * (1 if "image_size" in options else 4)
    assert codes(points, **options) == ["outside"]


def test_points_outside_the_image_name_the_size() -> None:
    (finding,) = check(people(), ALL, CAMERA, (1280, 560))
    assert "lie outside the image of 1280 x 560, one at (" in finding.message
    assert "not resized or cut, width before height" in finding.message
    # At most 5 % may be wrong detections, and fractions beyond 1 are parts that the image cuts off.
    assert not check(people(), ALL, CAMERA, (1280, 590))
    assert not check(people(), ALL, CAMERA, (1280, 560), is_normalised=True)


def test_where_a_size_is_used_it_is_checked_first() -> None:
    first = "check first the size of the image, 1280 x 720 (width before height"
    for camera, normalised, expected in (
        (CAMERA, False, first),
        (None, True, first),
        (None, False, "check the keypoint layout"),
    ):
        (finding,) = check(
            people(), ALL, camera, SIZE, lifted=lifted(residual=0.5), is_normalised=normalised
        )
        assert finding.code == "poor-fit" and expected in finding.message
    sideways = np.tile(np.array([(0, 0, 1), (0, 1, 0), (-1, 0, 0)], float), (N, 1, 1))
    assert first in orientation(sideways, SIZE)[0].message
    assert "check that x and y" in orientation(sideways)[0].message


@pytest.mark.parametrize("spot", [(-1, -1), (-999, -999), (-1, 0), (9999, 9999)])
def test_sentinels(spot: tuple[int, int]) -> None:
    points = people()
    points[::3, 5:8] = spot
    (finding,) = check(points, ALL, image_size=SIZE)
    assert finding.code == "sentinel" and f"60 of 1020 visible keypoints lie at exactly ({spot[0]}"
    normalised = people() / SIZE
    normalised[::3, 5:8] = spot
    assert codes(normalised) == ["sentinel", "normalised"]


@pytest.mark.parametrize(
    ("spot", "remedy"), [((-1, 0), "-1"), ((0, -1), "-1"), ((-1, -2), "-1"), ((99, 99), "99")]
)
def test_the_value_that_a_sentinel_is_named_by(spot: tuple[int, int], remedy: str) -> None:
    points = people()
    points[::3, 5:8] = spot
    (finding,) = check(points, ALL)
    assert f"(--missing-value={remedy} for files" in finding.message


def test_a_missing_keypoint_in_the_middle_of_the_image() -> None:
    points = people()
    points[::3, 5:8] = np.array(SIZE) / 2
    assert codes(points) == ["sentinel"]


def test_keypoints_that_lie_alike_by_chance_are_no_sentinels() -> None:
    random = np.random.default_rng(0)
    many = random.uniform(100, 500, (5000, 17, 2))
    many[:4, 3] = 197, 197  # 4 of 85000
    many[-8:, 5] = 0, -1
    assert not check(many, np.ones((5000, 17)))
    still = people()
    still[:, 2] = 320, 100  # a keypoint that does not move
    assert not codes(still)
    coarse = np.floor(random.uniform(0, 8, (N, 17, 2))) * 40 + 41  # cells of a heatmap
    assert not codes(coarse)


def test_points_relative_to_one_of_them() -> None:
    points = people() - people()[:, :1]
    (finding,) = find_origin(points, ALL)
    assert finding.code == "origin" and "keypoint 0 (from 0) lies at (0, 0)" in finding.message
    assert not find_origin(people(), ALL)
    missing = people()
    missing[:, 13:] = 0  # the legs of somebody who sits
    assert not find_origin(missing, ALL) and not find_origin(people(), np.zeros_like(ALL))


@pytest.mark.parametrize("constant", [1000, (1300, 1300), (-1000, 2000)])
def test_a_constant_makes_points_relative_to_one_of_them_sound(
    constant: int | tuple[int, int],
) -> None:
    points = people() - people()[:, :1] + constant
    points[7, 9] = constant  # another one by chance
    assert not find_origin(points, ALL) and not codes(points)
    points[::3, 5:8] = constant
    assert codes(points) == ["sentinel"]
    elsewhere = people()
    elsewhere[::3, 5] = 1000  # one keypoint, but only at times
    assert codes(elsewhere) == ["sentinel"]


def test_points_relative_to_the_box_of_each_object() -> None:
    points = people()
    low, high = points.min(1, keepdims=True), points.max(1, keepdims=True)
    (finding,) = check((points - low) / (high - low), ALL)
    assert finding.code == "normalised" and "fractions of its box" in finding.message


@pytest.mark.parametrize(
    ("stamps", "expected"),
    [
        (STAMPS // 1_000_000, "milliseconds"),
        (STAMPS // 1_000, "microseconds"),
        (STAMPS // 1_000_000_000, "seconds"),
        (np.zeros(N, np.int64), "all 60 frames have the stamp 0"),
        (STAMPS[::-1], "59 of 59 stamps"),
        (np.concatenate([STAMPS[30:], STAMPS[:30]]), "1 of 59 stamps"),
        (STAMPS * 1_000_000, "33333 s apart"),
    ],
)
def test_stamps(stamps: np.ndarray, expected: str) -> None:
    (finding,) = check(people(), ALL, stamps=stamps)
    assert finding.code == "stamps" and expected in finding.message


def test_slow_and_fast_streams_are_sound() -> None:
    for rate in (1 / 60, 1, 10, 240, 1000):
        stamps = 1_700_000_000_000_000_000 + (np.arange(N) * (1e9 / rate)).astype(np.int64)
        assert not check(people(), ALL, stamps=stamps), rate


def test_impossible_places() -> None:
    (finding,) = check(people(), ALL, CAMERA, SIZE, STAMPS, lifted((-1885, -1060, 2948)))
    assert finding.code == "place" and "(-1885, -1060, 2948)" in finding.message
    (finding,) = check(people(), ALL, CAMERA, SIZE, STAMPS, lifted((0, 0, -4)))
    assert "behind the camera" in finding.message
    assert not check(people(), ALL, lifted=lifted((0, 0, -4)))  # no place without a camera


def test_poor_fit_and_low_confidence() -> None:
    assert codes(people(), lifted=lifted(residual=0.79)) == ["poor-fit"]
    low = lifted()
    low.confidence[:] = 0.2
    assert codes(people(), lifted=low) == ["low-confidence"]
    nothing = lifted(residual=np.nan)
    assert not codes(people(), lifted=nothing)


def test_objects_of_less_than_a_pixel() -> None:
    assert codes(people() / 1000 + 50) == ["normalised"]


def test_people_upside_down_and_on_their_side() -> None:
    upright = np.array([[0, 1, 0], [0, 0, -1], [-1, 0, 0]], np.float32)
    assert not orientation(np.tile(upright, (N, 1, 1)))
    (finding,) = orientation(np.tile(upright * [[1], [-1], [1]], (N, 1, 1)))
    assert "100% of the people are upside down" in finding.message
    (finding,) = orientation(np.tile(upright[[1, 0, 2]], (N, 1, 1)))
    assert "on their side" in finding.message
    assert not orientation(np.full((N, 3, 3), np.nan))
    some = np.tile(upright, (N, 1, 1))
    some[::4, 1] *= -1
    assert not orientation(some)
    lean = np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]]) @ upright * [[1], [-1], [1]]
    some = np.tile(lean, (N, 1, 1))
    some[::4, :2, 2] = 0.6, 0.45  # a person leans in the image of a rolled camera
    assert "100% of the people are upside down" in orientation(some)[0].message
    assert is_person(HUMAN17) and not is_person(KeypointLayout.numbered(17))


@pytest.mark.parametrize(
    ("confidence", "expected"),
    [
        (np.linspace(0, 97, N * Q), "confidence up to 97: it must be 0 to 1, and more counts as 1; "
         "divide it by 100"),
        (np.linspace(0, 250, N * Q), "divide it by 255"),
        (np.linspace(0, 1e6, N * Q), "convert it"),
        (np.linspace(0, 1.3, N * Q), ""),  # OpenPose, MMPose
        (np.arange(N * Q) % 3, ""),  # visibility of COCO
        (np.r_[97, np.full(N * Q - 1, 0.9)], ""),  # an odd one
        (np.full(N * Q, np.nan), ""),
    ],
)  # fmt: skip
def test_the_scale_of_confidence(confidence: np.ndarray, expected: str) -> None:
    found = check(people(), confidence.reshape(N, Q))
    assert [f.code for f in found] == ["confidence-scale"] * bool(expected)
    assert expected in "".join(map(str, found))


@pytest.mark.parametrize(
    ("mirror", "expected"),
    [
        (np.diag([1, 1, -1]) @ np.diag([1, -1, 1]), "y points up"),
        (np.diag([1, 1, -1]) @ np.eye(3)[[1, 0, 2]], "x and y are exchanged"),
        (np.diag([1, 1, -1]), "left and right look exchanged"),
    ],
)
def test_which_mirror_it_is(mirror: np.ndarray, expected: str) -> None:
    upright = np.array([[0, 1, 0], [0, 0, -1], [-1, 0, 0]], np.float32)
    seen = np.ones((N, len(HUMAN17)))
    assert not pose(np.tile(upright, (N, 1, 1)), seen, HUMAN17)
    (finding,) = pose(np.tile(mirror @ upright, (N, 1, 1)), seen, HUMAN17)
    assert finding.code == "handedness" and expected in finding.message
    hidden = pose(np.tile(mirror @ upright, (N, 1, 1)), 0 * seen, HUMAN17)
    assert [f.code for f in hidden] == ["orientation"] * ("left" not in expected)


def test_few_faces_of_many_people_say_nothing_of_left_and_right() -> None:
    upright = np.array([[0, 1, 0], [0, 0, -1], [-1, 0, 0]], np.float32)
    away = np.tile(np.diag([1, 1, -1]) @ upright, (200, 1, 1))
    seen = np.zeros((200, len(HUMAN17)))
    seen[:9] = 1  # wrong keypoints of people from behind
    assert not pose(away, seen, HUMAN17)
    seen[:11] = 1
    assert [f.code for f in pose(away, seen, HUMAN17)] == ["handedness"]


def often_wrong(objects: int, share: float) -> np.ndarray:
    """Return flags (objects, 3) of which the last keypoint is wrong in a share of the objects."""
    wrong = np.zeros((objects, 3), np.bool_)
    wrong[: round(share * objects), 2] = True
    return wrong


def test_a_keypoint_that_is_often_wrong_is_named() -> None:
    (finding,) = wrong_keypoints(often_wrong(50, 0.6), "abc")
    assert finding.code == "wrong-keypoint"
    assert str(finding).startswith("keypoint 'c' contradicts the others in 60% of the objects, ")
    assert not wrong_keypoints(often_wrong(50, 0.1), "abc")
    assert not wrong_keypoints(often_wrong(10, 1.0), "abc")  # too few
    assert not wrong_keypoints(often_wrong(0, 0), "abc")


def test_wrong_keypoints_are_told_from_the_worst_on() -> None:
    wrong = often_wrong(100, 0.03)
    wrong[:10, 0] = True
    assert wrong_keypoints_text(wrong, "abc") == "a 10%, c 3%"
    assert wrong_keypoints_text(wrong[50:], "abc") == wrong_keypoints_text(wrong[:0], "abc") == ""

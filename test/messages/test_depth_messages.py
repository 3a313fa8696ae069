# SPDX-License-Identifier: Apache-2.0
"""Depth of pixels from images, clouds and ranges, and those that cannot be used."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.observation import MessageError
from deep_nrsfm_ros.messages.depth_messages import (
    DepthImage,
    DepthPoints,
    read_depth_image,
    read_depth_points,
    read_range,
)

W, H = 40, 30
CAMERA = Intrinsics((50.0, 50.0), (20.0, 15.0))
PIXEL = np.array([[[20.0, 15.0]]])


def scene() -> np.ndarray:
    """Return depths (H, W) in metres: a wall 3 m away, and a box 1.5 m away on the left."""
    depth = np.full((H, W), 3.0)
    depth[:, :15] = 1.5
    return depth


def image(
    values: np.ndarray, kind: str, *, bigendian: bool = False, pad: int = 0, **changes: Any
) -> Any:
    order = ">" if bigendian else "<"
    pixels = values.astype(order + ("u2" if kind == "16UC1" else "f4"))
    raw = b"".join(row.tobytes() + bytes(pad) for row in pixels)
    fields = {
        "height": len(values),
        "width": values.shape[1],
        "encoding": kind,
        "is_bigendian": int(bigendian),
        "step": values.shape[1] * pixels.itemsize + pad,
        "data": raw,
    }
    return SimpleNamespace(**(fields | changes))


def cloud(points: np.ndarray, form: str = "<f4", step: int = 16, **changes: Any) -> Any:
    """Return a cloud of points (height, width, 3)."""
    size = np.dtype(form).itemsize
    raw = np.zeros((*points.shape[:2], step), np.uint8)
    raw[..., : 3 * size] = points.astype(form).view(np.uint8).reshape(*points.shape[:2], -1)
    kind = 7 if size == 4 else 8
    fields = {
        "height": len(points),
        "width": points.shape[1],
        "fields": [
            SimpleNamespace(name=n, offset=i * size, datatype=kind) for i, n in enumerate("xyz")
        ],
        "is_bigendian": form.startswith(">"),
        "point_step": step,
        "row_step": step * points.shape[1],
        "data": raw.tobytes(),
    }
    return SimpleNamespace(**(fields | changes))


def scene_points() -> np.ndarray:
    """Return the points (H, W, 3) of the scene's pixels."""
    rows, columns = np.mgrid[:H, :W]
    rays = CAMERA.rays(np.stack([columns, rows], -1).astype(float))
    return np.concatenate([rays, np.ones((H, W, 1))], -1) * scene()[..., None]


@pytest.mark.parametrize("bigendian", [False, True])
@pytest.mark.parametrize(("encoding", "unit"), [("16UC1", 1000), ("32FC1", 1)])
def test_an_image_has_the_depth_of_its_pixels(encoding: str, unit: int, *, bigendian: bool) -> None:
    message = image(unit * scene(), encoding, bigendian=bigendian, pad=6)
    depth = read_depth_image(message, (W, H))
    pixels = np.array([[[5.0, 7.0], [30.2, 20.7]], [[0.0, 0.0], [39.0, 29.0]]])
    np.testing.assert_allclose(depth.at(pixels), [[1.5, 3.0], [1.5, 3.0]])


def test_holes_and_the_outside_have_no_depth() -> None:
    values = 1000 * scene()
    values[:, 25:] = 0
    depth = read_depth_image(image(values, "16UC1"), None)
    pixels = np.array([[20.0, 15], [35, 15], [-30, 15], [20, 99], [np.nan, 15], [1e30, 0]])
    found = depth.at(pixels)
    assert found[0] == 3 and np.isnan(found[1:]).all()
    values = scene()
    values[14, 20], values[16, 20], values[15, 19], values[15, 21] = np.nan, np.inf, -1, 0
    assert read_depth_image(image(values, "32FC1"), None).at(PIXEL) == 3
    values[13:18, 18:22] = np.nan  # a fifth of the window is left
    assert read_depth_image(image(values, "32FC1"), None).at(PIXEL) == 3
    values[15, 22] = np.nan
    assert np.isnan(read_depth_image(image(values, "32FC1"), None).at(PIXEL))


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (image(scene(), "16UC1", encoding="rgb8"), "encoding is 'rgb8'; expected 16UC1"),
        (image(scene()[:, :20], "32FC1"), "20 x 30 and the camera's image 40 x 30"),
        (image(scene(), "32FC1", data=b"123"), "do not fit into the 3 bytes"),
        (image(scene(), "32FC1", step=7), "do not fit"),
    ],
)
def test_an_image_that_cannot_be_used_says_why(message: Any, reason: str) -> None:
    with pytest.raises(MessageError, match=reason):
        read_depth_image(message, (W, H))


@pytest.mark.parametrize("form", ["<f4", ">f4", "<f8"])
def test_clouds_have_the_depth_of_the_pixels_that_they_project_to(form: str) -> None:
    points = scene_points()
    points[3, 5] = np.nan
    step = 32 if form == "<f8" else 16
    pixels = np.array([[[6.0, 7.0], [30.2, 20.7]]])
    organised = read_depth_points(cloud(points, form, step), (W, H), CAMERA)
    assert isinstance(organised, DepthImage)
    np.testing.assert_allclose(organised.at(pixels), [[1.5, 3.0]], rtol=1e-6)
    rng = np.random.default_rng(0)
    sparse = rng.permutation(points.reshape(1, -1, 3)[:, ::2], axis=1)
    found = read_depth_points(cloud(sparse, form, step), (W, H), CAMERA)
    assert isinstance(found, DepthPoints)
    np.testing.assert_allclose(found.at(pixels), [[1.5, 3.0]], rtol=1e-6)
    assert np.isnan(found.at(np.array([[[-90.0, 15.0], [np.nan, 1.0]]]))).all()
    behind = read_depth_points(cloud(-sparse, form, step), (W, H), CAMERA)
    assert np.isnan(behind.at(pixels)).all()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"fields": []}, "no float field 'x'; its fields are: none"),
        ({"data": b""}, "do not fit into the 0 bytes"),
        ({"point_step": 4}, "do not fit"),
        ({"width": 0}, "it is empty"),
    ],
)
def test_a_cloud_that_cannot_be_used_says_why(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(MessageError, match=reason):
        read_depth_points(cloud(scene_points(), **changes), (W, H), CAMERA)


def test_a_range_is_a_distance_or_no_echo() -> None:
    message = SimpleNamespace(range=2.0, field_of_view=0.1, min_range=0.2, max_range=8.0)
    assert read_range(message) == (2.0, 0.05)
    for value in (0.1, 8.0, float("inf"), float("nan")):
        message.range = value
        distance, _ = read_range(message)
        assert np.isnan(distance)
    message.range, message.max_range = 20.0, 0.0  # a driver that leaves the limits out
    assert read_range(message)[0] == 20

# SPDX-License-Identifier: Apache-2.0
"""Varied images: parts that are missing in a share of the images, and images of mirrored people."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.varied_images import (
    FARTHEST,
    NEAREST,
    ImageVariation,
    in_perspective,
    varied,
)
from deep_nrsfm_ros.data.virtual_people import FACE_KEYPOINTS, FEET_KEYPOINTS
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17, HUMAN25
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras, rotation_from_camera

F = 4000


@pytest.fixture
def images() -> Dataset:
    """Return images of one person of random places."""
    rng = np.random.default_rng(0)
    S = centre(0.3 * rng.standard_normal((F, len(HUMAN25), 3))).astype(np.float32)
    M = np.tile(np.eye(3, 2, dtype=np.float32), (F, 1, 1))
    return Dataset(S @ M, np.ones(S.shape[:2], bool), HUMAN25, "a test", S, cameras=M)


def columns(keypoints: tuple[str, ...]) -> list[int]:
    return [HUMAN25.index(name) for name in keypoints]


def test_parts_are_hidden_independently_in_their_shares_of_the_images(images: Dataset) -> None:
    visible = varied(images, ImageVariation(hidden_face=0.5, hidden_feet=0.25)).visible
    face, feet = (~visible[:, columns(part)] for part in (FACE_KEYPOINTS, FEET_KEYPOINTS))
    for hidden, share in ((face, 0.5), (feet, 0.25)):
        np.testing.assert_array_equal(hidden.all(1), hidden.any(1))
        assert hidden[:, 0].mean() == pytest.approx(share, abs=0.03)
    assert (face[:, 0] & feet[:, 0]).mean() == pytest.approx(0.125, abs=0.02)
    others = set(range(len(HUMAN25))) - set(columns(FACE_KEYPOINTS + FEET_KEYPOINTS))
    assert visible[:, sorted(others)].all()


def test_hidden_keypoints_are_0_and_the_given_images_stay(images: Dataset) -> None:
    before = images.points.copy()
    after = varied(images, ImageVariation(hidden_face=0.5, mirrored_images=0.5))
    assert not after.points[~after.visible].any()
    np.testing.assert_array_equal(images.points, before)
    assert images.visible.all()


def test_a_mirrored_image_is_that_of_the_mirrored_shape(images: Dataset) -> None:
    after = varied(images, ImageVariation(mirrored_images=0.5))
    assert after.shapes is not None
    assert images.shapes is not None
    np.testing.assert_array_equal(after.points, after.shapes[..., :2])
    changed = (after.points != images.points).any((1, 2))
    assert changed.mean() == pytest.approx(0.5, abs=0.03)
    left, right = HUMAN25.index("left_wrist"), HUMAN25.index("right_wrist")
    mirror = np.array((-1, 1, 1), np.float32)
    np.testing.assert_array_equal(
        after.shapes[changed, left], images.shapes[changed, right] * mirror
    )
    np.testing.assert_array_equal(
        after.shapes[changed, HUMAN25.index("neck")],
        images.shapes[changed, HUMAN25.index("neck")] * mirror,
    )


def test_keypoints_that_are_missing_on_one_side_are_missing_on_the_other(images: Dataset) -> None:
    left, right = HUMAN25.index("left_wrist"), HUMAN25.index("right_wrist")
    visible = images.visible.copy()
    visible[:, left] = False
    images = dataclasses.replace(images, visible=visible)
    after = varied(images, ImageVariation(mirrored_images=1.0))
    assert after.visible[:, left].all()
    assert not after.visible[:, right].any()


def test_without_variation_the_dataset_is_the_same_object(images: Dataset) -> None:
    assert varied(images, ImageVariation()) is images


@pytest.mark.parametrize(
    ("variation", "complaint"),
    [
        (ImageVariation(hidden_face=0.5), "hidden_face is 0.5, but layout .* none of"),
        (ImageVariation(hidden_feet=0.5), "hidden_feet is 0.5, but"),
        (ImageVariation(mirrored_images=0.5), "no left and right keypoints; leave"),
    ],
)
def test_a_layout_without_the_keypoints_is_refused(
    variation: ImageVariation, complaint: str
) -> None:
    with pytest.raises(ValueError, match=complaint):
        variation.check(KeypointLayout.numbered(5))
    variation.check(HUMAN17)  # it has a nose and toes


def test_a_lens_shows_near_parts_larger() -> None:
    points = np.array([[[-1, 0], [1, 0], [0, 1], [0, -1]]], float)
    depths = np.array([[1.0, -1.0, 0.0, 0.0]])  # the left is far, the right is near
    expected = np.array([[-4 / 5, 0], [4 / 3, 0], [0, 1], [0, -1]])
    W = in_perspective(points, depths, np.array([4.0]))
    np.testing.assert_allclose(W[0], expected - expected.mean(0), atol=1e-12)


def test_the_lens_looks_along_the_camera_of_the_image(images: Dataset) -> None:
    assert images.shapes is not None
    rng = np.random.default_rng(1)
    M = random_cameras(F, rng)
    seen = dataclasses.replace(images, points=images.shapes @ M, cameras=M)
    in_camera = images.shapes @ rotation_from_camera(M).swapaxes(1, 2)
    same = dataclasses.replace(
        images, points=in_camera[..., :2].copy(), shapes=in_camera.astype(np.float32)
    )
    variation = ImageVariation(perspective_images=1.0)
    np.testing.assert_allclose(
        varied(seen, variation).points, varied(same, variation).points, atol=1e-5
    )


def test_lenses_are_at_their_distances_in_a_share_of_the_images(images: Dataset) -> None:
    after = varied(images, ImageVariation(perspective_images=0.25))
    assert images.shapes is not None
    changed = (after.points != images.points).any((1, 2))
    assert changed.mean() == pytest.approx(0.25, abs=0.03)
    near, far = (
        in_perspective(images.points, images.shapes[..., 2], np.full(F, metres))
        for metres in (NEAREST, FARTHEST)
    )
    shifts = [np.linalg.norm(W - images.points, axis=(1, 2))[changed] for W in (far, near)]
    shift = np.linalg.norm(after.points - images.points, axis=(1, 2))[changed]
    assert (shift > 0.99 * shifts[0]).all()
    assert (shift < 1.01 * shifts[1]).all()
    assert after.visible.all()

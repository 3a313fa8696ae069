# SPDX-License-Identifier: Apache-2.0
"""Lifting: what goes in comes out by scale and translation, and nothing else matters."""

from __future__ import annotations

import dataclasses
import itertools
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.data.walking_person import in_layout
from deep_nrsfm_ros.data.clip import read_clip
from deep_nrsfm_ros.data.video_lifter import VideoLifter
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import COCO17, HUMAN17
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter
from deep_nrsfm_ros.lifting.options import HistoryOptions, LiftingOptions
from deep_nrsfm_ros.model_files.model_file import Model, ModelFileError, save_model
from deep_nrsfm_ros.nrsfm.metrics import shape_errors
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.training.finish import finish
from deep_nrsfm_ros.training.trainer import Trainer

N = 12
EVERY_MODEL = [
    (Architecture((12, 6), threshold, recovery, camera), scale)
    for threshold, recovery, camera, scale in itertools.product(
        ("relu", "block"), ("learned", "closed_form"), ("orthonormal", "free"), ("rms", "none")
    )
]
every_model = pytest.mark.parametrize(("architecture", "scale"), EVERY_MODEL, ids=str)


def random_model(
    architecture: Architecture | None = None,
    scale: str = "rms",
    layout: KeypointLayout = HUMAN17,
    mirrored: bool = False,
) -> Model:
    architecture = architecture or Architecture((12, 6))
    network = initialise(architecture, len(layout), np.random.default_rng(0))
    frame = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    frame *= np.linalg.det(frame) * (-1 if mirrored else 1)
    B = np.random.default_rng(3).standard_normal((3 * len(layout), 3 * len(layout)))
    covariance = (0.01 * np.eye(len(B)) + 0.003 * B @ B.T / len(B)).astype(np.float32)
    frame = frame.astype(np.float32)
    return Model("random", network, layout, Normaliser(scale), frame, error_covariance=covariance)


def pixels(n: int = N, p: int = 17, missing: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return keypoints in pixels and their confidence; at least 5 are visible."""
    rng = np.random.default_rng(2)
    points = rng.uniform(100, 600, (n, p, 2)).astype(np.float32)
    confidence = rng.uniform(0.3, 1, (n, p)).astype(np.float32)
    hidden = rng.random((n, p)) < missing
    hidden[:, :5] = False
    points[hidden] = confidence[hidden] = 0
    return points, confidence


def reprojected(lifted: Lifted) -> np.ndarray:
    return lifted.scale[:, None, None] * lifted.shapes[..., :2] + lifted.translation[:, None]


@pytest.fixture(scope="module")
def figure_model(trained: Trainer, figure: Any) -> Model:
    return finish(trained, "figure", figure.layout, "test")


@every_model
@pytest.mark.parametrize("missing", [0.0, 0.4])
def test_the_visible_points_are_reproduced(
    architecture: Architecture, scale: str, missing: float
) -> None:
    points, confidence = pixels(missing=missing)
    if scale == "none":
        points /= 500  # the unit of the data is the network's
    exact = LiftingOptions(noise=0)
    lifted = Lifter(random_model(architecture, scale), exact)(points, confidence)
    seen = confidence > 0
    size = np.ptp(points[seen])
    np.testing.assert_allclose(reprojected(lifted)[seen] / size, points[seen] / size, atol=2e-4)
    assert (lifted.scale > 0).all()


@every_model
@pytest.mark.parametrize("mirrored", [False, True])
def test_rotations_are_proper_and_shapes_stand_in_camera_axes(
    architecture: Architecture, scale: str, mirrored: bool
) -> None:
    points, confidence = pixels(missing=0.3)
    lift = Lifter(random_model(architecture, scale, mirrored=mirrored))
    lifted = lift((points / 500).astype("f4"), confidence)
    R = lifted.rotations
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.tile(np.eye(3), (N, 1, 1)), atol=1e-3)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-3)
    np.testing.assert_allclose(lifted.shapes.mean(1), 0, atol=1e-4)


def test_the_mirror_image_is_lifted_to_the_mirror_image() -> None:
    points, confidence = pixels(missing=0.3)
    lifter = Lifter(
        random_model(), LiftingOptions(correction="back_projection", test_time_mirror=True)
    )
    partners = np.array(HUMAN17.partners())
    lifted = lifter(points, confidence)
    mirrored = lifter((points * [-1, 1]).astype(np.float32)[:, partners], confidence[:, partners])
    size = np.abs(lifted.shapes).max()
    np.testing.assert_allclose(
        mirrored.shapes / size, lifted.shapes[:, partners] * [-1, 1, 1] / size, atol=1e-4
    )
    # The object's y axis points to its left.
    np.testing.assert_allclose(
        mirrored.rotations, lifted.rotations * [[-1, 1, -1], [1, -1, 1], [1, -1, 1]], atol=1e-4
    )
    alone = Lifter(random_model(), LiftingOptions())(points, confidence)
    assert np.abs(alone.shapes - lifted.shapes).max() > 0.01 * size


def test_types_and_shapes() -> None:
    lifted = Lifter(random_model())(*pixels())
    expected = ((N, 17, 3), (N, 3, 3), (N,), (N, 2), (N,), (N, 17), (N, 17))
    assert tuple(array.shape for array in lifted) == expected
    assert [array.dtype for array in lifted] == [np.float32] * 6 + [np.bool_]
    assert all(len(array) == 0 for array in Lifter(random_model())(*pixels(0)))


@pytest.mark.parametrize("correction", ["learned", "back_projection"])
def test_noise_keeps_the_shape_off_the_keypoints(correction: str) -> None:
    points, confidence = pixels()

    def distance(**options: Any) -> float:
        lifted = Lifter(random_model(), LiftingOptions(**options))(points, confidence)
        return float(np.linalg.norm(reprojected(lifted) - points))

    exact, noisy, noisier = (distance(correction=correction, noise=n) for n in (0.0, 0.2, 1.0))
    assert 200 * exact < noisy < noisier < distance(correction="none")


def test_back_projection_leaves_the_depth(figure_model: Model, figure: Any) -> None:
    confidence = np.ones((N, 12), np.float32)

    def lifted(correction: str) -> np.ndarray:
        options = LiftingOptions(correction=correction, noise=0.0)
        found = Lifter(figure_model, options)(figure.points[:N], confidence)
        return found.shapes * found.scale[:, None, None]

    alone, moved, learned = map(lifted, ("none", "back_projection", "learned"))
    size = (moved / alone)[:, :1, 2]  # of each object, whose scale is fitted anew
    np.testing.assert_allclose(moved[..., 2], alone[..., 2] * size, rtol=1e-3)
    assert np.abs(learned[..., 2] - alone[..., 2]).max() > 0.01


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_place_and_size_in_the_image_do_not_change_the_shape(
    figure_model: Model, figure: Any, missing: float
) -> None:
    points = figure.points[:N]
    confidence = (np.random.default_rng(0).random((N, 12)) >= missing).astype(np.float32)
    confidence[:, :5] = 1
    lift = Lifter(figure_model)
    here, there = (
        lift(points, confidence),
        lift(200 * points + np.array([800, 300], np.float32), confidence),
    )
    np.testing.assert_allclose(there.shapes, here.shapes, atol=2e-3)
    np.testing.assert_allclose(there.rotations, here.rotations, atol=2e-3)
    np.testing.assert_allclose(there.residual, here.residual, atol=1e-3)
    np.testing.assert_allclose(there.scale, 200 * here.scale, rtol=2e-3)
    moved = 200 * here.translation + [800, 300]
    np.testing.assert_allclose(there.translation, moved, atol=0.5)


def test_what_a_missing_point_holds_does_not_matter() -> None:
    points, confidence = pixels(missing=0.4)
    garbage = np.where(confidence[..., None] > 0, points, np.float32(-5000))
    lift = Lifter(random_model())
    for a, b in zip(lift(points, confidence), lift(garbage, confidence), strict=True):
        np.testing.assert_array_equal(a, b)


def test_refilling_brings_the_missing_points_closer(figure_model: Model, figure: Any) -> None:
    points, shapes = figure.points[:500], figure.shapes[:500]
    confidence = np.ones((500, 12), np.float32)
    confidence[np.arange(500), np.arange(500) % 12] = 0
    errors = [
        shape_errors(Lifter(figure_model, LiftingOptions(refill=n))(points, confidence)[0], shapes)
        for n in (0, 1, 4)
    ]
    assert errors[0].proper > errors[1].proper > errors[2].proper
    assert errors[2].proper < 0.8 * errors[0].proper


def test_more_visible_points_than_a_model_has_are_refused() -> None:
    model = random_model()
    with pytest.raises(ValueError, match=r"min_visible is 40, .* 17 keypoints, .*at most 15"):
        Lifter(model, LiftingOptions(min_visible=40))
    with pytest.raises(ValueError, match="min_visible is 16"):  # neck and mid-hip follow
        Lifter(model, LiftingOptions(min_visible=16))
    points, confidence = pixels()
    assert np.isfinite(Lifter(model, LiftingOptions(min_visible=15))(points, confidence)[0]).all()


def test_more_visible_points_than_a_layout_has_are_refused() -> None:
    points, _ = in_layout(COCO17, 3)
    wrong = "min_visible is 20, but layout 'coco17' has 17 keypoints of model 'human', .* most 17"
    with pytest.raises(ValueError, match=wrong):
        Lifter("human", LiftingOptions(min_visible=20), layout="coco17")(points)
    lifter = Lifter("human", LiftingOptions(min_visible=17), layout="coco17")
    assert np.isfinite(lifter(points).shapes).all()


@pytest.mark.parametrize("min_visible", [3, 4, 7])
def test_too_few_visible_points_are_not_lifted_and_disturb_nobody(min_visible: int) -> None:
    points, confidence = pixels(missing=0.3)
    for i, visible in enumerate((0, 1, min_visible - 1, min_visible)):
        confidence[i] = np.arange(17) < visible
        points[i, visible:] = 0
    lift = Lifter(random_model(), LiftingOptions(min_visible=min_visible))
    lifted = lift(points, confidence)
    shown = confidence > 0
    derived = shown[:, [0, 1, 12]].all(1) + 0 + shown[:, [6, 7, 13]].all(1)  # neck, mid-hip
    enough = shown.sum(1) - derived >= min_visible
    assert not enough[:3].any() and enough[3:].any()
    for array in lifted[:-2]:
        assert np.isnan(array[~enough]).all() and np.isfinite(array[enough]).all()
    assert (lifted.confidence[~enough] == 0).all() and (lifted.confidence[enough] > 0).any()
    both = zip(lifted.at(enough), lift(points[enough], confidence[enough]), strict=True)
    for among, alone in both:
        np.testing.assert_allclose(among.astype(float), alone.astype(float), rtol=1e-4, atol=1e-4)


@every_model
@pytest.mark.parametrize("kind", ["one place", "one line"])
def test_points_that_say_nothing_of_the_camera_are_not_lifted(
    architecture: Architecture, scale: str, kind: str
) -> None:
    points, confidence = pixels()
    along = points[0, :, :1] if kind == "one line" else 0
    points[0] = np.array([300, 200], np.float32) + along * np.array([1, 0.5], np.float32)
    lift = Lifter(random_model(architecture, scale))
    lifted = lift((points / 500).astype("f4"), confidence)
    assert all(np.isnan(array[0]).all() for array in lifted[:-2])
    assert (lifted.confidence[0] == 0).all() and not lifted.wrong[0].any()
    assert all(np.isfinite(array[1:]).all() for array in lifted)


def test_a_batch_is_its_objects_one_by_one() -> None:
    points, confidence = pixels(missing=0.3)
    confidence[1], confidence[2] = 1, 0
    lift = Lifter(random_model())
    together = lift(points, confidence)
    for i in range(N):
        alone = lift(points[i : i + 1], confidence[i : i + 1])
        for a, b in zip(together, alone, strict=True):
            np.testing.assert_allclose(a[i], b[0], rtol=2e-3, atol=1e-3)


@pytest.mark.parametrize("length", [1.0, 0.5, 480.0])
def test_reference_length(length: float) -> None:
    options = LiftingOptions(reference_length=length)
    shapes = Lifter(random_model(), options)(*pixels()).shapes
    neck, hip = HUMAN17.index("neck"), HUMAN17.index("mid_hip")
    found = np.linalg.norm(shapes[:, neck] - shapes[:, hip], axis=1)
    np.testing.assert_allclose(found, length, rtol=1e-4)
    nameless = random_model(layout=KeypointLayout.numbered(17))
    shapes = Lifter(nameless, options)(*pixels()).shapes
    np.testing.assert_allclose((shapes**2).sum(2).mean(1) ** 0.5, length, rtol=1e-4)


@pytest.mark.parametrize(
    ("options", "given", "complaint"),
    [
        (LiftingOptions, {"correction": "foo"}, "correction is 'foo'; choose one of bones, lear"),
        (LiftingOptions, {"reference_length": -1}, "reference_length is -1; it must be at least 0"),
        (LiftingOptions, {"noise": float("nan")}, "noise is nan; it must be at least 0 and at"),
        (LiftingOptions, {"noise": "0.1"}, "noise is '0.1'; it must be a number"),
        (LiftingOptions, {"refill": -3}, "refill is -3; it must be at least 0 and at most 50"),
        (HistoryOptions, {"shape_time": -1}, "shape_time is -1; it must be at least 0"),
    ],
)
def test_an_option_out_of_its_range_is_refused(
    options: Any, given: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(ValueError, match=f"^{complaint}"):
        options(**given)


def test_a_lifter_says_what_looks_wrong_where_it_is_asked() -> None:
    view = read_clip().session.views[0]
    lifter = Lifter("human", layout="body25b")
    assert lifter.check(view.points, view.confidence) == []
    assert lifter.check(view.points[0], view.confidence[0]) == []
    upside_down = view.points * [1, -1] + [0, 1920]
    (said,) = [each for each in lifter.check(upside_down, view.confidence) if "upside" in each]
    assert "y points up, and must point down" in said and "--" not in said
    assert "confidence" in lifter.check(view.points, 100 * view.confidence)[0]
    assert any("relative to it" in each for each in lifter.check(*relative_to_the_first(view)))


def relative_to_the_first(view: Any) -> tuple[np.ndarray, np.ndarray]:
    return view.points - view.points[:, :1], np.ones(view.points.shape[:2])


def test_an_argument_of_another_type_is_refused() -> None:
    model: Any = random_model()
    with pytest.raises(TypeError, match=r"options is a dict; give LiftingOptions\(NAME=VALUE\)"):
        Lifter(model, {"noise": 1})  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="history is a bool; give HistoryOptions"):
        Lifter(model, history=True)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"model is a NoneType; give load_model\('human'\)"):
        Lifter(None)  # type: ignore[arg-type]


def test_a_model_may_be_given_by_its_name(tmp_path: Path) -> None:
    save_model(tmp_path / "mine.safetensors", random_model())
    assert Lifter(tmp_path / "mine.safetensors").model.name == "mine"
    assert Lifter("human", layout="coco17").model.name == "human"
    with pytest.raises(ModelFileError, match="no model 'humna'; there are"):
        Lifter("humna")


def test_the_reference_length_is_that_of_the_object_unless_another_is_asked_for() -> None:
    described = dataclasses.replace(HUMAN17, reference_length=0.52)
    pair = [HUMAN17.index(name) for name in HUMAN17.reference or ()]
    unknown = dataclasses.replace(HUMAN17, reference_length=None)
    for layout, length, height, expected in (
        (described, 0.0, 0.0, 0.52),
        (described, 2.0, 0.0, 2.0),
        (unknown, 0.0, 0.0, 1.0),
        (HUMAN17, 0.0, 0.0, 0.5),
        (HUMAN17, 0.0, 1.4, 0.4),
        (HUMAN17, 0.6, 1.4, 0.6),
    ):
        options = LiftingOptions(reference_length=length, person_height=height)
        neck, hip = (
            Lifter(random_model(layout=layout), options)(*pixels()).shapes[:, pair].swapaxes(0, 1)
        )
        np.testing.assert_allclose(np.linalg.norm(neck - hip, axis=1), expected, rtol=1e-4)


def test_confidence_falls_where_less_is_known(figure_model: Model, figure: Any) -> None:
    points = np.repeat(figure.points[:1], 3, 0)
    points[1] += 0.5 * np.random.default_rng(0).standard_normal(points[1].shape)
    confidence = np.ones((3, 12), np.float32)
    confidence[2, :2] = [0.4, 0]
    lifted = Lifter(figure_model)(points, confidence)
    whole, noisy, partial = lifted.confidence
    assert lifted.residual[0] < 0.1 < lifted.residual[1]
    assert (noisy < whole).all() and partial.mean() < whole.mean()
    odds = partial / (1 - partial) * (1 - whole) / whole
    assert (odds < 1).all() and odds[:2].mean() < odds[2:].mean()
    np.testing.assert_allclose(lifted.object_confidence, lifted.confidence.mean(1))
    assert ((lifted.confidence > 0) & (lifted.confidence < 1)).all()


def test_confidence_does_not_depend_on_the_size(figure_model: Model, figure: Any) -> None:
    points, confidence = figure.points[:N], np.ones((N, 12), np.float32)
    small, large = (
        Lifter(figure_model, LiftingOptions(reference_length=length))(scale * points, confidence)
        for length, scale in ((0.1, 1), (50.0, 300))
    )
    np.testing.assert_allclose(small.confidence, large.confidence, rtol=1e-3)


def test_where_the_model_errs_more_confidence_is_less(figure_model: Model, figure: Any) -> None:
    worse = np.diag(np.where(np.arange(36) < 3, 4, 1)).astype(np.float32)
    lifters = (
        Lifter(dataclasses.replace(figure_model, error_covariance=c))
        for c in (0.01 * np.eye(36, dtype=np.float32), 0.01 * worse)
    )
    even, doubted = (
        lift(figure.points[:N], np.ones((N, 12), np.float32)).confidence for lift in lifters
    )
    assert (doubted[:, 0] < 0.9 * even[:, 0]).all()


def test_a_detector_that_lacks_keypoints_has_the_covariance_of_their_absence() -> None:
    usual = random_model()
    hidden = 3 * usual.error_covariance
    model = dataclasses.replace(usual, hidden_keypoints=("nose",), hidden_covariance=hidden)
    expected = dataclasses.replace(usual, error_covariance=hidden)
    others = tuple(name for name in HUMAN17.keypoints if name != "nose")
    points, confidence = pixels()
    for names, same in ((HUMAN17.keypoints, usual), (others, expected)):
        at = [HUMAN17.index(name) for name in names]
        found, alone = (
            Lifter(m, layout=KeypointLayout("detector", names))(points[:, at], confidence[:, at])
            for m in (model, same)
        )
        np.testing.assert_array_equal(found.shapes, alone.shapes)


@pytest.mark.parametrize(
    ("points", "confidence"), [((2, 16, 2), (2, 16)), ((2, 17, 3), (2, 17)), ((2, 17, 2), (1, 17))]
)
def test_arrays_that_do_not_fit_the_model_are_refused(
    points: tuple[int, ...], confidence: tuple[int, ...]
) -> None:
    with pytest.raises(ValueError, match=r"'random' needs \(n, 17, 2\)") as caught:
        Lifter(random_model()).lift(np.ones(points, np.float32), np.ones(confidence, np.float32))
    assert str(points) in str(caught.value)


def test_lifting_does_not_import_torch() -> None:
    code = "import sys, deep_nrsfm_ros.lifting.lifter; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


def test_a_quarter_turn_of_the_image_turns_the_shape_and_the_camera() -> None:
    points, confidence = pixels()
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.float32)
    lift = Lifter(random_model(), LiftingOptions(test_time_rotations=4))
    upright, turned = lift(points, confidence), lift(points @ quarter[:2, :2].T, confidence)
    np.testing.assert_allclose(turned.shapes, upright.shapes @ quarter.T, atol=1e-4)
    np.testing.assert_allclose(turned.rotations, quarter @ upright.rotations, atol=1e-4)
    single = Lifter(random_model(), LiftingOptions(test_time_rotations=1))
    apart = single(points @ quarter[:2, :2].T, confidence).shapes
    assert np.abs(apart - single(points, confidence).shapes @ quarter.T).max() > 1e-2


@pytest.mark.parametrize("perspective", [False, True])
def test_mirrored_objects_are_lifted_as_the_model_s_own(perspective: bool) -> None:
    points, confidence = pixels(missing=0.2)
    if perspective:
        points = ((points - points.mean(1, keepdims=True)) / 1000).astype(np.float32)
    model, image = random_model(), np.array([-1, 1], np.float32)
    own, mirrored = (
        Lifter(model, LiftingOptions(mirrored=mirrored)).lift(
            points * image**mirrored, confidence, perspective=perspective
        )
        for mirrored in (False, True)
    )
    np.testing.assert_allclose(mirrored.shapes, own.shapes * [-1, 1, 1], atol=1e-5)
    np.testing.assert_allclose(mirrored.translation, own.translation * image, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(mirrored.rotations), 1, atol=1e-4)
    # In object axes, whose y points to the left, the mirror image has the other left.
    in_object = [S.shapes @ S.rotations for S in (own, mirrored)]
    np.testing.assert_allclose(in_object[1], in_object[0] * [1, -1, 1], atol=1e-5)
    np.testing.assert_array_equal(mirrored.confidence, own.confidence)


def test_mirrored_objects_over_time_and_under_gravity() -> None:
    points, confidence = pixels(6)
    model, up = random_model(), np.array([0.3, -0.9, 0.1])
    results = []
    for mirrored in (False, True):
        signs = np.array([-1, 1, 1]) ** mirrored
        lifter = Lifter(model, LiftingOptions(mirrored=mirrored))
        memory = lifter.memory()
        for i in range(6):
            context = memory(("hand",), i / 30)._replace(up=up / np.linalg.norm(up) * signs)
            lifted = lifter.lift(
                points[i : i + 1] * signs[:2].astype(np.float32),
                confidence[i : i + 1],
                context=context,
            )
        results.append(lifted.shapes * signs)
    np.testing.assert_allclose(results[0], results[1], atol=1e-5)


def test_confidences_on_another_scale_are_said() -> None:
    lifter = Lifter("human", layout="coco17")
    points, confidence = in_layout(COCO17, 5)
    with pytest.warns(UserWarning, match="it must be 0 to 1.*divide it by 100") as found:
        lifter(points, 90 * confidence)
    assert found[0].filename == __file__
    with pytest.warns(UserWarning, match="it must be 0 to 1"):
        VideoLifter(lifter)(points, 90 * confidence)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lifter(points, confidence)
        lifter(points, 2 * (confidence > 0))  # COCO's visibility
        lifter(points, confidence > 0)


def test_what_a_mask_hides_is_missing() -> None:
    lifter = Lifter("human", layout="coco17")
    points, confidence = in_layout(COCO17, 5)
    is_hidden = np.zeros((5, 17), bool)
    is_hidden[:, 7:9] = True
    expected = lifter(np.where(is_hidden[..., None], np.nan, points), confidence)
    for masked in (
        (np.ma.array(points, mask=np.stack([is_hidden] * 2, -1)), confidence),
        (points, np.ma.array(confidence, mask=is_hidden)),
        (points, np.ma.array(confidence, mask=False) * ~is_hidden),
    ):
        np.testing.assert_allclose(lifter(*masked).shapes, expected.shapes, atol=1e-6)
    whole = np.round(points).astype(int)
    found = lifter(np.ma.array(whole, mask=np.stack([is_hidden] * 2, -1)))
    expected = lifter(whole, ~is_hidden)
    np.testing.assert_allclose(found.shapes, expected.shapes, atol=1e-6)


def test_names_of_an_npz_are_a_layout() -> None:
    points, _ = in_layout(COCO17, 3)
    found = Lifter("human", layout=np.array(COCO17.keypoints))(points)
    np.testing.assert_array_equal(found.shapes, Lifter("human", layout="coco17")(points).shapes)

# SPDX-License-Identifier: Apache-2.0
"""Arrays are read by their shapes and the words in their names; what is not used is said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.data.detections import Detections
from deep_nrsfm_ros.data.formats.array_names import Header, find_roles
from deep_nrsfm_ros.data.formats.overlap import overlap_in_turn
from deep_nrsfm_ros.data.keypoint_files import KeypointFileError, read_keypoints
from deep_nrsfm_ros.data.read_options import ReadOptions

F, P, Q = 12, 2, 17
RNG = np.random.default_rng(0)
# Two people who walk slowly side by side: (frames, people, keypoints, x and y).
PEOPLE = (
    RNG.uniform(0, 200, (1, P, Q, 2))
    + np.array([[0, 0], [600, 0]])[None, :, None]
    + 5 * np.arange(1, F + 1)[:, None, None, None]
)
ROWS = PEOPLE.reshape(F * P, Q, 2)
FRAME = np.repeat(np.arange(F), P)
SURE = RNG.uniform(0.2, 1, (F * P, Q))


def npz(folder: Path, rate: float | None = None, **arrays: Any) -> Detections:
    np.savez(folder / "a.npz", **arrays)
    return read_keypoints(folder / "a.npz", ReadOptions(rate=rate))


def npy(folder: Path, array: np.ndarray) -> Detections:
    np.save(folder / "a.npy", array)
    return read_keypoints(folder / "a.npy")


def codes(found: Detections) -> list[str]:
    return [finding.code for finding in found.findings]


@pytest.mark.parametrize(
    "name", ["conf", "confidences", "keypoint_scores", "visibility", "likelihood", "scores"]
)
@pytest.mark.parametrize("shape", [(F * P, Q), (F * P, Q, 1)])
def test_confidence_under_another_name(name: str, shape: tuple[int, ...], tmp_path: Path) -> None:
    arrays: dict[str, Any] = {name: SURE.reshape(shape)}
    found = npz(tmp_path, points=ROWS, **arrays)
    np.testing.assert_allclose(found.confidence, SURE, rtol=1e-6)
    assert f"taken: `{name}` for the confidence" in found.notes and not found.findings


def test_visibility_may_be_true_or_false(tmp_path: Path) -> None:
    found = npz(tmp_path, points=ROWS, visible=SURE > 0.5)
    np.testing.assert_array_equal(found.confidence > 0, SURE > 0.5)


@pytest.mark.parametrize(
    ("name", "times"),
    [
        ("timestamps", np.arange(F) / 10),
        ("time", 1714557600 + np.arange(F) / 10),
        ("t_ms", np.arange(F) * 100),
        ("frame_time", np.arange(F) * 0.1),
        ("timestamp_ns", np.arange(F) * 100_000_000),
        ("timestamps", np.repeat(np.arange(F) / 10, P)),
    ],
)
@pytest.mark.parametrize("form", ["rows", "grid", "times"])
def test_times_under_another_name(form: str, name: str, times: Any, tmp_path: Path) -> None:
    arrays: dict[str, Any] = {"points": ROWS, "frame": FRAME}
    if form == "grid":
        arrays = {"points": PEOPLE}
    if form == "times":  # objects of one time are of one frame
        arrays = {"points": ROWS}
        times = times if len(times) == F * P else np.repeat(times, P)
    found = npz(tmp_path, **arrays, **{name: times})
    np.testing.assert_array_equal(found.frame, FRAME)
    np.testing.assert_allclose(np.diff(found.stamps), 100_000_000, atol=1000)
    np.testing.assert_allclose(found.points, ROWS, rtol=1e-6)
    assert not found.findings and any(f"`{name}`" in note for note in found.notes)
    with pytest.raises(KeypointFileError, match="leave out --rate"):
        npz(tmp_path, 5, **arrays, **{name: times})


def test_fractions_are_no_frames_and_no_nanoseconds(tmp_path: Path) -> None:
    with pytest.raises(KeypointFileError, match="`frame` has fractions; whole numbers are needed"):
        npz(tmp_path, points=ROWS, frame=FRAME / 10)
    found = npz(tmp_path, points=ROWS, frame=FRAME.astype(float), stamps=np.arange(F) / 10)
    np.testing.assert_allclose(np.diff(found.stamps), 1e8, atol=1000)
    assert "its times (`stamps`) are taken for seconds" in found.notes


@pytest.mark.parametrize("unit", ["us", "µs", "μs"])  # the sign of micro, and the Greek letter
def test_microseconds_are_no_seconds(unit: str, tmp_path: Path) -> None:
    times: dict[str, Any] = {f"timestamps_{unit}": np.arange(F) * 1e5}
    found = npz(tmp_path, points=ROWS, frame=FRAME, **times)
    np.testing.assert_allclose(np.diff(found.stamps), 1e8, atol=1000)


def test_times_that_are_none_are_said(tmp_path: Path) -> None:
    for times in (RNG.uniform(0, 1, F * P), np.arange(5) / 10, np.full(F * P, np.nan)):
        found = npz(tmp_path, points=ROWS, frame=FRAME, timestamps=times)
        assert codes(found) == ["unused"] and "array timestamps," in str(found.findings[0])
    found = npz(tmp_path, points=ROWS, inference_time=RNG.uniform(0, 1, F * P))
    assert not found.findings and found.notes == ("not used: arrays inference_time",)


def test_python_objects_are_no_cause_for_doubt(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, points=ROWS, ids=np.array(["anna"] * len(ROWS), object))
    found = read_keypoints(path)
    assert not found.findings and found.notes == ("not used: arrays ids (Python objects)",)


def test_frames_a_second(tmp_path: Path) -> None:
    found = npz(tmp_path, points=ROWS, fps=10)
    assert found.stamps[1] == 100_000_000
    assert npz(tmp_path, 10, points=ROWS, fps=10).stamps[1] == 100_000_000
    with pytest.raises(KeypointFileError, match="`fps` 10: leave out --rate 25"):
        npz(tmp_path, 25, points=ROWS, fps=np.array([10]))
    with pytest.raises(KeypointFileError, match="`fps` is 0, no number of frames"):
        npz(tmp_path, points=ROWS, fps=0)


def test_numbers_and_identities_under_other_names(tmp_path: Path) -> None:
    ids = np.array([7, 3] * F)
    found = npz(tmp_path, points=ROWS, frame_idx=FRAME * 3 + 100, track_ids=ids)
    np.testing.assert_array_equal(found.frame, FRAME)
    np.testing.assert_array_equal(found.frames.numbers, np.arange(F) * 3 + 100)
    np.testing.assert_allclose(np.diff(found.stamps), 1e8, atol=1)
    assert found.identities[:2].tolist() == ["7", "3"] and not found.findings
    found = npz(tmp_path, points=ROWS, frame=FRAME, person_id=np.where(ids == 7, np.nan, ids))
    assert found.identities[:2].tolist() == ["", "3"]
    found = npz(tmp_path, points=ROWS, frame_no=FRAME + 0.5)
    assert codes(found) == ["unused"] and len(found.stamps) == F * P


def test_what_is_not_used_is_said_and_suspicious_only_by_its_shape(tmp_path: Path) -> None:
    others: dict[str, Any] = {
        "category_id": np.ones(F * P),
        "bbox": np.ones((F * P, 4)),
        "truth": np.ones((F * P, Q, 3)),
        "animal_shape": np.ones((3, 4)),
    }
    found = npz(tmp_path, points=ROWS, **others)
    assert found.notes == ("not used: arrays truth, animal_shape",) and not found.findings
    found = npz(tmp_path, points=ROWS, animal=np.full(F * P, True))
    assert codes(found) == ["unused"]
    assert str(found.findings[0]).endswith(
        "animal (is it an identity?); call it 'identities' if it is"
    )
    assert not npz(tmp_path, points=ROWS, frame=FRAME, frame_no=FRAME).findings


def test_arrays_under_their_own_names_go_first() -> None:
    shape = (F * P, Q)
    headers = {
        "points": Header((*shape, 2), "f"),
        "conf": Header(shape, "f"),
        "confidence": Header(shape, "f"),
        "time": Header((F * P,), "f"),
        "stamps": Header((F * P,), "i"),
        "scores": Header((F * P,), "f"),
        "score": Header((F * P,), "f"),
        "bodyparts": Header((Q,), "U"),
    }
    assert find_roles(headers) == {
        "points": "points",
        "confidence": "confidence",
        "stamps": "stamps",
        "scores": "scores",
        "names": "bodyparts",
    }


def test_an_npz_may_have_frames_of_as_many_objects(tmp_path: Path) -> None:
    points = PEOPLE.copy()
    points[3, 1] = 0
    found = npz(tmp_path, points=points, conf=SURE.reshape(F, P, Q), ids=np.full((F, P), [4, 9]))
    np.testing.assert_array_equal(found.frame, FRAME)
    assert found.is_padding.sum() == 1 and found.identities[:2].tolist() == ["4", "9"]
    np.testing.assert_allclose(found.confidence[8:], SURE[8:], rtol=1e-6)


@pytest.mark.parametrize("width", [2, 3])
@pytest.mark.parametrize("people", [1, 2])
def test_people_before_frames_are_said(people: int, width: int, tmp_path: Path) -> None:
    points = np.concatenate([PEOPLE, np.ones((F, P, Q, 1))], -1)[:, :people, :, :width]
    assert not npy(tmp_path, points).findings
    for found in (
        npy(tmp_path, points.transpose(1, 0, 2, 3)),
        npz(tmp_path, points=points.transpose(1, 0, 2, 3)),
    ):
        assert codes(found) == ["one-frame"]
        assert "transpose(1, 0, 2, 3)" in str(found.findings[0])


def test_a_crowd_is_no_series(tmp_path: Path) -> None:
    people = RNG.uniform(0, 200, (3, 30, Q, 2)) + RNG.uniform(0, 2000, (1, 30, 1, 2))
    assert not npy(tmp_path, people).findings
    assert overlap_in_turn(people) < 0.1 < 0.7 < overlap_in_turn(people.swapaxes(0, 1))
    assert overlap_in_turn(np.zeros((2, 8, Q, 2))) == 0
    assert not npy(tmp_path, np.zeros((0, 8, Q, 2))).findings


def test_objects_of_one_frame_on_each_other_are_said(tmp_path: Path) -> None:
    found = npz(tmp_path, points=PEOPLE[:, 0], frame=np.zeros(F, int))
    assert codes(found) == ["one-frame"] and "leave `frame` out" in str(found.findings[0])


def test_a_depth_is_no_confidence(tmp_path: Path) -> None:
    z = RNG.uniform(-0.2, 0.2, (F, Q, 1))
    for points in (PEOPLE[:, 0], PEOPLE):
        depth = np.broadcast_to(z[:, None], (F, P, Q, 1)) if points.ndim == 4 else z
        for found in (
            npy(tmp_path, np.concatenate([points, depth], -1)),
            npz(tmp_path, points=np.concatenate([points, depth], -1)),
        ):
            assert (found.confidence == 1).all() and "it is a depth" in found.warnings[0]
    given = np.where(RNG.random((F, Q, 1)) < 0.3, -1, 0.9)  # -1: missing
    assert not npy(tmp_path, np.concatenate([PEOPLE[:, 0], given], -1)).warnings


def test_three_coordinates_are_said(tmp_path: Path) -> None:
    z = RNG.uniform(-800, 800, (F, Q, 1))
    found = npy(tmp_path, np.concatenate([PEOPLE[:, 0], z], -1))
    assert codes(found) == ["depth"] and (found.confidence == 1).all() and not found.warnings
    assert "save points[..., :2]" in str(found.findings[0])


def test_four_numbers_are_those_of_mediapipe(tmp_path: Path) -> None:
    values = RNG.uniform(1, 500, (F, 33, 4))
    values[..., 3] = RNG.uniform(0.1, 1, (F, 33))
    found = npy(tmp_path, values)
    np.testing.assert_allclose(found.confidence, values[..., 3], rtol=1e-6)
    np.testing.assert_allclose(found.points, values[..., :2], rtol=1e-6)
    assert not found.warnings
    assert "x, y, z, confidence" in npy(tmp_path, values[:, :20]).warnings[0]


@pytest.mark.parametrize(
    ("arrays", "expected"),
    [
        ({"keypoints": ROWS}, r"np.savez\(NEW, points=np.load\(FILE\)\['keypoints'\]\)"),
        ({"arr_0": ROWS, "arr_1": np.ones(3)}, r"points=np.load\(FILE\)\['arr_0'\]\)"),
        ({"a": ROWS, "b": ROWS}, "there are: `a`, `b`$"),
        ({"points": PEOPLE[None]}, r"save a part of it, such as points\[0\]"),
        ({"points": PEOPLE[:, :1, None]}, r"such as points\[:, 0\]"),
        ({"points": np.ones((5, 132))}, r"save points.reshape\(5, 33, 4\)"),
    ],
)
def test_the_way_to_an_array_that_is_read(
    arrays: dict[str, Any], expected: str, tmp_path: Path
) -> None:
    with pytest.raises(KeypointFileError, match=expected):
        npz(tmp_path, **arrays)

# SPDX-License-Identifier: Apache-2.0
"""A training chooses the layout of keypoints of which nothing says it, as `lift` does."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.data.walking_person import IMAGE, in_layout
from deep_nrsfm_ros.commands.train import parser
from deep_nrsfm_ros.data.bags import Frame, frames, write_bag
from deep_nrsfm_ros.data.clip import read_clip
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import BODY25, COCO17, HUMAN17, HUMAN25, LAYOUTS
from deep_nrsfm_ros.training.config import TrainingConfig
from deep_nrsfm_ros.training.data_check import sentences, serious
from deep_nrsfm_ros.training.preparation import ReadData, read_data
from deep_nrsfm_ros.training.reporter import Reporter
from test.fixtures.training_program import RunTraining


def write(path: Path, layout: KeypointLayout, count: int = 60) -> Path:
    """Write a person who walks, without a name of keypoints or layout: a file or a bag."""
    points, confidence = in_layout(layout, count)
    if path.suffix == ".npz":
        np.savez(path, points=points, confidence=confidence)
    elif path.suffix == ".npy":
        np.save(path, points)
    elif path.suffix == ".json":
        triples = np.concatenate([points, confidence[..., None]], -1).reshape(count, -1)
        frames_ = [{"people": [{"pose_keypoints_2d": row}]} for row in triples.tolist()]
        path.write_text(json.dumps(frames_))
    else:
        write_bag(path, "/keypoints", frames(points, confidence))
    return path


def expected(layout: KeypointLayout, target: KeypointLayout = HUMAN25) -> np.ndarray:
    return KeypointMap(layout, target)(*in_layout(layout))[0]


def read(*words: str | Path) -> ReadData:
    """Return the data that a command line names."""
    config = TrainingConfig.from_arguments(parser().parse_args(list(map(str, words))))
    return read_data(config, Reporter(as_json=False, should_stop=lambda: False))


def faults(found: ReadData) -> list[str]:
    """Return a sentence for each thing in the data that makes a model doubtful."""
    return sentences(serious(found.findings))


@pytest.mark.parametrize("option", ["--bag", "--input"])
@pytest.mark.parametrize("layout", [BODY25, COCO17], ids=lambda layout: layout.name)
def test_a_bag_is_taken_in_the_layout_that_fits(
    option: str, layout: KeypointLayout, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = read(option, write(tmp_path / "bag", layout))
    np.testing.assert_array_equal(found.dataset.points, expected(layout))
    assert found.detector_layout == layout.name
    said = capsys.readouterr().err
    assert f"bag: keypoint layout {layout.name}: it fits with residual 0.0" in said
    assert said.endswith("; --keypoint-layout NAME takes another\n")


@pytest.mark.parametrize("name", ["a.npz", "a.npy", "a.json"])
def test_a_file_is_taken_in_the_layout_that_fits(name: str, tmp_path: Path) -> None:
    found = read("--input", write(tmp_path / name, COCO17), "--from", "none")
    assert found.detector_layout == "coco17"
    is_seen = found.dataset.visible[..., None]
    np.testing.assert_allclose(found.dataset.points, expected(COCO17) * is_seen, rtol=1e-5)


def test_each_bag_and_file_is_taken_by_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for i in range(5):
        write(tmp_path / f"{i}.npz", COCO17)
    write(tmp_path / "b.npy", BODY25)
    bag = write(tmp_path / "bag", HUMAN17)
    other = write(tmp_path / "other", BODY25)
    found = read("--bag", bag, "--bag", other, "--input", tmp_path, "--object", "human17")
    layouts = (HUMAN17, BODY25, *[COCO17] * 5, BODY25)
    together = np.concatenate([expected(layout, HUMAN17) for layout in layouts])
    seen = found.dataset.visible[..., None]
    np.testing.assert_allclose(found.dataset.points * seen, together * seen, rtol=1e-5)
    assert found.detector_layout == ""  # they are of several detectors
    said = capsys.readouterr().err
    assert "0.npz, 1.npz, 2.npz and 2 more: keypoint layout coco17: " in said
    assert "bag: keypoint layout human17: " in said
    assert "other, b.npy: keypoint layout body25: " in said


def test_files_of_one_form_share_a_layout(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    body, keypoints = len(COCO17), list[Path]()
    for i, view in enumerate(read_clip().session.views):
        data = np.concatenate([view.points, view.confidence[..., None]], -1)[:, :body]
        keypoints.append(tmp_path / f"{i}.npy")
        np.save(keypoints[-1], data)
    found = read("--input", tmp_path)
    said = capsys.readouterr().err
    assert "0.npy, 1.npy, 2.npy and 1 more: keypoint layout coco17: it fits" in said
    assert found.detector_layout == "coco17" and "ambiguous" not in said


def test_normalised_files_have_the_layout_of_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points, confidence = in_layout(BODY25)
    wide = points * np.array([1, 3]) / (3 * np.max(points))
    for i in range(3):
        np.savez(tmp_path / f"{i}.npz", points=wide * (1 - 0.1 * i), confidence=confidence)
    read("--input", tmp_path)
    said = capsys.readouterr().err
    alone = "keypoint layout body25: a guess, since the keypoints are normalised; "
    assert "0.npz, 1.npz, 2.npz: " + alone in said
    assert "poor fit" not in said and "ambiguous" not in said
    write(tmp_path / "pixels.npz", BODY25)
    found = read("--input", tmp_path)
    assert found.detector_layout == "body25"
    (fault,) = faults(found)
    assert fault.startswith("0.npz, 1.npz, 2.npz: ") and "they are normalised" in fault
    said = capsys.readouterr().err
    assert "2.npz and 1 more: keypoint layout body25: it fits with residual 0.0" in said


def test_the_layout_that_the_user_names_is_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    posetrack = LAYOUTS["posetrack18_17"]  # its keypoints fit as coco17, too
    named = ("--input", write(tmp_path / "a.npz", posetrack), "--keypoint-layout", posetrack.name)
    found = read(*named)
    np.testing.assert_array_equal(found.dataset.points, expected(posetrack))
    assert found.detector_layout == posetrack.name and not capsys.readouterr().err


@pytest.mark.parametrize("option", ["--bag", "--input"])
@pytest.mark.parametrize("target", ["human25", "human17"])
def test_a_layout_that_is_clearly_wrong_is_refused(
    option: str,
    target: str,
    tmp_path: Path,
    in_process: RunTraining,
    capsys: pytest.CaptureFixture[str],
) -> None:
    wrong = write(tmp_path / "wrong", BODY25)
    words = (option, str(wrong), "--keypoint-layout", "human25", "--object", target)
    place = ("--name", "mine", "--output", str(tmp_path), "--steps", "1", "--threads", "1")
    assert in_process(*words, *place) == 2
    said = capsys.readouterr().err
    assert f"failed: {wrong}: poor fit as human25: is it body25? It fits 0.0" in said
    assert "set the keypoint layout to body25 (--keypoint-layout, train.keypoint_layout)" in said
    assert not list(tmp_path.glob("*mine*"))


@pytest.mark.parametrize("option", ["--bag", "--input"])
def test_a_source_in_another_layout_is_left_out(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    right, wrong = write(tmp_path / "right", HUMAN25), write(tmp_path / "wrong", BODY25)
    found = read(option, wrong, option, right, "--keypoint-layout", "human25")
    np.testing.assert_array_equal(found.dataset.points, in_layout(HUMAN25)[0])
    assert "wrong" not in found.dataset.source and not faults(found)
    assert (
        f"warning: left out: {wrong}: poor fit as human25: is it body25?" in capsys.readouterr().err
    )


@pytest.mark.parametrize("option", ["--bag", "--input"])
def test_each_source_is_checked_by_itself(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points, confidence = in_layout(COCO17)
    upside_down = points * np.array([1, -1]) + np.array([0, IMAGE[1]])
    words: list[str | Path] = ["--object", "human25", "--keypoint-layout", "coco17"]
    for i in range(4):
        path = tmp_path / f"{i}"
        write_bag(path, "/keypoints", frames(points if i else upside_down, confidence))
        words += [option, path]
    found = read(*words)
    (fault,) = faults(found)
    assert fault.startswith("0: ") and "y must point down" in fault
    assert f"warning: {fault}" in capsys.readouterr().err
    assert len(found.dataset) == 4 * len(points)


def test_a_bag_of_normalised_keypoints_becomes_pixels(tmp_path: Path) -> None:
    points, confidence = in_layout(COCO17)
    write_bag(tmp_path / "bag", "/keypoints", frames(points / np.array(IMAGE), confidence))
    words = ("--bag", tmp_path / "bag", "--keypoint-layout", "coco17", "--object", "coco17")
    assert "they are normalised" in faults(read(*words))[0]
    sized = read(*words, "--image-width", str(IMAGE[0]), "--image-height", str(IMAGE[1]))
    assert not faults(sized)
    np.testing.assert_allclose(sized.dataset.points, points, rtol=1e-4, atol=0.01)


@pytest.mark.parametrize("option", ["--bag", "--input"])
def test_confidences_of_another_scale_in_a_bag_are_said(option: str, tmp_path: Path) -> None:
    points, confidence = in_layout(COCO17)
    write_bag(tmp_path / "percent", "/keypoints", frames(points, 100 * confidence))
    write_bag(tmp_path / "right", "/keypoints", frames(points, confidence))
    (fault,) = faults(read(option, tmp_path / "percent", option, tmp_path / "right"))
    assert fault.startswith("percent: confidence up to ") and fault.endswith("divide it by 100")


def test_a_file_that_is_read_twice_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "a.npz", COCO17)
    write(tmp_path / "b.npy", COCO17)
    read("--input", tmp_path, "--object", "coco17")
    said = capsys.readouterr().err
    assert "warning: the same keypoints twice: b.npy (of a.npz); leave the copies out" in said


def test_what_is_named_twice_is_trained_on_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, bag = write(tmp_path / "a.npz", COCO17), write(tmp_path / "bag", HUMAN17)
    once = len(read("--input", file, "--bag", bag, "--object", "human17").dataset)
    assert "named more than once" not in capsys.readouterr().err
    same = tmp_path / "bag" / ".." / "a.npz"
    words = ("--bag", bag, "--bag", bag, "--input", bag, "--input", file, "--input", tmp_path)
    found = read(*words, "--input", same, "--object", "human17")
    said = capsys.readouterr().err
    assert len(found.dataset) == once
    assert "warning: named more than once: bag, a.npz; trained on once" in said
    assert "the same keypoints" not in said
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    (damaged / "damaged.mcap").write_bytes(b"no bag")
    with pytest.raises(ValueError, match="damaged"):
        read("--bag", damaged, "--input", damaged, "--object", "human17")


def test_the_page_names_the_layout_for_the_lifter(
    tmp_path: Path, in_process: RunTraining, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--bag", str(write(tmp_path / "bag", BODY25)), "--name", "mine", "--threads", "1")
    assert in_process(*words, "--output", str(tmp_path), "--steps", "1") == 0
    assert "poor fit" not in capsys.readouterr().err
    assert "-p keypoint_layout:=body25 " in (tmp_path / "mine.html").read_text()


def test_names_in_a_file_say_the_layout(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points, _ = in_layout(COCO17)
    np.savez(tmp_path / "a.npz", points=points, names=np.array(COCO17.keypoints))
    found = read("--input", tmp_path / "a.npz")
    np.testing.assert_array_equal(found.dataset.points, expected(COCO17))
    assert found.detector_layout == "coco17" and not capsys.readouterr().err


def test_an_ambiguous_layout_is_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "a.npy", np.random.default_rng(0).uniform(10, 900, (20, 17, 2)))
    read("--input", tmp_path / "a.npy", "--object", "coco17")
    said = capsys.readouterr().err
    assert "a.npy: keypoint layout coco17: taken although no layout fits well; " in said
    assert "warning: a.npy: the keypoint layout is ambiguous: coco17 is taken" in said
    assert "name the keypoint layout (--keypoint-layout)" in said


def test_what_is_no_person_and_has_no_start_stays_in_its_order(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "thing.yaml"
    names = ", ".join(f"corner_{i}" for i in range(17))
    path.write_text(f"name: thing\nkeypoints: [{names}]\n")
    data = ("--input", write(tmp_path / "a.npz", COCO17), "--bag", write(tmp_path / "b", COCO17))
    found = read(*data, "--object", path)
    points = in_layout(COCO17)[0]
    np.testing.assert_array_equal(found.dataset.points, np.concatenate([points, points]))
    assert found.detector_layout == "" and "keypoint layout" not in capsys.readouterr().err


def test_a_start_shows_the_layout_of_what_is_no_person(tmp_path: Path) -> None:
    rows = ("--object", "hand21", "--from", "hand21", "--input")
    points = np.random.default_rng(0).uniform(10, 900, (20, 21, 2))
    np.save(tmp_path / "a.npy", points)
    found = read(*rows, tmp_path / "a.npy")
    np.testing.assert_allclose(found.dataset.points, points, rtol=1e-5)
    np.save(tmp_path / "b.npy", points[:, :20])
    with pytest.raises(ValueError, match=r"b\.npy: .* 20 keypoints; no layout of 20 .*--object"):
        read(*rows, tmp_path / "b.npy")


def test_a_bag_of_an_unknown_size_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = np.random.default_rng(0).uniform(10, 900, (20, 7, 2))
    write_bag(tmp_path / "seven", "/keypoints", frames(points, np.ones((20, 7))))
    with pytest.raises(ValueError, match="seven: the objects have 7 keypoints; no layout of 7"):
        read("--bag", tmp_path / "seven")
    bag = write(tmp_path / "bag", COCO17)
    found = read("--bag", tmp_path / "seven", "--bag", bag)
    np.testing.assert_array_equal(found.dataset.points, expected(COCO17))
    said = capsys.readouterr().err
    assert (
        "warning: left out: " in said and "name one with --keypoint-layout, or the object" in said
    )


def test_people_who_come_late_and_another_topic_do_not_hide_the_layout(tmp_path: Path) -> None:
    points, confidence = in_layout(BODY25)
    nobody = [Frame(i, np.zeros((0, 4, 2)), np.zeros((0, 4))) for i in range(1000)]
    late = [*nobody, *frames(points, confidence, start=10**9)]
    write_bag(tmp_path / "bag", "/keypoints", late)
    found = read("--bag", tmp_path / "bag")
    np.testing.assert_array_equal(found.dataset.points, expected(BODY25))


def test_every_layout_of_people_is_found(tmp_path: Path) -> None:
    for name in ("halpe26", "mediapipe33", "openpose18", "human25"):
        found = read("--input", write(tmp_path / f"{name}.npz", LAYOUTS[name]))
        np.testing.assert_allclose(found.dataset.points, expected(LAYOUTS[name]), rtol=1e-5)
        assert found.detector_layout == ("" if name == "human25" else name)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("knee", "knie", "lacks those that are nearly the same: left_knie (left_knee?), right_kn"),
        ("left", "loose", "8 right_ keypoints of object 'human25' and no left_ one, but 8 unknown"),
        ("", "", ""),
    ],
)
def test_names_that_look_wrong_are_said(
    old: str, new: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [name.replace(old, new) for name in COCO17.keypoints]
    np.savez(tmp_path / "a.npz", points=in_layout(COCO17)[0], names=np.array(names))
    read("--input", tmp_path / "a.npz")
    warned = capsys.readouterr().err
    assert said in warned and warned.startswith("warning: a.npz: ") == bool(said)


def test_names_of_another_object_are_an_error_that_names_the_file(tmp_path: Path) -> None:
    names = [f"p{i}" for i in range(17)]
    np.savez(tmp_path / "a.npz", points=in_layout(COCO17)[0], names=np.array(names))
    with pytest.raises(ValueError, match=r"a\.npz: its keypoints are named p0, p1, .*rename them"):
        read("--input", tmp_path / "a.npz")


def test_padding_of_an_array_is_no_frame(tmp_path: Path) -> None:
    padded = np.zeros((60, 5, 17, 2))
    padded[:, 3] = in_layout(COCO17, 60)[0]
    np.save(tmp_path / "a.npy", padded)
    found = read("--input", tmp_path / "a.npy", "--object", "coco17")
    np.testing.assert_allclose(found.dataset.points, padded[:, 3], rtol=1e-6)
    assert found.dataset.sequence_starts.tolist() == [0]

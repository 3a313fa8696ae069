# SPDX-License-Identifier: Apache-2.0
"""The data of a training is curated and assessed before the training starts."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from deep_nrsfm_ros.commands.train import parser
from deep_nrsfm_ros.data.bags import Frame, frames, write_bag
from deep_nrsfm_ros.data.curation import Curation
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras
from deep_nrsfm_ros.training import preparation
from deep_nrsfm_ros.training.config import TrainingConfig
from deep_nrsfm_ros.training.preparation import prepare, read_data
from deep_nrsfm_ros.training.reporter import Reporter

REPORTER = Reporter(as_json=False, should_stop=lambda: False)


def people(f: int = 60) -> Dataset:
    """Return f views of people, each of them twice."""
    rng = np.random.default_rng(0)
    shapes = centre(rng.standard_normal((17, 3)) + 0.3 * rng.standard_normal((f, 17, 3)))
    S, M = np.repeat(shapes, 2, axis=0), np.repeat(random_cameras(f, rng), 2, axis=0)
    points, S = (S @ M).astype(np.float32), S.astype(np.float32)
    return Dataset(points, np.ones((2 * f, 17), bool), HUMAN17, "made up", S, cameras=M)


@pytest.mark.parametrize(
    ("words", "left"),
    [
        (("--cmu", "folder"), 120),
        (("--cmu", "folder", "--min-change", "0.02"), 60),
        (("--bag", "bag"), 60),
        (("--bag", "bag", "--min-change", "0"), 120),
    ],
)
def test_motion_capture_keeps_all_frames_by_default(
    words: tuple[str, ...], left: int, capsys: pytest.CaptureFixture[str]
) -> None:
    config = TrainingConfig.from_arguments(parser().parse_args(words))
    prepared = prepare(config.curation, people(), REPORTER)
    assert len(prepared.dataset) == prepared.sufficiency.frames == left
    sentences = capsys.readouterr().err.splitlines()
    assert any("near-duplicates" in sentence for sentence in sentences) == (left == 60)
    assert any(sentence.startswith("warning: ") for sentence in sentences)


def test_hopeless_data_is_refused() -> None:
    with pytest.raises(ValueError, match=r"cannot be learned from this: .*at least 10"):
        prepare(Curation(), people(3), REPORTER)


def pixels(f: int, seed: int = 0) -> np.ndarray:
    """Return (f, 17, 2) pixels."""
    random = np.random.default_rng(seed)
    return random.uniform(10, 900, (f, 17, 2)).astype(np.float32)


def write_files(folder: Path) -> None:
    """Write the same points in a bag, an .npz, COCO JSON with identities and OpenPose JSON."""
    points, ones = pixels(6), np.ones((6, 17, 1))
    write_bag(folder / "bag", "/keypoints", frames(points, ones[..., 0]))
    np.savez(folder / "a.npz", points=points)
    triples = np.concatenate([points, ones], -1).reshape(6, -1).tolist()
    rows = [
        {"image_id": i // 2, "category_id": 1, "track_id": 7 - i % 2, "keypoints": row}
        for i, row in enumerate(triples)
    ]
    (folder / "coco.json").write_text(json.dumps(rows))
    (folder / "openpose").mkdir()
    for i, row in enumerate(triples):
        frame = {"people": [{"pose_keypoints_2d": row}]}
        (folder / "openpose" / f"{i:03}_keypoints.json").write_text(json.dumps(frame))


def read(*words: str) -> Dataset:
    """Return the data that a command line names."""
    return read_data(TrainingConfig.from_arguments(parser().parse_args(words)), REPORTER).dataset


def test_files_are_trained_on_as_bags_are(tmp_path: Path) -> None:
    write_files(tmp_path)
    points, layout = pixels(6), ("--object", "human17", "--keypoint-layout", "human17")
    for name in ("a.npz", "openpose", "bag"):
        np.testing.assert_array_equal(read("--input", f"{tmp_path}/{name}", *layout).points, points)
    by_identity = read("--input", f"{tmp_path}/coco.json", *layout)
    np.testing.assert_allclose(by_identity.points, points[[1, 3, 5, 0, 2, 4]], rtol=1e-6)
    both = read("--bag", f"{tmp_path}/bag", "--input", f"{tmp_path}/a.npz", *layout)
    np.testing.assert_array_equal(both.points, np.concatenate([points, points]))
    assert both.source == "bags bag; file a.npz"
    assert both.sequence_starts.tolist() == [0, 6]
    assert by_identity.sequence_starts.tolist() == [0, 3]
    for named in (("--input", f"{tmp_path}/coco.json"), ("--input", f"{tmp_path}/a.npz")):
        assert read(*named, "--object", "numbered").layout.keypoints[16] == "point_16"


def test_several_people_in_a_message_are_said_to_be_frames_each(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = pixels(12).reshape(6, 2, 17, 2)
    pairs = [Frame(10**9 + i * 10**8, points[i], np.ones((2, 17))) for i in range(6)]
    write_bag(tmp_path / "pairs", "/keypoints", pairs)
    layout = ("--object", "human17", "--keypoint-layout", "human17")
    assert len(read("--bag", f"{tmp_path}/pairs", *layout).points) == 12
    assert "6 messages hold 12 objects; each is a frame" in capsys.readouterr().err
    write_bag(tmp_path / "single", "/keypoints", frames(pixels(6), np.ones((6, 17))))
    read("--bag", f"{tmp_path}/single", *layout)
    assert "messages hold" not in capsys.readouterr().err


def test_a_folder_stands_for_the_recordings_in_it(tmp_path: Path) -> None:
    write_files(tmp_path)
    (tmp_path / "notes.txt").write_text("no recording")
    (tmp_path / "pictures").mkdir()
    layout = ("--object", "human17", "--keypoint-layout", "human17")
    everything = read("--input", str(tmp_path), *layout)
    points = pixels(6)
    expected = [points, points, points[[1, 3, 5, 0, 2, 4]], points]
    np.testing.assert_allclose(everything.points, np.concatenate(expected), rtol=1e-6)
    assert everything.source == "file a.npz; file bag; file coco.json; file openpose"
    with pytest.raises(ValueError, match="neither a bag nor .json files"):
        read("--input", str(tmp_path / "pictures"))


def test_each_process_reads_its_share_of_the_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_files(tmp_path)
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "test")
    monkeypatch.setenv("WORLD_SIZE", "2")
    sources = []
    for process in range(2):
        monkeypatch.setenv("RANK", str(process))
        both = ("--input", f"{tmp_path}/a.npz", "--input", f"{tmp_path}/coco.json")
        sources.append(read(*both, "--object", "human17").source)
    assert sources == ["file a.npz", "file coco.json"]
    np.savez(tmp_path / "many.npz", points=pixels(40))
    monkeypatch.setenv("RANK", "1")
    one = read("--input", f"{tmp_path}/many.npz", "--object", "human17")
    np.testing.assert_array_equal(one.points, pixels(40)[16:32])  # fewer files than processes


def test_one_bad_file_is_left_out_and_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_files(tmp_path)
    (tmp_path / "bad.json").write_text("no JSON")
    nobody = np.zeros((0, 17, 2)), np.zeros((0, 17))
    write_bag(tmp_path / "empty", "/keypoints", frames(*nobody))
    words = [
        word
        for pair in (("--input", "bad.json"), ("--input", "a.npz"), ("--bag", "empty"))
        for word in (pair[0], f"{tmp_path}/{pair[1]}")
    ]
    words += ["--object", "human17"]
    assert len(read(*words)) == 6
    said = capsys.readouterr().err
    assert "warning: left out: " in said and "bad.json" in said and "no message on /keypo" in said
    with pytest.raises(ValueError, match=r"bad\.json"):
        read("--input", f"{tmp_path}/bad.json")
    both = ("--input", f"{tmp_path}/a.npz", "--bag", f"{tmp_path}/bag", "--object", "human17")
    with pytest.raises(ValueError, match="have 12 frames; at most 10"):
        read(*both, "--max-frames", "10")


def test_images_of_motion_capture_are_varied(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preparation, "read_split", lambda *_: people(600))
    words = ("--cmu", "folder", "--object", "human17")
    plain, changed = read(*words), read(*words, "--hidden-feet", "0.5", "--mirrored-images", "0.5")
    toe = HUMAN17.index("left_big_toe")
    assert plain.visible.all()
    assert changed.visible[:, toe].mean() == pytest.approx(0.5, abs=0.05)
    was_mirrored = (changed.points[:, 0] != plain.points[:, 0]).any(1)
    assert was_mirrored.mean() == pytest.approx(0.5, abs=0.05)
    assert changed.source == "made up; hidden_feet 0.5, mirrored_images 0.5"

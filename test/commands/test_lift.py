"""`lift` from end to end, with the model that comes with the package."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from deep_nrsfm_ros.commands.lift import arguments, main
from deep_nrsfm_ros.configuration import options
from deep_nrsfm_ros.data.keypoint_files import read_keypoints
from deep_nrsfm_ros.layouts.presets import COCO17
from deep_nrsfm_ros.lifting.lifter import LiftingOptions

HEIGHTS = {
    "nose": 0,
    "shoulder": 30,
    "elbow": 60,
    "wrist": 90,
    "hip": 90,
    "knee": 135,
    "ankle": 180,
}


def standing(x: float = 300, size: float = 1.0) -> np.ndarray:
    """Return x, y, confidence of coco17 of a person who stands and faces the camera."""
    values = np.zeros((17, 3))
    for i, name in enumerate(COCO17.keypoints):
        side = {"left": 15, "right": -15}.get(name.split("_")[0], 0)
        height = HEIGHTS.get(name.split("_")[-1])
        if height is not None:
            values[i] = x + size * side, 200 + size * height, 0.9
    return values


@pytest.fixture
def people(tmp_path: Path) -> Path:
    """Return an OpenPose file of five frames: a person, and a smaller one in the last two."""
    frames = [[standing(300 + i)] for i in range(5)]
    frames[3].insert(0, standing(600, 0.4))
    frames[4].append(standing(600, 0.4))
    lines = [
        json.dumps({"people": [{"pose_keypoints_2d": p.ravel().tolist()} for p in frame]})
        for frame in frames
    ]
    path = tmp_path / "people.jsonl"
    path.write_text("\n".join(lines))
    return path


def test_people_come_out_upright_and_the_right_way_round(people: Path, tmp_path: Path) -> None:
    main([str(people), "--keypoint-layout", "coco17", "--output", str(tmp_path / "out.npz")])
    with np.load(tmp_path / "out.npz") as file:
        S = dict(zip(file["names"].tolist(), file["shapes"].swapaxes(0, 1), strict=True))
        assert file["frame"].tolist() == [0, 1, 2, 3, 3, 4, 4]
        assert (S["nose"][:, 1] < S["left_ankle"][:, 1]).all()  # y down
        assert (S["left_shoulder"][:, 0] > S["right_shoulder"][:, 0]).all()  # faces the camera
        front = file["rotations"][:, :, 0]
        assert (front[:, 2] < -0.5).all()  # towards the camera


def test_the_largest_alone(
    people: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(
        [
            *(str(people), "--keypoint-layout", "coco17", "--objects", "largest"),
            *("--output", str(tmp_path / "out.json"), "--reference-length", "0.5"),
        ]
    )
    frames = json.loads((tmp_path / "out.json").read_text())["frames"]
    assert [[one["identity"] for one in frame["objects"]] for frame in frames] == [["0"]] * 3 + [
        ["1"],
        ["0"],
    ]
    assert "5 of 5 objects in 5 frames lifted" in capsys.readouterr().out


def test_a_bag_of_it_can_be_lifted_again(people: Path, tmp_path: Path) -> None:
    main([str(people), "--keypoint-layout", "coco17", "--output", str(tmp_path / "bag")])
    main(
        [
            *(str(tmp_path / "bag"), "--keypoint-layout", "coco17"),
            *("--output", str(tmp_path / "out.npz")),
        ]
    )
    with np.load(tmp_path / "out.npz") as file:
        seen = read_keypoints(people)
        np.testing.assert_array_equal(file["frame"], seen.frame)
        np.testing.assert_array_equal(file["stamps"], seen.stamps)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        (["--keypoint-layout", "body25"], "have 17 keypoints; the keypoint layout body25 has 25"),
        (["--keypoint-layout", "nonsense"], "nonsense"),
        (["--model", "nobody"], "no model 'nobody'"),
        (["--output", "out.bvh"], "suffix '.bvh'"),
        (["--output", "nowhere/out.npz"], "nowhere"),
        (["--test-time-rotations", "0"], "test_time_rotations is 0; it must be at least 1"),
    ],
)
def test_what_is_wrong_is_said(
    people: Path, changed: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    usual = [str(people), "--keypoint-layout", "coco17", "--output", str(people.parent / "o.npz")]
    with pytest.raises(SystemExit) as end:
        main([*usual, *changed])
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("failed: ") and expected in said
    assert not (people.parent / "o.npz").exists()


def test_has_the_options_of_the_lifter() -> None:
    usage = arguments().format_help()
    for field, _, _ in options(LiftingOptions):
        assert f"--{field.name.replace('_', '-')}" in usage
    assert "--min-confidence" in usage and "--input-type" not in usage


CAMERA = "k: [600, 0, 320, 0, 600, 240, 0, 0, 1]\nd: []\ndistortion_model: plumb_bob\n"


def test_with_intrinsics_people_come_out_at_their_place(people: Path, tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(CAMERA)
    main(
        [
            *(str(people), "--keypoint-layout", "coco17", "--output", str(tmp_path / "out.npz")),
            *("--intrinsics", str(tmp_path / "camera.yaml"), "--reference-length", "0.5"),
        ]
    )
    with np.load(tmp_path / "out.npz") as file:
        x, _, z = file["shapes"].mean(1).T
        small = file["identities"][file["frame"] == 3].tolist().index("0")
        here = np.flatnonzero(file["frame"] == 3)
        # 60 pixels of 600 from shoulders to hips, 0.5 m apart: 0.5 * 600 / 60 m away.
        np.testing.assert_allclose(z[file["frame"] < 3], 0.5 * 600 / 60, rtol=0.25)
        assert (np.abs(x[file["frame"] < 3]) < 0.3).all()
        assert z[here[small]] > 1.8 * z[here[1 - small]]  # 0.4 of the size, so much farther
        assert x[here[small]] > 1


def test_a_camera_file_that_says_nothing(
    people: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "camera.yaml").write_text("name: mine")
    with pytest.raises(SystemExit):
        main(
            [
                *(str(people), "--keypoint-layout", "coco17", "--intrinsics"),
                *(str(tmp_path / "camera.yaml"), "--output", str(tmp_path / "out.npz")),
            ]
        )
    assert "neither k nor camera_matrix" in capsys.readouterr().err

# SPDX-License-Identifier: Apache-2.0
"""`lift` from end to end, with the model that comes with the package."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.data.walking_person import CAMERA as WALKING_CAMERA
from benchmarks.data.walking_person import DISTANCE, IMAGE, in_layout
from deep_nrsfm_ros.commands.lift import arguments, main
from deep_nrsfm_ros.configuration import options
from deep_nrsfm_ros.data.keypoint_files import read_keypoints
from deep_nrsfm_ros.layouts.presets import COCO17, LAYOUTS
from deep_nrsfm_ros.lifting.options import LiftingOptions

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


def lift(folder: Path, layout: str, *options: str, **arrays: np.ndarray) -> int:
    """Lift the walking person of a layout, with arrays changed; return the exit code."""
    points, confidence = in_layout(LAYOUTS[layout])
    path = folder / "keypoints.npz"
    np.savez(path, **({"points": points, "confidence": confidence} | arrays))
    (folder / "camera.yaml").write_text(WALKING_CAMERA)
    try:
        main([str(path), "--output", str(folder / "out.npz"), *options])
    except SystemExit as end:
        return int(end.code or 0)
    return 0


WIDE_AND_HIGH = ("--image-width", str(IMAGE[0]), "--image-height", str(IMAGE[1]))
VIEW = ("--field-of-view", "65.24")  # 2 atan(640 / 1000), as of the camera file


def test_a_field_of_view_is_as_good_as_a_camera_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert lift(tmp_path, "coco17", "--intrinsics", str(tmp_path / "camera.yaml")) == 0
    with np.load(tmp_path / "out.npz") as file:
        expected = file["shapes"]
    assert "hint" not in capsys.readouterr().err
    assert lift(tmp_path, "coco17", *VIEW, *WIDE_AND_HIGH) == 0
    with np.load(tmp_path / "out.npz") as file:
        np.testing.assert_allclose(file["shapes"], expected, atol=1e-3)
    assert "hint" not in capsys.readouterr().err
    assert lift(tmp_path, "coco17", "--field-of-view", "0") == 0
    hint = capsys.readouterr().err
    assert "65 (webcams, phones held sideways) or 45 (held upright) --image-width W" in hint
    assert "the size of the image in which the keypoints were detected" in hint
    assert "at their places in metres from the camera" in hint
    assert lift(tmp_path, "coco17", *WIDE_AND_HIGH) == 0
    assert capsys.readouterr().err.endswith("--field-of-view 65 (webcams, phones held sideways)\n")
    upright = ("--image-width", "1280", "--image-height", "1290")
    assert lift(tmp_path, "coco17", *upright) == 0
    assert capsys.readouterr().err.endswith("--field-of-view 45 (phones held upright)\n")


def coco_file(folder: Path, points: np.ndarray, *sizes: tuple[int, int]) -> Path:
    """Write a COCO file of the walking person; return it. The sizes of its images alternate."""
    values = np.concatenate([points, CONFIDENCE[..., None]], -1).reshape(len(points), -1).tolist()
    images = [
        {"id": i, **dict(zip(("width", "height"), sizes[i % len(sizes)], strict=True))}
        for i in range(len(points))
    ]
    people = [{"image_id": i, "keypoints": row} for i, row in enumerate(values)]
    path = folder / "coco.json"
    path.write_text(json.dumps({"images": images, "annotations": people}))
    return path


def run(*words: str) -> int:
    """Return the exit code of `lift`."""
    try:
        main(list(words))
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def test_the_border_is_the_same_whoever_says_the_size(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = POINTS.copy()
    points[5:8, 9, 0] = 0.2  # a wrist at the left border
    path, answers = coco_file(tmp_path, points, IMAGE), []
    camera = WALKING_CAMERA + f"width: {IMAGE[0]}\nheight: {IMAGE[1]}\n"
    (tmp_path / "camera.yaml").write_text(camera)
    calibrated = ("--intrinsics", str(tmp_path / "camera.yaml"))
    for words in (VIEW, (*VIEW, *WIDE_AND_HIGH), calibrated):
        assert run(str(path), *words, "--output", str(tmp_path / "out.npz")) == 0
        said = capsys.readouterr().err
        assert "3 of 1020 keypoints are at the border" in said and "warning" not in said
        with np.load(tmp_path / "out.npz") as file:
            answers.append(file["shapes"])
    np.testing.assert_allclose(answers[1], answers[0], atol=1e-3)
    np.testing.assert_allclose(answers[2], answers[0], atol=1e-3)


def test_a_wrong_size_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    exchanged = ("--image-width", "400", "--image-height", "1280")
    assert lift(tmp_path, "coco17", *VIEW, *exchanged) == 3
    said = capsys.readouterr().err
    assert "of the keypoints lie outside the image of 400 x 1280" in said
    assert "the size is wrong" in said and "count as missing" not in said
    path, output = coco_file(tmp_path, POINTS, (400, 1280)), ("--output", str(tmp_path / "o.npz"))
    assert run(str(path), *VIEW, *output) == 3  # as where a tool ignores the EXIF rotation
    assert "outside the image of 400 x 1280" in capsys.readouterr().err
    assert run(str(path), *VIEW, *WIDE_AND_HIGH, *output) == 0
    assert run(str(path), *output) == 0  # without a camera nothing hangs on the size


def test_images_of_several_sizes_have_no_one_camera(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = coco_file(tmp_path, POINTS, IMAGE, IMAGE, (720, 1280))
    output = ("--output", str(tmp_path / "o.npz"))
    for words in (VIEW, (*VIEW, *WIDE_AND_HIGH), WIDE_AND_HIGH):
        assert run(str(path), *words, *output) == 2
        said = capsys.readouterr().err
        assert f"{path} have 2 sizes (1280 x 720: 40, 720 x 1280: 20), and one" in said
        assert "lift each by itself" in said
    assert run(str(path), *output) == 0
    assert "hint" not in capsys.readouterr().err


def test_a_coco_file_says_the_size_that_a_field_of_view_needs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert lift(tmp_path, "coco17", *VIEW, *WIDE_AND_HIGH) == 0
    with np.load(tmp_path / "out.npz") as file:
        expected = file["shapes"]
    points, confidence = in_layout(COCO17)
    values = np.concatenate([points, confidence[..., None]], -1).reshape(len(points), -1).tolist()
    size = dict(zip(("width", "height"), IMAGE, strict=True))
    content = {
        "images": [{"id": i, **size} for i in range(len(points))],
        "annotations": [{"image_id": i, "keypoints": row} for i, row in enumerate(values)],
    }
    (tmp_path / "coco.json").write_text(json.dumps(content))
    main([str(tmp_path / "coco.json"), *VIEW, "--output", str(tmp_path / "out.npz")])
    with np.load(tmp_path / "out.npz") as file:
        np.testing.assert_allclose(file["shapes"], expected, atol=1e-3)
    capsys.readouterr()
    main([str(tmp_path / "coco.json"), "--output", str(tmp_path / "out.npz")])
    assert capsys.readouterr().err.endswith("--field-of-view 65 (webcams, phones held sideways)\n")


@pytest.mark.parametrize("layout", ["coco17", "human17"])
def test_the_layout_is_found(
    layout: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert lift(tmp_path, layout) == 0
    said = capsys.readouterr()
    assert said.err.startswith(f"keypoint layout {layout}: it fits with residual 0.")
    assert "60 of 60 objects in 60 frames lifted; median residual 0." in said.out
    assert "warning" not in said.err


def test_the_format_says_the_layout_and_the_summary_its_scale(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points, confidence = in_layout(COCO17)
    values = np.concatenate([points, confidence[..., None]], -1).reshape(len(points), -1).tolist()
    entries = [
        {"image_id": i, "category_id": 1, "keypoints": v, "score": 0.9}
        for i, v in enumerate(values)
    ]
    (tmp_path / "a.json").write_text(json.dumps(entries))
    main([str(tmp_path / "a.json"), "--output", str(tmp_path / "out.npz")])
    said = capsys.readouterr()
    expected = "keypoint layout coco17: usual in files like COCO's, and it fits with residual 0."
    assert said.err.startswith(expected) and " with 2 keypoints fewer" in said.err
    assert " (below 0.1 is usual, from 0.3 on poor), confidence 0." in said.out
    assert said.out.endswith(" (0 to 1, below 0.3 is low)\n")


@pytest.mark.parametrize("wrong", [["--correction", "bone"], ["--nonsense"], []])
def test_a_wrong_option_is_not_lost_in_the_usage(
    wrong: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["a.npy", *wrong])
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2 and ": error: " in said[1]


def test_the_wrong_layout_is_doubtful(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert lift(tmp_path, "coco17", "--keypoint-layout", "human17") == 3
    assert "is it coco17? It fits 0.0" in capsys.readouterr().err
    assert (tmp_path / "out.npz").exists()
    assert lift(tmp_path, "coco17", "--keypoint-layout", "human17", "--force") == 0
    assert "is it coco17?" in capsys.readouterr().err


def test_the_size_of_the_image_acts_on_every_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pixels, _ = in_layout(COCO17)
    assert lift(tmp_path, "coco17") == 0
    with np.load(tmp_path / "out.npz") as file:
        expected = file["shapes"]
    capsys.readouterr()
    normalised = pixels / np.array(IMAGE, np.float32)
    assert lift(tmp_path, "coco17", points=normalised) == 3
    assert "they are normalised, not pixels" in capsys.readouterr().err
    size = ("--image-width", str(IMAGE[0]), "--image-height", str(IMAGE[1]))
    assert lift(tmp_path, "coco17", *size, points=normalised) == 0
    with np.load(tmp_path / "out.npz") as file:
        np.testing.assert_allclose(file["shapes"], expected, atol=1e-3)
    camera = ("--intrinsics", str(tmp_path / "camera.yaml"), "--reference-length", "0.5")
    assert lift(tmp_path, "coco17", *camera, points=normalised) == 0
    with np.load(tmp_path / "out.npz") as file:
        np.testing.assert_allclose(file["shapes"].mean((0, 1)), (0, 0, DISTANCE), atol=0.6)
    assert lift(tmp_path, "coco17", *camera, *size[:2], "--image-height", "800") == 2
    assert "1280 x 800, and" in capsys.readouterr().err


POINTS, CONFIDENCE = in_layout(COCO17)
NAMES = np.array(COCO17.keypoints)
ONE_SIDE = np.array([name.replace("left", "loose") for name in COCO17.keypoints])
LEFT = np.array([not name.startswith("right") for name in COCO17.keypoints])
SENTINEL = np.where(np.arange(17)[:, None] % 5 == 0, np.float32(-1), POINTS)


@pytest.mark.parametrize(
    ("arrays", "options", "code", "expected"),
    [
        ({"stamps": np.arange(60) * 33}, (), 3, "they look like milliseconds"),
        ({"stamps": np.zeros(60, int)}, (), 3, "all 60 frames have the stamp 0"),
        ({"points": SENTINEL}, (), 3, "lie at exactly (-1, -1)"),
        ({"points": POINTS * [1, -1] + [0, 720]}, (), 3, "people are upside down"),
        ({"points": POINTS[..., ::-1]}, (), 3, "lie on their side"),
        ({"points": POINTS / 1000 + 5}, (), 3, "these are no pixels"),
        ({"confidence": CONFIDENCE * (np.arange(17) < 3)}, (), 2, "60 have fewer than 4 detected"),
        ({"points": POINTS[:0], "confidence": CONFIDENCE[:0]}, (), 2, "has no object"),
        ({"names": np.char.replace(NAMES, "knee", "knie")}, (), 3, "left_knie (left_knee?), right"),
        ({"names": np.char.replace(NAMES, "ear", "hearing")}, (), 0, ""),
        ({"names": ONE_SIDE}, (), 3, "no left_ one, but 8 unknown ones (loose_eye, loose_ear, "),
        (
            {"points": POINTS[:, LEFT], "confidence": CONFIDENCE[:, LEFT], "names": NAMES[LEFT]},
            (),
            0,
            "the input names 8 left_ keypoints of model 'human' and no right_ one: that side is",
        ),
        ({"names": np.char.add("p", np.arange(17).astype(str))}, (), 2, "are named p0, p1, p2, p3"),
        ({}, ("--image-width", "640"), 2, "--image-height is 0: the size of the image needs both"),
        ({}, ("--min-visible", "40"), 2, "--min-visible is 40, but model 'human' has 25 keypoi"),
        ({}, ("--rectified",), 2, "--rectified has no effect without --intrinsics"),
        ({}, VIEW, 2, "keypoints.npz does not say: give --image-width and --image-height"),
        ({}, ("--field-of-view", "151"), 2, "field_of_view is 151.0; it must be at least 0 and at"),
        ({}, ("--field-of-view", "1.13"), 2, "give degrees; 1.13 radians are 65 degrees"),
        ({}, (*VIEW, "--intrinsics", "a.yaml"), 2, "leave --field-of-view out"),
        ({}, ("--correction", "none", "--noise", "0.1"), 2, "--noise has no effect"),
        (
            {},
            ("--person-height", "1.8", "--reference-length", "0.5"),
            2,
            "--person-height has no effect, since reference_length is 0.5",
        ),
        ({}, ("--image-width", "160", "--image-height", "90"), 3, "lie outside the image of 160 x"),
    ],
)
def test_what_looks_wrong_is_said(
    arrays: dict[str, np.ndarray],
    options: tuple[str, ...],
    code: int,
    expected: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert lift(tmp_path, "coco17", *options, **arrays) == code
    assert expected in capsys.readouterr().err


@pytest.mark.parametrize("content", ["[]", '{"people": []}', "[[], []]"])
def test_nobody_is_no_question_of_the_layout(
    content: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.json"
    path.write_text(content)
    with pytest.raises(SystemExit):
        main([str(path), "--output", str(tmp_path / "out.npz")])
    assert capsys.readouterr().err.startswith(f"failed: {path} has no object in its ")
    np.save(tmp_path / "a.npy", POINTS[:0])
    with pytest.raises(SystemExit):
        main([str(tmp_path / "a.npy"), "--output", str(tmp_path / "out.npz")])
    assert capsys.readouterr().err.endswith("a.npy has no object in its 0 frames\n")


def test_people_far_away_and_those_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = ("--intrinsics", str(tmp_path / "camera.yaml"))
    assert lift(tmp_path, "coco17", *camera, "--reference-length", "1000") == 3
    assert "60 of 60 objects are more than 1000 m away" in capsys.readouterr().err
    few = CONFIDENCE * (np.arange(60)[:, None] > 3)
    assert lift(tmp_path, "coco17", confidence=few) == 0
    said = capsys.readouterr().out
    assert "56 of 60 objects" in said and "left out: 4 have fewer than 4 detected" in said


@pytest.mark.parametrize(("share", "code"), [(0.1, 0), (0.6, 3)])
def test_a_wrong_keypoint_is_named(
    share: float, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = POINTS.copy()
    points[: round(share * len(points)), COCO17.index("left_wrist")] += 400
    assert lift(tmp_path, "coco17", points=points) == code
    said = capsys.readouterr()
    assert f"wrong keypoints: left_wrist {share:.0%} of the objects (they contradict" in said.out
    assert ("keypoint 'left_wrist' contradicts the others" in said.err) == (code == 3)
    for format in ("npz", "json"):
        main(
            [
                str(tmp_path / "keypoints.npz"),
                "--output",
                str(tmp_path / f"out.{format}"),
                "--force",
            ]
        )
    with np.load(tmp_path / "out.npz") as file:
        wrong = file["wrong"]
    frames = json.loads((tmp_path / "out.json").read_text())["frames"]
    assert wrong.any() and [each["objects"][0]["wrong"] for each in frames] == wrong.tolist()


@pytest.mark.parametrize("nothing", [0.0, np.nan])
def test_padding_of_an_array_is_no_object(
    nothing: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    padded = np.full((60, 5, 17, 3), nothing)
    padded[:40, 1] = np.concatenate((POINTS, CONFIDENCE[..., None]), -1)[:40]
    np.save(tmp_path / "a.npy", padded)
    out = tmp_path / "out.npz"
    words = [str(tmp_path / "a.npy"), "--keypoint-layout", "coco17", "--output", str(out)]
    main(words)
    said = capsys.readouterr()
    assert "40 of 40 objects in 60 frames lifted" in said.out and "left out" not in said.out
    assert "warning" not in said.err
    with np.load(out) as file:
        lifted = np.isfinite(file["residual"]).reshape(60, 5)
        assert lifted[:40, 1].all() and lifted.sum() == 40
    padded[:30, 1, :, 2] = 0.05  # they are seen, if poorly
    np.save(tmp_path / "a.npy", padded)
    with pytest.raises(SystemExit):
        main([*words, "--min-confidence", "0.1"])
    assert "only 10 of 40 objects are lifted" in capsys.readouterr().err
    np.save(tmp_path / "a.npy", np.full_like(padded, nothing))
    with pytest.raises(SystemExit):
        main(words)
    assert capsys.readouterr().err.endswith("a.npy has no object in its 60 frames\n")


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


def test_frames_help_each_other_unless_they_must_not(people: Path, tmp_path: Path) -> None:
    shapes = {}
    for smooth in ("none", "causal", "both"):
        out = tmp_path / f"{smooth}.npz"
        main([str(people), "--keypoint-layout=coco17", f"--output={out}", f"--smooth={smooth}"])
        with np.load(out) as file:
            shapes[smooth] = file["shapes"]
    np.testing.assert_allclose(shapes["causal"][0], shapes["none"][0], atol=1e-5)
    assert np.abs(shapes["causal"][4] - shapes["none"][4]).max() > 1e-4
    assert np.abs(shapes["both"][0] - shapes["none"][0]).max() > 1e-4


def test_gravity_is_three_numbers(
    people: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [str(people), "--keypoint-layout=coco17", f"--output={tmp_path / 'out.npz'}"]
    main([*command, "--up", "0", "-1", "0"])
    with pytest.raises(SystemExit) as ended:
        main([*command, "--up", "0", "-1"])
    assert ended.value.code == 2 and "three finite numbers" in capsys.readouterr().err


def test_hands_without_a_model_are_told_theirs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "hands.npy", np.random.default_rng(0).uniform(0, 500, (9, 21, 2)))
    words = [str(tmp_path / "hands.npy"), "--output", str(tmp_path / "lifted.npz")]
    for more in ([], ["--keypoint-layout", "hand21"]):
        with pytest.raises(SystemExit, match="2"):
            main([*words, *more])
        assert "--model hand21" in capsys.readouterr().err

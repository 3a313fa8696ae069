# SPDX-License-Identifier: Apache-2.0
"""The front door: five lines lift, one call trains, and importing the package imports nothing."""

from __future__ import annotations

import re
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import deep_nrsfm_ros
from benchmarks.data.walking_person import IMAGE, in_layout
from deep_nrsfm_ros import KeypointLayout, Lifted, Lifter, Model, Recipe, load_model, train
from deep_nrsfm_ros.data.clip import read_clip
from deep_nrsfm_ros.data.virtual_hands import virtual_hands
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.presets import BODY25, COCO17, HUMAN25
from deep_nrsfm_ros.model_files.model_file import ModelFileError, save_model
from deep_nrsfm_ros.nrsfm.factorisation.consensus import Consensus
from deep_nrsfm_ros.training import few_frames

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def human() -> Model:
    return load_model("human")


def pixels(n: int, q: int) -> np.ndarray[Any, Any]:
    return np.random.default_rng(0).uniform(50, 600, (n, q, 2))


def same(a: Lifted, b: Lifted) -> None:
    for one, other in zip(a, b, strict=True):
        np.testing.assert_array_equal(one, other)


def test_importing_the_package_imports_nothing() -> None:
    code = (
        "import sys; import deep_nrsfm_ros; deep_nrsfm_ros.__version__; dir(deep_nrsfm_ros)\n"
        "heavy = {'torch', 'rclpy', 'numpy', 'yaml', 'rosbags'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "assert not [m for m in sys.modules if m.startswith('deep_nrsfm_ros.')]\n"
        "from deep_nrsfm_ros import Lifter, load_model, train\n"
        "heavy = {'torch', 'rclpy'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_public_name_is_there() -> None:
    for name in deep_nrsfm_ros.__all__:
        assert name in dir(deep_nrsfm_ros) and getattr(deep_nrsfm_ros, name) is not None
    assert dir(deep_nrsfm_ros) == sorted(deep_nrsfm_ros.__all__)
    with pytest.raises(AttributeError, match="'lift'"):
        _ = deep_nrsfm_ros.lift


def test_the_lines_of_the_readme_run() -> None:
    text = (ROOT / "README.md").read_text()
    block = text.split("## Python\n")[1].split("\n## ")[0]
    lines = [line[4:] for line in block.splitlines() if line.startswith("    ")]
    variables: dict[str, Any] = {}
    exec("\n".join(lines[: lines.index("") if "" in lines else None]), variables)
    assert np.isfinite(variables["lifted"].shapes).all()


def test_the_lines_of_the_python_page_on_videos_run() -> None:
    page = (ROOT / "docs/reference/python.md").read_text()
    section = page.split("## Lifting with a camera, over time\n")[1].split("\n## ")[0]
    lines = [line[4:] for line in section.splitlines() if line.startswith("    ")]
    variables: dict[str, Any] = {"points": pixels(3, 17)}
    exec("\n".join(lines), variables)
    assert np.isfinite(variables["lifted"].shapes).all() and variables["lifted"].shapes[0, 0, 2] > 0
    lifted = variables["video"](pixels(3, 17))
    assert lifted.shapes.shape == (3, 25, 3)


def test_the_lines_of_the_python_page_on_truth_run() -> None:
    page = (ROOT / "docs/reference/python.md").read_text()
    section = page.split("## Your own truth\n")[1].split("\n## ")[0]
    lines = [line[4:] for line in section.splitlines() if line.startswith("    ")]
    lifter, points = Lifter("human", layout="coco17"), pixels(3, 17)
    names = ["left_hip", "right_hip", "left_knee", "right_knee", "left_shoulder"]
    truth = 1000 * lifter(points).shapes[:, [lifter.model.layout.index(name) for name in names]]
    variables: dict[str, Any] = {"points": points, "names": names, "truth": truth}
    exec("\n".join(lines), variables := variables | {"Lifter": Lifter})
    found = variables["camera_errors"](variables["shapes"], truth)
    assert found.aligned < 1e-3 and not found.mirrored


def test_one_object_and_many_in_any_dtype(human: Model) -> None:
    lifter, points = Lifter(human), pixels(100, 25)
    many = lifter(points)
    assert many.shapes.shape == (100, 25, 3) and np.isfinite(many.shapes).all()
    same(lifter(points.astype(np.float32)), many)
    same(lifter(points.tolist(), np.ones((100, 25), bool)), many)
    np.testing.assert_allclose(lifter(points[3]).shapes[0], many.shapes[3], atol=1e-4)
    assert lifter(points[3], np.ones(25)).rotations.shape == (1, 3, 3)
    assert lifter(np.zeros((0, 25, 2))).shapes.shape == (0, 25, 3)


def test_missing_keypoints_are_missing_however_they_are_marked(human: Model) -> None:
    points, confidence = pixels(5, 25), np.ones((5, 25))
    confidence[:, 3] = 0
    expected = Lifter(human)(points, confidence)
    for mark in (np.nan, 0.0, np.inf):
        points[:, 3] = mark
        same(Lifter(human)(points), expected)
        same(Lifter(human)(points.astype(np.float32), np.ones((5, 25), np.float32)), expected)
    confidence[:, 3] = np.nan
    same(Lifter(human)(points, confidence), expected)


def test_a_detectors_layout_is_mapped_by_name(human: Model) -> None:
    points = pixels(4, 17)
    mapped = KeypointMap(COCO17, HUMAN25)(points.astype(np.float32), np.ones((4, 17), np.float32))
    expected = Lifter(human).lift(*mapped)
    same(Lifter(human, layout="coco17")(points), expected)
    same(Lifter(human, layout=COCO17)(points), expected)
    with pytest.raises(ValueError, match="layout is 'coco18'; name a preset"):
        Lifter(human, layout="coco18")


@pytest.mark.parametrize(
    ("points", "confidence", "complaint"),
    [
        (np.ones((2, 24, 2)), None, r"'human25' needs numbers of shape \(n, 25, 2\) or \(25, 2\)"),
        (
            np.ones((2, 25, 3)),
            None,
            r"points are \(2, 25, 3\).* second argument: points\[..., :2\], points\[..., 2\]$",
        ),
        (np.ones((25, 3)), None, r"second argument: points\[..., :2\]"),
        (np.ones((2, 24, 3)), None, r"or \(25, 2\)$"),
        (np.ones(25), None, r"points are \(25,\)"),
        (np.full((25, 2), "x"), None, "needs numbers"),
        (np.ones((2, 25, 2)), np.ones(25), r"confidence is \(25,\) .* need .* \(2, 25\)"),
        (np.ones((25, 2)), np.ones((1, 25)), r"confidence is \(1, 25\)"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(
    human: Model, points: Any, confidence: Any, complaint: str
) -> None:
    with pytest.raises(ValueError, match=complaint):
        Lifter(human)(points, confidence)


def test_a_model_is_loaded_by_name_by_path_and_from_a_folder(human: Model, tmp_path: Path) -> None:
    save_model(tmp_path / "mine.safetensors", human)
    assert load_model(str(tmp_path / "mine.safetensors")).layout == human.layout
    assert load_model(tmp_path / "mine.safetensors").layout == human.layout
    assert load_model("mine", tmp_path).layout == human.layout
    with pytest.raises(ModelFileError, match="no model 'nobody'; there are .*human"):
        load_model("nobody")


def test_an_array_becomes_a_model_that_lifts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    disagreed = Consensus(np.zeros((0, 8, 3)), np.zeros((0, 3, 3)), np.ones(0), 1.0, 2)
    monkeypatch.setattr(few_frames, "MIN_STEPS", 1)
    monkeypatch.setattr(few_frames, "consensus", lambda *_: disagreed)
    rng = np.random.default_rng(0)
    shapes = rng.standard_normal((1, 8, 3)) + 0.3 * rng.standard_normal((400, 1, 1)) * (
        rng.standard_normal((1, 8, 3))
    )
    rotations = np.linalg.qr(rng.standard_normal((400, 3, 3)))[0]
    points = 100 * (shapes @ rotations)[..., :2] + 300
    layout = KeypointLayout("thing", tuple("abcdefgh"))
    progress: list[Any] = []
    messages: list[str] = []
    with pytest.warns(UserWarning, match="'thing' names no handedness") as warned:
        model = train(
            points,
            layout=layout,
            name="thing",
            recipe=Recipe(steps=30, seeds=1),
            on_progress=progress.append,
            on_message=messages.append,
        )
    assert {warning.filename for warning in warned} == {__file__}
    assert ["factorisations" in message for message in messages] == [True, False]
    assert messages[-1] == model.provenance["judgement"]["reason"]
    undo = "if it is one, lift with LiftingOptions.mirrored=True., or name a handedness"
    assert re.search(f"look at its shapes from the side; {undo}", messages[-1])
    assert model.name == "thing" and model.layout == layout and progress
    assert "rival" not in model.provenance["judgement"]  # no model has such an object
    assert np.isfinite(Lifter(model)(points[:3]).shapes).all()
    visible = np.ones((400, 8), bool)
    visible[:, 5:] = False
    with pytest.raises(ValueError, match="cannot be learned"):
        train(points[:5], visible[:5], layout=layout)
    (tmp_path / "thing.yaml").write_text("{name: thing, keypoints: [a, b, c, d, e, f, g, h]}")
    few = Recipe(steps=1, seeds=1, few_frames=0)
    for same in (list("abcdefgh"), tmp_path / "thing.yaml"):
        with pytest.warns(UserWarning, match="'thing' names no handedness"):
            again = train(points, layout=same, name="thing", recipe=few)
        assert again.layout == layout
    with pytest.raises(TypeError, match="layout is a int; give a KeypointLayout, .* names"):
        train(points, layout=8)  # type: ignore[arg-type]


def test_a_detector_is_named_by_its_keypoints_or_a_path(human: Model, tmp_path: Path) -> None:
    names = ["left_hip", "right_hip", "left_knee", "right_knee", "neck"]
    (tmp_path / "legs.yaml").write_text(f"{{name: legs, keypoints: {names}}}")
    points = np.random.default_rng(0).uniform(0, 100, (2, 5, 2))
    by_list = Lifter(human, layout=names)(points)
    by_path = Lifter(human, layout=tmp_path / "legs.yaml")(points)
    np.testing.assert_array_equal(by_list.shapes, by_path.shapes)
    save_model(str(tmp_path / "mine.safetensors"), human)
    assert load_model("mine", str(tmp_path)).name == "mine"
    with pytest.raises(TypeError, match="layout is a int"):
        Lifter(human, layout=5)  # type: ignore[arg-type]


def test_a_model_of_people_is_judged_beside_the_one_at_hand(human: Model) -> None:
    points, _ = in_layout(HUMAN25, 220)
    recipe = Recipe(steps=1, learning_rate=0.1, batch=4)
    helps = "larger share of the start .Recipe.start_share. or .* `train` offers, would help"
    with pytest.warns(UserWarning, match=f"the new model is doubtful: .* {helps}"):
        model = train(points, layout=HUMAN25, recipe=recipe)
    judgement = model.provenance["judgement"]
    assert judgement["rival"] == "human" and model.provenance["from"]["model"] == "human"
    assert judgement["doubtful"] and "would help" in judgement["reason"]
    assert {"image_error", "bone_variation"} <= judgement["figures"].keys()


def test_a_model_knows_the_frames_of_its_training_again() -> None:
    points, _ = in_layout(HUMAN25, 600)
    quick = Recipe(steps=1, batch=4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        first = train(points, layout=HUMAN25, name="first", recipe=quick, held_out=0)
        again = train(1.5 * points, layout=HUMAN25, start=first, recipe=quick)
        held_out = train(points, layout=HUMAN25, name="first", recipe=quick)
        later = train(points, layout=HUMAN25, start=held_out, recipe=quick)
    said = again.provenance["judgement"]
    assert said["rival"] == "first" and said["rival_has_learned_the_frames"]
    assert "Model 'first' was trained on these frames" in said["reason"]
    assert "rival_has_learned_the_frames" not in later.provenance["judgement"]
    with pytest.raises(ValueError, match="held_out is 0.6; it must be at least 0 and at most 0.5"):
        train(points, layout=HUMAN25, held_out=0.6)


def test_frames_are_held_out_of_an_object_without_a_model() -> None:
    points, _ = in_layout(HUMAN25, 600)
    names = [f"k{i}" for i in range(25)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        recipe = Recipe(steps=30, batch=16, seeds=1)
        model = train(points, layout=names, recipe=recipe)
        few = train(points[:400], layout=names, recipe=recipe)
    said = model.provenance["judgement"]
    assert said["verdict"] == "alone" and "held-out frames, later ones" in said["reason"]
    assert said["figures"]["image_error"] > 0 and said["figures"]["learned_image_error"] > 0
    assert "as none were held out" in few.provenance["judgement"]["reason"]
    assert "learned_image_error" not in few.provenance["judgement"]["figures"]


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda p, c: (p * [1, -1] + [0, 720], c), "upside down"),
        (lambda p, c: (np.where(np.arange(25)[:, None] % 9 == 2, -1, p), None), "exactly .-1, -1."),
        (lambda p, c: (p, 100 * c), "confidence up to 9.*divide it by 100"),
        (lambda p, c: (p / IMAGE, c), "multiply x by its width and y by its height"),
        (lambda p, c: (p - p[:, :1], c), "keypoint 0 .from 0. lies at"),
        (lambda p, c: (np.where(np.arange(25)[:, None] == 3, np.nan, p), c), "no frame shows "),
    ],
)
def test_arrays_are_checked_as_files_are(
    change: Callable[..., tuple[Any, Any]], complaint: str
) -> None:
    points, confidence = change(*in_layout(HUMAN25, 60))
    recipe = Recipe(steps=1, learning_rate=1e-7, batch=4)
    with pytest.warns(UserWarning, match=complaint) as caught:
        model = train(points, confidence, layout=HUMAN25, recipe=recipe)
    assert not [str(each.message) for each in caught if " --" in f" {each.message}"]
    if "no frame" not in complaint:
        judgement = model.provenance["judgement"]
        assert judgement["doubtful"] and re.search(complaint, judgement["reason"])
        told = " ".join([judgement["reason"], *judgement["faults"]])
        assert " --" not in told and "(--" not in told and "image_width" not in told


def test_each_sequence_is_checked_by_itself() -> None:
    points, confidence = in_layout(HUMAN25, 60)
    views = np.concatenate([points, points * [1, -1] + [0, 720], points])
    recipe = Recipe(steps=1, learning_rate=1e-7, batch=4)
    given = (views, np.tile(confidence, (3, 1)))
    with pytest.warns(UserWarning, match="frames 60 to 119: .* upside down"):
        train(*given, layout=HUMAN25, recipe=recipe, sequence_starts=(0, 60, 120))


def test_a_model_of_the_package_is_not_hidden() -> None:
    with pytest.raises(ValueError, match="name is 'human', the name of a model that comes with"):
        train(np.ones((5, 25, 2)), layout=HUMAN25, name="human")


def test_frames_that_show_nothing_are_padding() -> None:
    points, _ = in_layout(HUMAN25, 60)
    padded = np.concatenate([points, np.full_like(points, np.nan), 0 * points])
    recipe = Recipe(steps=1, learning_rate=1e-7, batch=4)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        train(padded, layout=HUMAN25, recipe=recipe, sequence_starts=None)
        train(padded, layout=HUMAN25, recipe=recipe, sequence_starts=(0, 60, 120))
    assert not [each for each in caught if "too few keypoints" in str(each.message)]


def test_arrays_in_another_layout_are_refused() -> None:
    with pytest.raises(ValueError, match="poor fit as human25: is it body25"):
        train(*in_layout(BODY25, 60), layout=HUMAN25)


def test_arrays_are_mapped_to_the_object_and_hands_to_right_ones() -> None:
    view = read_clip().session.views[0]
    recipe = Recipe(steps=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = train(
            view.points, view.confidence, layout="body25b", object="human25", recipe=recipe
        )
    assert model.layout == HUMAN25
    start = load_model("human").network.L  # a start of the same keypoints keeps its whitening
    np.testing.assert_array_equal(model.network.L, start)

    hands = virtual_hands(60).points
    both_sides = "look like those of the other side"
    with pytest.warns(UserWarning, match=f"{both_sides}.* what they are .hands.: palms .each"):
        train(hands, layout="hand21", recipe=recipe)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=f".*{both_sides}")
        warnings.filterwarnings("ignore", message=f"(?!.*{both_sides})")
        train(hands, layout="hand21", hands="right", recipe=recipe)
    with pytest.raises(ValueError, match="hands is 'both'; it is one of right, left, palms"):
        train(hands, layout="hand21", hands="both", recipe=recipe)

# SPDX-License-Identifier: Apache-2.0
"""The demo's page in a real browser, and its picture: the person stands on the floor, in view."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from deep_nrsfm_ros.commands.demo.first_look import main
from deep_nrsfm_ros.data.clip import read_clip
from deep_nrsfm_ros.data.keypoint_files import read_keypoints
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.layouts.presets import BODY25B, HUMAN17
from deep_nrsfm_ros.model_files.folders import default_models_dir
from deep_nrsfm_ros.model_files.model_file import load_model, save_model
from deep_nrsfm_ros.reporting.stage import Stage, make_stage, stage_page
from deep_nrsfm_ros.reporting.stage_image import Room, animation_frames, save_animation

NOSE, ANKLE = HUMAN17.index("nose"), HUMAN17.index("left_ankle")


@pytest.fixture(scope="module")
def stage() -> Stage:
    """Return the clip, with the ground truth in the place of what was lifted."""
    clip = read_clip()
    lifted = []
    for view in clip.session.views:
        shapes = np.full((len(view.points), len(HUMAN17), 3), np.nan)
        shapes[:, :12] = 1e-3 * np.nan_to_num(view.truth, nan=0.0)
        rest = shapes[:, :2].mean(1, keepdims=True) - 1e-3 * view.camera.rotation[:, 2] * -100
        shapes[:, 12:] = rest
        shapes[np.isnan(view.truth).any((1, 2))] = np.nan
        lifted.append(shapes)
    return make_stage(clip.session, clip.images, BODY25B, HUMAN17, lifted)


def test_truth_in_place_of_the_lifted_person_has_no_error(stage: Stage) -> None:
    for view in stage.views:
        assert view.errors.startswith("0 mm after alignment")
        np.testing.assert_allclose(view.shapes[20, :12], view.truth[20], atol=1e-6)
        assert 0 < np.nanmin(view.truth[..., 2]) < 0.3  # ankles above the floor, metres


@pytest.fixture(scope="module")
def page(stage: Stage, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the address of the page."""
    path = tmp_path_factory.mktemp("stage") / "demo.html"
    path.write_text(stage_page(stage, "a <person>", ["& a note"]), encoding="utf-8")
    return path.as_uri()


def test_a_page_links_to_another(stage: Stage) -> None:
    page = stage_page(stage, "a person", [], {"a & b": "other.html"})
    assert '<a href="other.html">a &amp; b</a>' in page
    assert "<a " not in stage_page(stage, "a person", ["a note"])


def test_page_shows_images_and_a_fitted_person(tab: Any, page: str) -> None:
    tab.open(page)
    tab.press("t")
    tab.press("Home")
    for _ in range(5):
        tab.press("ArrowRight")
    tab.wait("panes.every(p => p.images[5].complete && p.images[5].naturalWidth > 0)")
    shares = tab.evaluate(
        "panes.map(({canvas: c}) => { show(5); const d = c.getContext('2d')"
        ".getImageData(0, 0, c.width, c.height).data; let n = 0;"
        "for (let i = 3; i < d.length; i += 4) n += d[i] > 0; return n / (c.width * c.height); })"
    )
    assert min(shares) > 0.6  # the images fill their panes
    width, height = tab.evaluate("[orbit.width, orbit.height]")
    joints = np.array(tab.evaluate("orbit.joints"))[:, :2]
    assert ((joints > 0) & (joints < [width, height])).all()
    assert np.ptp(joints[:, 1]) > 0.35 * height
    assert joints[ANKLE, 1] > joints[NOSE, 1]


def test_the_body_is_drawn_until_b_is_pressed(tab: Any, page: str) -> None:
    tab.open(page)
    tab.press("t")
    widths = (
        "(() => { const before = stroke, found = []; stroke = (a, b, style, width) => {"
        "if (style === '#e6edf4') found.push(width); before(a, b, style, width); };"
        "orbit.draw(); stroke = before; return found; })()"
    )
    drawn = tab.evaluate(widths)
    assert len(drawn) > 10 and min(drawn) > 3  # pixels
    tab.press("b")
    assert tab.evaluate(widths) == []


def test_another_camera_is_chosen_by_its_number(tab: Any, page: str) -> None:
    tab.open(page)
    tab.press("t")
    assert tab.evaluate("document.querySelectorAll('#views figure').length") == 4
    tab.press("3")
    assert tab.evaluate("document.getElementById('caption').textContent").endswith("cam03 alone")
    assert tab.evaluate("document.querySelector('.chosen figcaption').textContent") == "cam03"


def test_the_slider_stops_and_moves_the_clip(tab: Any, page: str) -> None:
    tab.open(page)
    x, y = tab.middle("#slider")
    tab.drag((x, y), (x + 60, y))
    assert tab.evaluate("playing") is False and 20 < tab.evaluate("index") < 45


def test_the_person_is_within_the_picture(stage: Stage) -> None:
    view = stage.views[0]
    room = Room(stage, (300, 360), 0.4)
    at = room.project(view.shapes[np.isfinite(view.shapes).all((1, 2))])[..., :2]
    assert np.mean((at > 0) & (at < [300, 360])) > 0.97
    image = np.asarray(room.draw(view, 40)).astype(int)
    assert (np.abs(image - [214, 39, 40]).sum(2) < 30).any()  # the right side


def test_a_picture_holds_whoever_stands_far_beside(stage: Stage) -> None:
    room, near = Room(stage, (300, 360), 0.4), stage.views[0].shapes[0]
    zoom = room.zoom
    room.hold(near)
    assert room.zoom == zoom
    far = np.concatenate([near + [1.5, 0.5, 0], np.full((1, 3), np.nan)])
    room.hold(far)
    pixels = room.project(far)[:-1, :2]
    assert (pixels > 0).all() and (pixels < [300, 360]).all()
    assert pixels.min() < 10 or (pixels.max(0) > [290, 350]).any()  # no smaller than it must be


@pytest.mark.parametrize("suffix", ["webp", "gif"])
def test_animation_moves(stage: Stage, tmp_path: Path, suffix: str) -> None:
    images = list(islice(animation_frames(stage, stage.views[1], 90, 0.5), 3))
    save_animation(images, tmp_path / f"a.{suffix}", 0.05)
    with Image.open(tmp_path / f"a.{suffix}") as read:
        assert read.n_frames == 3  # type: ignore[attr-defined]


def test_a_first_look_without_ros(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["--output", str(tmp_path / "look")])
    said = capsys.readouterr().out
    assert said.count("100 of 100 frames lifted") == 4 and len(said.splitlines()) <= 40
    assert (tmp_path / "look" / "demo.html").as_uri() in said
    assert (tmp_path / "look" / "demo.png").read_bytes().startswith(b"\x89PNG")


def test_the_keypoints_are_files_to_lift_and_to_train_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["--output", str(tmp_path)])
    said = capsys.readouterr().out
    assert f"`lift` and `train` on: {tmp_path / 'cam01.npz'} to cam04.npz" in said
    for view in read_clip().session.views:
        read = read_keypoints(tmp_path / f"{view.camera.name}.npz", ReadOptions())
        assert read.layout is not None and read.layout.keypoints == BODY25B.keypoints
        assert len(read.stamps) == 100
        np.testing.assert_array_equal(read.points, view.points)


def test_a_model_of_ones_own_is_found_by_name_and_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_HOME", str(tmp_path))
    folder = default_models_dir()
    folder.mkdir(parents=True)
    save_model(folder / "my_own.safetensors", load_model("human17"))
    main(["--model", "my_own", "--output", str(tmp_path / "look")])
    assert capsys.readouterr().out.count("mm off after alignment") == 4


def test_a_model_that_lifts_no_person_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="demo: no model 'nobody'"):
        main(["--model", "nobody", "--output", str(tmp_path)])

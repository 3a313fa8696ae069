# SPDX-License-Identifier: Apache-2.0
"""Recordings in a real browser: they are drawn, they move, and nothing is complained of."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.data.detections import gather, stamps_at
from deep_nrsfm_ros.data.recording import Recording
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.lifting.observation import Observation
from deep_nrsfm_ros.nrsfm.geometry import centre
from deep_nrsfm_ros.reporting.player import SceneTransform, recording_page, scenes, stride

P = len(HUMAN17)
EVIL = '</script><img src=x onerror="alert(1)">&'
NOSE, ANKLE, LEFT, RIGHT = map(
    HUMAN17.index, ("nose", "left_ankle", "left_shoulder", "right_shoulder")
)


def body(f: int) -> np.ndarray:
    """Return a crude person (f, 17, 3) in object axes (x front, y left, z up) who waves."""
    S = np.zeros((f, P, 3))
    heights = {"nose": 1.5, "neck": 1.3, "shoulder": 1.3, "elbow": 1.0, "wrist": 0.75, "hip": 0.8}
    heights |= {"knee": 0.4, "ankle": 0.05, "toe": 0.0}
    for i, name in enumerate(HUMAN17.keypoints):
        side = {"left": 0.2, "right": -0.2}.get(name.split("_")[0], 0.0)
        S[:, i] = 0.2 * (name.endswith(("toe", "nose"))), side, heights[name.split("_")[-1]]
    S[:, HUMAN17.index("left_wrist"), 2] += 0.6 * np.sin(np.arange(f) / 5)
    return S


def recording_of(f: int = 30, layout: KeypointLayout = HUMAN17, offset: float = 0.0) -> Recording:
    """Return one person in front of a camera that goes half round; frame 3 was not lifted."""
    angles = np.linspace(0, np.pi, f)
    R = np.zeros((f, 3, 3))  # at first the person faces the camera: x front is -z, y left is x
    R[:, 0, 1], R[:, 0, 0] = np.cos(angles), np.sin(angles)
    R[:, 1, 2] = -1
    R[:, 2, 0], R[:, 2, 1] = -np.cos(angles), np.sin(angles)
    shapes = (centre(body(f)) @ R.swapaxes(1, 2) + [0, 0, offset]).astype(np.float32)
    points = (200 * shapes[..., :2] + [640, 360]).astype(np.float32)
    sure = np.full((f, P), 0.8, np.float32)
    seen = gather(
        [Observation(points[i : i + 1], sure[i : i + 1]) for i in range(f)], stamps_at(10, f), P
    )
    lifted = Lifted(
        shapes,
        R.astype(np.float32),
        np.full(f, 200, np.float32),
        np.tile(np.array([640, 360], np.float32), (f, 1)),
        np.full(f, 0.1, np.float32),
        sure.copy(),
        np.zeros_like(sure, np.bool_),
    )
    for part in lifted[:-1]:
        part[3] = np.nan
    lifted.confidence[3] = 0
    return Recording(layout, layout, seen, lifted)


def head_of(text: str) -> dict[str, Any]:
    (data,) = re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', text, re.DOTALL)
    head: dict[str, Any] = json.loads(data)
    return head


def test_scenes_say_what_was_lifted() -> None:
    recording = recording_of()
    shown = list(scenes(recording))
    assert len(shown) == 30 and [frame["t"] for frame in shown[:3]] == [0, 0.1, 0.2]
    assert "shape" not in shown[3]["objects"][0]
    (one,) = shown[7]["objects"]
    np.testing.assert_allclose(
        np.reshape(one["shape"], (P, 3)), recording.lifted.shapes[7], atol=1e-3
    )
    np.testing.assert_allclose(
        np.reshape(one["rotation"], (3, 3)), recording.lifted.rotations[7], atol=1e-4
    )
    assert one["size"] == 1 and one["position"] == [0, 0, 0] and shown[7]["camera"] is None


def test_points_in_place_have_a_camera() -> None:
    shown = list(scenes(recording_of(offset=4.0)))
    assert shown[0]["camera"] == pytest.approx([0, 0, -4], abs=1e-3)
    assert shown[5]["objects"][0]["position"] == pytest.approx([0, 0, 0], abs=1e-3)


def test_unknown_scale_and_rotation_are_bearable() -> None:
    recording = recording_of()
    for part in recording.lifted[1:5]:
        part[:] = np.nan
    text = recording_page(recording, "mine")
    (one,) = head_of(text)["frames"][0]["objects"]
    assert one["rotation"] is None and one["residual"] is None and one["position"] == [0, 0, 0]
    assert "NaN" not in text


def test_long_recordings_are_thinned_and_say_so() -> None:
    recording = recording_of(100)
    text = recording_page(recording, "mine", most=30)
    assert len(head_of(text)["frames"]) == 25 and "25 of 100 frames: one in 4" in text
    assert stride(recording, 100) == 1


def test_a_page_of_the_most_frames_stays_small() -> None:
    text = recording_page(recording_of(2000), "mine")
    assert len(head_of(text)["frames"]) == 2000 and len(text) < 3e6


def test_names_from_data_stay_text() -> None:
    names = (EVIL, *(f"{EVIL}{i}" for i in range(1, P)))
    text = recording_page(recording_of(layout=KeypointLayout(EVIL, names)), EVIL, [EVIL])
    assert "<img" not in text and text.count("</script>") == 2
    assert head_of(text)["source"]["names"][0] == EVIL


@pytest.fixture
def page(tmp_path: Path) -> str:
    """Return the address of a page that was written to a file."""
    path = tmp_path / "page.html"
    path.write_text(recording_page(recording_of(), "a wave"))
    return path.as_uri()


def pixels(tab: Any, canvas: str) -> str:
    """Return what is drawn on a canvas."""
    return str(tab.evaluate(f"document.getElementById({canvas!r}).toDataURL()"))


def joints(tab: Any) -> np.ndarray:
    """Return where the joints of the first object are drawn (p, 2), x right and y down."""
    return np.array(tab.evaluate("orbit.joints[0].at.map(p => [p[0], p[1]])"))


def test_the_slider_moves_both_skeletons(tab: Any, page: str) -> None:
    tab.open(page)
    before = {name: pixels(tab, name) for name in ("seen", "lifted")}
    assert tab.evaluate("document.getElementById('time').value").endswith("1 / 30")
    x, y = tab.middle("#slider")
    tab.drag((x, y), (x + 60, y))
    place = tab.evaluate("Number(document.getElementById('slider').value)")
    assert 10 < place < 29
    assert tab.evaluate("document.getElementById('time').value").endswith(f"{place + 1} / 30")
    for name, was in before.items():
        assert pixels(tab, name) != was, name


def test_people_are_upright_and_the_right_way_round(tab: Any, page: str) -> None:
    tab.open(page)
    at = joints(tab)
    assert at[NOSE, 1] < at[ANKLE, 1] - 100
    assert at[LEFT, 0] > at[RIGHT, 0]  # faces the camera, as in the image
    tab.press("End")  # by then the person's back is seen
    assert joints(tab)[LEFT, 0] < joints(tab)[RIGHT, 0]
    tab.press("v")  # the person at rest, seen from before again
    at = joints(tab)
    assert at[LEFT, 0] > at[RIGHT, 0] and at[NOSE, 1] < at[ANKLE, 1] - 100


def test_a_fixed_frame_has_no_camera_and_is_named(tab: Any, tmp_path: Path) -> None:
    recording = dataclasses.replace(recording_of(offset=4.0), fixed_frame="base_link")
    text = recording_page(recording, "a wave")
    assert head_of(text)["frames"][0]["camera"] is None
    (tmp_path / "page.html").write_text(text)
    tab.open((tmp_path / "page.html").as_uri())
    at = joints(tab)
    assert at[NOSE, 1] < at[ANKLE, 1] - 100
    assert tab.evaluate("$('view').textContent") == "view: base_link fixed"
    assert tab.evaluate("$('grid').textContent") == "level in base_link, z up"
    fixed = pixels(tab, "lifted")
    tab.evaluate("frames.forEach(f => { f.fixed = ''; }), show(0)")
    assert pixels(tab, "lifted") != fixed  # the camera is drawn again


def test_a_frame_that_becomes_known_starts_the_scene_anew() -> None:
    live, before = SceneTransform(), recording_of(offset=4.0)
    assert next(scenes(before, transform=live))["camera"]
    later = dataclasses.replace(recording_of(offset=9.0), fixed_frame="base_link")
    shown = next(scenes(later, transform=live))
    assert shown["fixed"] == "base_link" and shown["camera"] is None
    assert shown["objects"][0]["position"] == pytest.approx([0, 0, 0], abs=1e-3)


def test_dragging_turns_the_lifted_skeleton_alone(tab: Any, page: str) -> None:
    tab.open(page)
    seen, before = pixels(tab, "seen"), joints(tab)
    x, y = tab.middle("#lifted")
    tab.drag((x, y), (x + 90, y))
    turned = joints(tab)
    assert np.abs(turned - before).max() > 10 and pixels(tab, "seen") == seen
    tab.press("r")
    np.testing.assert_allclose(joints(tab), before)


def test_keys_step_and_play(tab: Any, page: str) -> None:
    tab.open(page)
    for _ in range(3):
        tab.press("ArrowRight")
    assert tab.evaluate("index") == 3
    assert tab.evaluate("document.getElementById('objects').textContent") == "0: not lifted"
    assert tab.evaluate("orbit.joints.length") == 0
    tab.press("ArrowLeft")
    assert tab.evaluate("index") == 2
    tab.press(" ")
    tab.wait("index > 5")
    tab.press(" ")
    assert tab.evaluate("playing") is False

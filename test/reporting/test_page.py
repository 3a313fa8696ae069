# SPDX-License-Identifier: Apache-2.0
"""The report stands alone, shows what there is, and takes nothing from data for HTML."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import xml.etree.ElementTree as ElementTree
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from deep_nrsfm_ros.data.curation import Curation, curate
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.held_out import split
from deep_nrsfm_ros.data.sufficiency import assess_sufficiency
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.model_files.model_file import Model, load_model, save_model
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from deep_nrsfm_ros.reporting.drawing import MISSING
from deep_nrsfm_ros.reporting.page import Training, page, write_report

EVIL = '</script><img src=x onerror="alert(1)">&'


class Progress(NamedTuple):
    """As `nrsfm.training` reports it, without torch."""

    step: int
    steps: int
    seed: int
    loss: float
    cycle_error: float
    coherence: float
    seconds_left: float


def model_of(layout: KeypointLayout, name: str = "mine", seed: int = 0) -> Model:
    net = initialise(Architecture(widths=(8, 4)), len(layout), np.random.default_rng(seed))
    quality = {"combined": 0.1234, "reprojection_error": 0.1, "cycle_error": 0.2, "coherence": 0.5}
    provenance = {"data": "bags b", "frames": 300, "recipe": {"steps": 7}}
    frame = np.eye(3, dtype=np.float32)
    return Model(name, net, layout, Normaliser(), frame, provenance, quality)


def training_of(
    layout: KeypointLayout = HUMAN17, f: int = 300, model: Model | None = None, **changes: Any
) -> Training:
    rng, p = np.random.default_rng(0), len(layout)
    S = centre(rng.standard_normal((p, 3)) + 0.2 * rng.standard_normal((f, p, 3)))
    points = (100 * S @ random_cameras(f, rng) + 300).astype(np.float32)
    points[::40, 3] += 900
    visible = np.ones((f, p), bool)
    visible[7, 2:] = False
    curated = curate(Dataset(points, visible, layout, "bags b"), Curation())
    progress = [Progress(s, 30, k, 1 / s, 0.3, 0.4, 0.0) for k in (0, 1) for s in (5, 10, 30)]
    fields: dict[str, Any] = {
        "model": model or model_of(layout),
        "path": Path("folder") / "mine.safetensors",
        "dataset": curated.dataset,
        "curated": curated,
        "sufficiency": assess_sufficiency(curated.dataset),
        "progress": progress,
    }
    return Training(**(fields | changes))


class Tags(HTMLParser):
    """Every tag with its attributes, and the text of the scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.scripts: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "br"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] == ["script"]:
            self.scripts.append(data)


def scenes_of(text: str) -> list[dict[str, Any]]:
    scenes: list[dict[str, Any]] = json.loads(Tags(text).scripts[0])
    return scenes


@pytest.fixture(scope="module")
def text() -> str:
    return page(training_of())


def test_it_is_sound_and_fetches_nothing(text: str) -> None:
    tags = Tags(text)
    assert tags.open == []
    assert not {tag for tag, _ in tags.tags} & {"link", "img", "iframe", "object", "embed"}
    assert not [a for _, a in tags.tags if {"src", "href", "onerror", "onclick"} & a.keys()]
    assert "http://" not in text and "https://" not in text and "url(" not in text
    for drawing in re.findall(r"<svg.*?</svg>", text, re.DOTALL):
        ElementTree.fromstring(drawing)


def test_every_canvas_has_its_scene(text: str) -> None:
    scenes = scenes_of(text)
    places = [int(a["data-scene"] or "") for tag, a in Tags(text).tags if tag == "canvas"]
    assert sorted(places) == list(range(len(scenes)))
    assert len(scenes) == 5 + 6 + 6  # the mean and four modes, the best, the worst
    for scene in scenes:
        assert np.shape(scene["points"]) == (17, 3) and np.isfinite(scene["points"]).all()
        assert len(scene["edges"]) == len(scene["colours"]) == len(HUMAN17.edges)


def test_what_no_frame_shows_is_drawn_pale() -> None:
    kept = training_of().dataset
    toe = HUMAN17.index("left_big_toe")
    visible = kept.visible.copy()
    visible[:, toe] = False
    blind = Dataset(kept.points, visible, HUMAN17, kept.source)
    for scene in scenes_of(page(training_of(dataset=blind))):
        pale = {
            toe in edge: c == MISSING
            for edge, c in zip(scene["edges"], scene["colours"], strict=True)
        }
        assert pale[True]
    mean, *_ = scenes_of(page(training_of()))
    assert MISSING not in mean["colours"]


def test_it_tells_what_was_left_out_and_hidden(text: str) -> None:
    curated = training_of().curated
    for count in (curated.total, curated.few_visible, curated.corrected, len(curated.dataset)):
        assert f'<td class="figure">{count}</td>' in text
    assert curated.corrected > 0 and HUMAN17.keypoints[3] in text
    assert "times the typical distance: keypoints hidden" in " ".join(text.split())


def test_warnings_come_first() -> None:
    text = page(training_of(f=60, warnings=["the end may be lost"]))
    assert (
        text.index("the end may be lost") < text.index("59 frames are few") < text.index("Use it")
    )


def test_each_seed_has_its_curve(text: str) -> None:
    assert text.count("<title>seed 0</title></polyline>") == 3
    assert text.count("<title>seed 1</title></polyline>") == 3


@pytest.mark.parametrize("progress", [[], [Progress(1, 1, 0, math.nan, math.inf, 0.0, 0.0)]])
def test_curves_bear_what_a_failed_training_leaves(progress: list[Progress]) -> None:
    assert "nan" not in "".join(re.findall(r"<svg.*?</svg>", page(training_of(progress=progress))))


def test_names_from_data_stay_text() -> None:
    names = (EVIL, *(f"{EVIL}{i}" for i in range(1, 9)))
    layout = KeypointLayout(EVIL, names, edges=((names[0], names[1]),))
    model = model_of(layout, name=EVIL)
    model.provenance[EVIL] = {EVIL: EVIL}
    whole = training_of(
        layout, model=model, warnings=[EVIL], path=Path(f"{EVIL[2:8]} x.safetensors")
    )
    tags = Tags(page(whole))
    assert tags.open == [] and len(tags.scripts) == 2
    assert "img" not in {tag for tag, _ in tags.tags}
    assert json.loads(tags.scripts[0])[0]["names"][0] == EVIL


def test_other_models_are_compared_with(tmp_path: Path) -> None:
    save_model(tmp_path / "other.safetensors", model_of(HUMAN17, "other", seed=1))
    points = KeypointLayout.numbered(5)
    save_model(tmp_path / "hand.safetensors", model_of(points, "hand"))
    (tmp_path / "broken.safetensors").write_bytes(b"nothing")
    whole = training_of(path=tmp_path / "mine.safetensors")
    save_model(whole.path, whole.model)
    assert write_report(whole, [tmp_path, tmp_path]) == tmp_path / "mine.html"
    text = (tmp_path / "mine.html").read_text()
    rows = re.findall(r"<tr[^>]*><td>(mine|other|hand|broken)</td>(.*?)</tr>", text, re.DOTALL)
    assert sorted(name for name, _ in rows) == ["mine", "other"]  # those of these keypoints
    assert all(len(re.findall(r"[\d.]+ %", cells)) >= 3 for _, cells in rows)
    assert "image error 0.100, cycle 0.200, coherence 0.500." in " ".join(text.split())
    assert sorted(f.name for f in tmp_path.glob("*mine*")) == ["mine.html", "mine.safetensors"]


@pytest.mark.parametrize("verdict", ["as_good", "alone"])
def test_the_verdict_on_the_model_is_that_of_its_training(verdict: str) -> None:
    whole = training_of()
    whole.model.provenance["judgement"] = {"verdict": verdict, "doubtful": False}
    text = page(whole)
    assert re.findall(r"<td>mine</td><td>(.*?)</td>", text) == [verdict]
    assert '<th class="figure">misfit</th>' in text


def test_a_report_on_another_object_sets_the_layout_first(text: str) -> None:
    first = "ros2 param set /lifter keypoint_layout model"
    dog = KeypointLayout("dog", tuple(f"dog_{i}" for i in range(len(HUMAN17))))
    other = page(training_of(layout=dog))
    assert first not in text and other.index(first) < other.index("/lifter model mine")


def test_a_model_that_is_the_mean_with_its_start_says_so() -> None:
    whole, said = training_of(), "the mean of its start"
    whole.model.provenance.update({"from": {"model": "human"}, "recipe": {"start_share": 0.6}})
    last = whole.progress[-1]
    whole.model.quality["combined"] = math.hypot(last.loss, last.cycle_error) + 0.05
    assert said in page(whole)
    whole.model.quality["combined"] -= 0.05  # of the same weights as the curves
    assert said not in page(whole)


def test_doubtful_models_stand_below_the_one_at_hand() -> None:
    whole = training_of()
    human = load_model("human")
    frames = split(whole.dataset, 0.1)
    text = page(dataclasses.replace(whole, held_out=frames, rival=human))
    rows = re.findall(r"<tr[^>]*><td>(mine|human)</td><td>(.*?)</td>", text)
    assert rows == [("human", "at hand"), ("mine", "doubtful")]
    assert f"the same {len(frames.held_out)} frames of this data" in " ".join(text.split())


def test_shapes_are_drawn_and_turn_in_a_browser(tab: Any, text: str, tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text(text)
    tab.open((tmp_path / "report.html").as_uri())
    drawn = "[...document.querySelectorAll('canvas')].map(c => c.toDataURL())"
    before = tab.evaluate(drawn)
    assert len(set(before)) == len(before) == 17
    still = "canvas:not(.large)"
    tab.evaluate(f"document.querySelector({still!r}).scrollIntoView({{block: 'center'}})")
    x, y = tab.middle(still)
    tab.drag((x, y), (x + 50, y))
    assert tab.evaluate(drawn)[5] != before[5]  # the first of the frames, after mean and modes


def test_use_it_names_the_layout_of_the_data() -> None:
    text = page(training_of(detector_layout="body25b", input_type="/maps/my people.yaml"))
    assert "-p keypoint_layout:=body25b \\\n" in text
    assert "-p input_type:=&#39;/maps/my people.yaml&#39; \\\n" in text
    assert "coco17" not in text
    assert "-p keypoint_layout:=LAYOUT" in page(training_of())

# SPDX-License-Identifier: Apache-2.0
"""Errors of models that were trained on from one of the package, by steps and share of the start.

Of each recording the first 70 % are trained on and the rest is kept back. Learned and later frames,
and another recording, are lifted by the model that the training starts from and by the new ones.
Rows "default" have the number of steps that a training takes where none is given, by the share of
the start's weights in the result (`start_share`).
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.data.people_scenes import (
    AZIMUTHS,
    CMU_STRIDE,
    filmed,
    humaneva_tracks,
    noisy,
    shelf_tracks,
)
from benchmarks.real import hands
from benchmarks.real.judge import WHEEL
from benchmarks.table import Table, bars, print_tables
from deep_nrsfm_ros.data.curation import Curation, curate
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.held_out import split
from deep_nrsfm_ros.data.mocap import human17, read_amc, read_asf, trials
from deep_nrsfm_ros.data.pose2sim import JOINTS, read_session
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import BODY25B, preset
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.model_files.model_file import Model, load_model
from deep_nrsfm_ros.nrsfm.metrics import camera_errors
from deep_nrsfm_ros.nrsfm.recipe import AUTOMATIC, Preset, Recipe
from deep_nrsfm_ros.training.fine_tuning import inherit, start_from
from deep_nrsfm_ros.training.finish import finish
from deep_nrsfm_ros.training.judge import judge
from deep_nrsfm_ros.training.limb_exchange import LimbExchange
from deep_nrsfm_ros.training.loop import train
from deep_nrsfm_ros.training.setup import Setup

Floats = NDArray[Any]

STEPS = (30, 100, 300, 1000, 3000)
SHARES = (0.0, 0.3, 0.8)
"""Shares of the start in the result, beside the default, with the default number of steps."""
_LEARNED = 0.7  # of a recording; the rest is kept back
_CMU_SUBJECT = "131"  # one that `human` was not trained on
_MOST_FRAMES = 1500  # that are lifted
_LEGEND = {
    "frames": "after curation, without those held out for the judge",
    "steps": "0: the model that the training starts from",
    "start share": "of the weights of the start in the result; 0.6 by default",
    "learned, later, other": "mean error in mm after alignment by a similarity, without "
    "intrinsics: of the frames trained on, of the rest of the recording, and of another one",
    "mirrored %": "of the rest of the recording; where it has no truth, of the other one",
    "judge": "1: better than the model that it starts from, 0: doubtful",
}


class Part(NamedTuple):
    """Frames of one recording.

    Attributes:
        layout: of the q keypoints.
        points: (n, q, 2), 0 where missing.
        confidence: (n, q), 0 where missing.
        truth: (n, k, 3) mm in the camera's axes, NaN where unknown.
        joints: names of the k keypoints of the truth.
        starts: first frames of the recordings that were joined.
    """

    layout: KeypointLayout
    points: Floats
    confidence: Floats
    truth: Floats
    joints: Sequence[str]
    starts: Sequence[int] = (0,)

    def rows(self, rows: slice) -> Part:
        """Return a slice of the frames."""
        return self._replace(
            points=self.points[rows], confidence=self.confidence[rows], truth=self.truth[rows]
        )


def joined(parts: Sequence[Part]) -> Part:
    """Return the frames of all parts, which have one layout and the same joints."""
    arrays = zip(*((part.points, part.confidence, part.truth) for part in parts), strict=True)
    points, confidence, truth = map(np.concatenate, arrays)
    starts = np.cumsum([0, *(len(part.points) for part in parts[:-1])]).tolist()
    return Part(parts[0].layout, points, confidence, truth, parts[0].joints, starts)


def clip(data: Path) -> list[Part]:
    """Return the demo's clip: a person seen by four cameras, as a detector saw him."""
    return [
        Part(BODY25B, np.nan_to_num(view.points), view.confidence, view.truth, JOINTS)
        for view in read_session(data / WHEEL).views
    ]


def shelf(data: Path) -> list[Part]:
    """Return the people of Shelf, as OpenPose saw them in five views."""
    tracks = shelf_tracks(data / "scenes/shelf/shelf_dev.npz")
    return [Part(t.layout, t.points, t.confidence, t.truth, JOINTS) for t in tracks]


def humaneva(data: Path) -> list[Part]:
    """Return a person of HumanEva in three views, with noise like a detector's."""
    exact = humaneva_tracks(data / "scenes/humaneva/humaneva_s1.npz")
    tracks = (noisy(track, seed) for seed, track in enumerate(exact))
    return [Part(t.layout, t.points, t.confidence, t.truth, JOINTS) for t in tracks]


def cmu(data: Path) -> list[Part]:
    """Return a subject of CMU before three simulated cameras, with noise like a detector's."""
    folder, parts = data / "cmu", []
    skeleton = read_asf(folder / _CMU_SUBJECT / f"{_CMU_SUBJECT}.asf")
    for seed, trial in enumerate(trials(folder, _CMU_SUBJECT)):
        motion = human17(read_amc(trial, skeleton))[::CMU_STRIDE].astype(float)
        for azimuth in AZIMUTHS:
            t = noisy(filmed(motion, azimuth, seed), seed)
            parts.append(Part(t.layout, t.points, t.confidence, t.truth, JOINTS))
    return parts


def hand_nyu(data: Path) -> list[Part]:
    """Return the labelled hand."""
    hand = hands.labelled(data / "scenes")
    known = np.asarray(np.isfinite(hand.truth).all((0, 2)))
    names = [name for name, has in zip(preset("hand21").keypoints, known, strict=True) if has]
    return [Part(preset("hand21"), hand.points, hand.confidence, hand.truth[:, known], names)]


def hands_signs(data: Path) -> list[Part]:
    """Return many right hands as detected, without truth."""
    points = hands.collection(data / "scenes", "signs")
    truth = np.full((len(points), 1, 3), np.nan)
    return [Part(preset("hand21"), points, np.ones(points.shape[:2], np.float32), truth, ["wrist"])]


READERS: dict[str, Callable[[Path], list[Part]]] = {
    reader.__name__: reader for reader in (clip, shelf, humaneva, cmu, hand_nyu, hands_signs)
}
DETECTORS = {"clip_detector": "clip", "shelf_detector": "shelf"}
"""Recordings whose new model has all keypoints of the detector, not those of the model."""
_OTHER = {"clip": "shelf", "hand_nyu": "", "hands_signs": "hand_nyu"}  # the clip for the rest
RECORDINGS = [*READERS, *DETECTORS]
_HANDS = ("hand_nyu", "hands_signs")


@cache
def read(name: str, data: Path) -> tuple[Part, Part]:
    """Return the frames of a recording to learn from, and those that are kept back."""
    parts = READERS[name](data)
    cuts = [int(_LEARNED * len(part.points)) for part in parts]
    pairs = list(zip(parts, cuts, strict=True))
    return (
        joined([part.rows(slice(cut)) for part, cut in pairs]),
        joined([part.rows(slice(cut, None)) for part, cut in pairs]),
    )


def errors(model: Model, part: Part) -> tuple[float, float]:
    """Return mean error in mm and mirrored frames in % of a part; NaN where it has no truth."""
    part = part.rows(slice(None, None, max(len(part.points) // _MOST_FRAMES, 1)))
    if not np.isfinite(part.truth).any():
        return np.nan, np.nan
    shapes = Lifter(model, layout=part.layout)(part.points, part.confidence).shapes
    shapes = shapes[:, [model.layout.index(joint) for joint in part.joints]]
    lifted = np.isfinite(shapes).all((1, 2))  # frames with too few keypoints are not
    found = camera_errors(shapes[lifted], part.truth[lifted])
    return found.aligned, 100 * found.mirrored


def tuned(start: Model, part: Part, recipe: Recipe, layout: KeypointLayout) -> tuple[Model, bool]:
    """Return the model that `train` makes of a part, and whether the judge calls it better."""
    points, confidence = KeypointMap(part.layout, layout)(part.points, part.confidence)
    points, visible = points.astype(np.float32), confidence > 0.1
    starts = np.array(part.starts)
    everything = Dataset(points, visible, layout, "benchmark", sequence_starts=starts)
    data = curate(everything).dataset
    frames = split(data, Curation().held_out)
    preset = Preset(start.network.architecture, start.normaliser, recipe)
    setup = Setup(start_from(start, layout), limb_exchange=LimbExchange.of(layout))
    trainer = train(frames.training.points, frames.training.visible, preset, setup)
    model = inherit(finish(trainer, "tuned", layout, data.source), start)
    return model, not judge(frames, model, start).doubtful


def recipes(steps: Sequence[int], shares: Sequence[float]) -> list[Recipe]:
    """Return the recipes of these numbers of steps, and those of the default number by share."""
    default = Recipe()
    return [
        *(dataclasses.replace(default, steps=count) for count in steps),
        *(dataclasses.replace(default, start_share=share) for share in shares),
        default,
    ]


def benchmark(
    names: Sequence[str], steps: Sequence[int], shares: Sequence[float], data: Path
) -> list[Table]:
    """Return the table of the recordings."""
    table = Table(
        "fine_tuning",
        "Trained on from the model of the package",
        ("recording", "steps", "start share"),
        ("frames", "CPU s", "learned", "later", "other", "mirrored %", "judge"),
        _LEGEND,
        bars("later", "other"),
    )
    for name in names:
        start = load_model("hand21" if name in _HANDS else "human")
        recording = DETECTORS.get(name, name)
        learned, later = read(recording, data)
        layout = learned.layout if name in DETECTORS else start.layout
        other = _OTHER.get(recording, "clip")
        parts = {"learned": learned, "later": later}
        if other:
            parts["other"] = joined(list(read(other, data)))

        def figures(model: Model, parts: dict[str, Part] = parts) -> dict[str, float]:
            found = {title: errors(model, part) for title, part in parts.items()}
            shown = {title: error for title, (error, _) in found.items() if np.isfinite(error)}
            mirrored = [m for _, m in (found["later"], found.get("other", (0, 0)))]
            known = [m for m in mirrored if np.isfinite(m)]
            return shown | {"mirrored %": known[0]}

        table.add((name, "0", ""), figures(start))
        for recipe in recipes(steps, shares):
            began = time.process_time()
            model, better = tuned(start, learned, recipe, layout)
            used = {"CPU s": time.process_time() - began, "judge": float(better)}
            taken = model.provenance["step"]
            title = f"{taken}, default" if recipe.steps == AUTOMATIC else str(taken)
            frames = {"frames": float(model.provenance["frames"])}
            table.add((name, title, str(recipe.start_share)), frames | used | figures(model))
    return [table]


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="*", help=f"of {', '.join(RECORDINGS)} (default: all)")
    parser.add_argument("--data", type=Path, required=True, help="has cmu/, pose2sim/, scenes/")
    parser.add_argument("--steps", type=int, nargs="*", default=list(STEPS))
    parser.add_argument("--shares", type=float, nargs="*", default=list(SHARES))
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks"))
    args = parser.parse_args(argv)
    names = args.recordings or RECORDINGS
    print_tables(lambda: benchmark(names, args.steps, args.shares, args.data), args.output)


if __name__ == "__main__":
    main()

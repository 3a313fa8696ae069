# SPDX-License-Identifier: Apache-2.0
"""Whether figures without labels tell good models from bad: short trainings and their true errors.

Each scene is trained on several times: from random weights and, where it shows a person, from
`human`, for few and for more steps. The judge of `training/judge.py` sees the keypoints alone.
Finished trainings are kept. The smaller a figure, the better the model should be.

Three tables: the models; how each figure orders the models of a scene; and what the rule decides in
each pair of two models of a scene, of which one is at hand and the other is new.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from benchmarks.data import synthetic_excavator
from benchmarks.real.model_selection import read_shapes, simulate_camera
from deep_nrsfm_ros.data.curation import curate
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.held_out import split
from deep_nrsfm_ros.data.mocap import trials
from deep_nrsfm_ros.data.pose2sim import JOINTS, read_session
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.layout_file import read_layout
from deep_nrsfm_ros.layouts.presets import BODY25B, HUMAN25
from deep_nrsfm_ros.lifting.lifter import Lifter, lift_all
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, Model, load_model, save_model
from deep_nrsfm_ros.nrsfm.layout_loss import LayoutLoss
from deep_nrsfm_ros.nrsfm.metrics import camera_errors
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, LayoutLossWeights, Recipe
from deep_nrsfm_ros.training.fine_tuning import inherit, start_from
from deep_nrsfm_ros.training.finish import finish
from deep_nrsfm_ros.training.judge import Figures, Judge, rank, worse_figures
from deep_nrsfm_ros.training.limb_exchange import LimbExchange
from deep_nrsfm_ros.training.loop import train
from deep_nrsfm_ros.training.setup import Setup

Floats = NDArray[Any]

WHEEL = "pose2sim/pose2sim-0.6.0-py3-none-any.whl"
HUMAN = "human"
HELD_OUT = 0.1
COLUMNS = (
    *("image_error", "bone_variation", "front_disagreement", "opposed", "side_difference"),
    *("flatness", "difference"),
)
ORDER = "order of the judge"
EXCAVATOR = Path(__file__).parents[2] / "config/layouts/excavator.yaml"
_EXCAVATOR_FRAMES = 1500
_MARGIN = 0.05  # by which an error must differ for a decision to count as wrong
_LIMBS = [HUMAN25.index(joint) for joint in JOINTS]
_HELP = LayoutLossWeights(bone_length_weight=3.0, handedness_weight=1.0, depth_penalty=0.1)


class Scene(NamedTuple):
    """Keypoints to train on, and their truth for the comparison alone.

    Attributes:
        data: n frames.
        truth: (n, k, 3) mm, in the camera's axes; NaN where unknown.
        joints: (k,) keypoints of the truth.
    """

    data: Dataset
    truth: Floats
    joints: Sequence[int]


class Run(NamedTuple):
    """A short training: its start, steps, seed, and whether the layout's losses help it."""

    start: str
    steps: int
    seed: int = 0
    helped: bool = False

    def __str__(self) -> str:
        """Return the name of the model file."""
        helped = "_layout" if self.helped else ""
        return f"{self.start or 'none'}{helped}_{self.steps}_{self.seed}"


PLAIN = [Run("", 300), Run("", 1000), Run("", 1000, 1)]
SCRATCH = [*PLAIN, Run("", 1000, 0, helped=True)]
TUNED = [Run(HUMAN, steps) for steps in (100, 300, 1000)]
PEOPLE = [*SCRATCH, *TUNED]
RUNS = {
    "clip": [*SCRATCH, Run("", 2000), *TUNED, Run(HUMAN, 2000)],
    "cmu_131": PEOPLE,
    "cmu_131_few": PEOPLE,
    "cmu_03_front": PEOPLE,
    "excavator": [*SCRATCH, Run("", 3000)],
    "excavator_front": SCRATCH,
    "hand": [*PLAIN, Run("", 3000)],
    "mouse": [*PLAIN, Run("", 3000)],
}


def clip(data: Path) -> Scene:
    """Return the demo's clip: a person seen by four cameras, as a detector saw him."""
    views = read_session(data / WHEEL).views
    points = np.concatenate([view.points for view in views])
    confidence = np.concatenate([view.confidence for view in views])
    truth = np.concatenate([view.truth for view in views])
    points, confidence = KeypointMap(BODY25B, HUMAN25)(points, confidence)
    lengths = [len(view.points) for view in views]
    return _curated(HUMAN25, points, confidence > 0.1, truth, _LIMBS, lengths)


def _mocap(subject: str, most: int, yaw: float, data: Path) -> Scene:
    """Return a subject before simulated cameras that stand within `yaw` degrees of the front."""
    shapes = read_shapes(trials(data / "cmu", subject), HUMAN25)
    seen = simulate_camera(shapes, np.random.default_rng(1))
    left, right = (seen.truth[:, JOINTS.index(f"{side}_shoulder")] for side in ("left", "right"))
    across = left - right
    facing = np.degrees(np.abs(np.arctan2(across[:, 2], across[:, 0]))) <= yaw
    chosen = np.flatnonzero(facing)
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(most, len(chosen))).astype(int)]
    visible = seen.confidence[chosen] > 0
    return _curated(HUMAN25, seen.points[chosen], visible, seen.truth[chosen], _LIMBS)


def _excavator(span: float, data: Path) -> Scene:
    """Return the simulated excavator, from sides within `span` degrees of one."""
    recording = synthetic_excavator.record(_EXCAVATOR_FRAMES, 0)
    layout = read_layout(EXCAVATOR)
    front, rear = (
        recording.truth[:, [layout.index(f"track_{end}_{side}") for side in ("left", "right")]]
        for end in ("front", "rear")
    )
    ahead = (front - rear).mean(1)
    angle = np.degrees(np.arctan2(ahead[:, 0], ahead[:, 2]))
    chosen = np.flatnonzero(np.abs((angle - angle[0] + 180) % 360 - 180) <= span)
    points = recording.points[chosen]
    visible = np.ones(points.shape[:2], bool)
    return _curated(layout, points, visible, 1000 * recording.truth[chosen], range(len(layout)))


def _views(
    file: str, edges: Sequence[tuple[str, str]], views: int, stride: int, data: Path
) -> Scene:
    """Return a recorded animal or hand before its first cameras."""
    recording = np.load(data / "scenes" / file)
    layout = KeypointLayout(
        "recorded", tuple(map(str, recording["joint_names"])), edges=tuple(edges)
    )
    points, truth = [], []
    for view in range(views):
        points.append(recording["points"][::stride, view, 0])
        turned = recording["truth"][::stride, 0] @ recording["R"][view].T
        truth.append(turned + recording["t"][view])
    W = np.concatenate(points)
    visible = np.isfinite(W).all(2)
    everywhere, lengths = range(len(layout)), [len(view) for view in points]
    shown = np.nan_to_num(W)
    return _curated(layout, shown, visible, np.concatenate(truth), everywhere, lengths)


def _curated(
    layout: KeypointLayout,
    points: Floats,
    visible: NDArray[np.bool_],
    truth: Floats,
    joints: Sequence[int],
    lengths: Sequence[int] = (),
) -> Scene:
    """Return the frames that the program `train` would keep.

    Args:
        layout: of the keypoints.
        points: (f, p, 2) of all frames.
        visible: (f, p) which keypoints are.
        truth: see `Scene`.
        joints: see `Scene`.
        lengths: frames of each view, one after the other; (): unknown.
    """
    starts = np.cumsum([0, *lengths])[:-1]
    seen = np.asarray(points, np.float32)
    curated = curate(Dataset(seen, visible, layout, "benchmark", sequence_starts=starts))
    return Scene(curated.dataset, truth[curated.frames], joints)


_FINGERS = [
    (f"{name}_tip", f"{name}_mid") for name in ("pinky", "ring", "middle", "index", "thumb")
]
_MOUSE = [
    (f"{a}{side}", f"{b}{side}")
    for side in "LR"
    for a, b in (("Wrist", "Elbow"), ("Elbow", "Shoulder"), ("Hindpaw", "Ankle"), ("Ankle", "Knee"))
]
SCENES: dict[str, Callable[[Path], Scene]] = {
    "clip": clip,
    "cmu_131": partial(_mocap, "131", 2000, 180.0),
    "cmu_131_few": partial(_mocap, "131", 300, 180.0),
    "cmu_03_front": partial(_mocap, "03", 2000, 30.0),
    "excavator": partial(_excavator, 180.0),
    "excavator_front": partial(_excavator, 40.0),
    "hand": partial(_views, "hand_nyu/hand_nyu_dev.npz", _FINGERS, 1, 2),
    "mouse": partial(_views, "mouse_dannce/mouse_dannce_predicted.npz", _MOUSE, 6, 4),
}


def trained(scene: Scene, run: Run, file: Path) -> Model:
    """Return the model of a run, from its file if that exists."""
    if file.exists():
        return load_model(file)
    frames, layout = split(scene.data, HELD_OUT).training, scene.data.layout
    start = load_model(run.start) if run.start else None
    preset = PRESETS["default"]
    if start:
        preset = preset._replace(
            architecture=start.network.architecture, normaliser=start.normaliser
        )
    recipe = Recipe(steps=run.steps, seed=run.seed, seeds=1)
    setup = Setup(
        start_from(start, layout) if start else None,
        LayoutLoss(_HELP, layout) if run.helped else None,
        limb_exchange=LimbExchange.of(layout),
    )
    trainer = train(frames.points, frames.visible, preset._replace(recipe=recipe), setup)
    model = finish(trainer, str(run), layout, "benchmark")
    save_model(file, inherit(model, start) if start else model)
    return load_model(file)


def truth(model: Model, scene: Scene) -> tuple[float, float]:
    """Return mean error in mm and share of mirrored frames in %, lifted as the lifter does it."""
    lifted = lift_all(Lifter(model).lift, scene.data.points, scene.data.visible.astype(np.float32))
    error = camera_errors(lifted.shapes[:, list(scene.joints)], scene.truth)
    return float(error.aligned), 100 * float(error.mirrored)


class Result(NamedTuple):
    """Models of a scene: their titles, true errors, and figures beside each other model.

    Attributes:
        titles: of the m models; the first is the one at hand in the first two tables.
        error: (m,) mean error in mm.
        mirrored: (m,) mirrored frames in %.
        figures: figures[new][old] of each pair of models.
    """

    titles: list[str]
    error: Floats
    mirrored: Floats
    figures: list[list[Figures]]


def measure(name: str, data: Path, output: Path) -> Result:
    """Train the models of a scene that are not there, and judge each beside each other one."""
    scene = SCENES[name](data)
    comparison = Judge(split(scene.data, HELD_OUT))
    models = {HUMAN: load_model(HUMAN)} if any(run.start for run in RUNS[name]) else {}
    for run in RUNS[name]:
        models[str(run)] = trained(scene, run, output / f"{name}_{run}{MODEL_SUFFIX}")
    errors = np.array([truth(model, scene) for model in models.values()])
    figures = [[comparison.figures(new, old) for old in models.values()] for new in models.values()]
    return Result(list(models), errors[:, 0], errors[:, 1], figures)


def rows(name: str, result: Result) -> list[str]:
    """Return a row of the first table for each model of a scene."""
    lines = []
    for k, title in enumerate(result.titles):
        new, old = result.figures[k][0], result.figures[0][0]
        verdict = "" if k == 0 else "doubtful" if worse_figures(new, old) else "better"
        values = (result.error[k], result.mirrored[k], *(getattr(new, c) for c in COLUMNS))
        cells = ("" if math.isnan(value) else f"{value:.3g}" for value in values)
        lines.append(f"| {name} | {title} | {verdict} | {' | '.join(cells)} |")
    return lines


def orders(result: Result) -> dict[str, float]:
    """Return how each figure orders the models of a scene: Spearman, and regret of its choice."""
    scores = {c: [getattr(row[0], c) for row in result.figures] for c in COLUMNS}
    ranks = [rank(row[0], result.figures[0][0]) for row in result.figures]
    scores[ORDER] = [100.0 * each.doubtful + 10 * each.at_hand + each.score for each in ranks]
    accuracy: dict[str, float] = {}
    for name, score in scores.items():
        known = not np.isnan(score).any() and np.ptp(score) > 0
        rho = spearmanr(score, result.error).statistic if known else math.nan
        accuracy[f"Spearman, {name}"] = float(rho)
        best = result.error[int(np.argmin(score))] / result.error.min() - 1 if known else math.nan
        accuracy[f"regret %, {name}"] = 100 * float(best)
    return accuracy


def decisions(result: Result) -> dict[str, float]:
    """Return what the rule decides in each pair of models of a scene, one at hand and one new.

    Without a judge, "always switch" and "never switch" have the same mean regret, since each pair
    counts in both orders.
    """
    regrets: dict[str, list[float]] = {"rule": [], "without a judge": []}
    counts = dict.fromkeys(("pairs", "switches", "worse", "mirrored", "missed"), 0)
    for old, new in permutations(range(len(result.titles)), 2):
        better = not worse_figures(result.figures[new][old], result.figures[old][old])
        best = min(result.error[old], result.error[new])
        for name, kept in (("rule", new if better else old), ("without a judge", new)):
            regrets[name].append(100 * (result.error[kept] / best - 1))
        gain = result.error[old] / result.error[new] - 1
        counts["pairs"] += 1
        counts["switches"] += better
        counts["worse"] += better and gain < -_MARGIN
        counts["missed"] += not better and gain > _MARGIN
        counts["mirrored"] += better and result.mirrored[new] > 5 >= result.mirrored[old]
    return counts | {f"regret %, {name}": float(np.mean(each)) for name, each in regrets.items()}


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", help=f"of {', '.join(SCENES)}; default: all")
    parser.add_argument("--data", type=Path, required=True, help="has cmu/, pose2sim/, scenes/")
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks/judge"))
    args = parser.parse_args(argv)
    args.output.mkdir(parents=True, exist_ok=True)
    columns = ("scene", "model", "judge", "PA mm", "mirrored %", *COLUMNS)
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    results: dict[str, Result] = {}
    try:
        for name in args.scenes or SCENES:
            results[name] = measure(name, args.data, args.output)
            print("\n".join(rows(name, results[name])), flush=True)
    except (ValueError, OSError) as error:
        print(f"failed: {error}", file=sys.stderr)
        sys.exit(2)
    for title, summarise in (("figure", orders), ("pairs", decisions)):
        print(f"\n| {title} | {' | '.join(results)} | mean |\n{'|---' * (2 + len(results))}|")
        summaries = [summarise(result) for result in results.values()]
        for row in summaries[0]:
            each = [summary[row] for summary in summaries]
            values: list[float] = [*each, float(np.nanmean(each))]
            cells = ("" if math.isnan(value) else f"{value:.3g}" for value in values)
            print(f"| {row} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()

"""Whether figures without labels tell good models from bad: short trainings and their true errors.

Each scene is trained on several times, from random weights and from `human`, for few and for more
steps. The judge of `training/judge.py` sees the keypoints alone. Finished trainings are kept.
The smaller a figure, the better the model should be. The share of frames mirrored against their
neighbours is left out: the scenes have too few frames for it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from benchmarks.real.model_selection import read_shapes, simulate_camera
from deep_nrsfm_ros.data.curation import curate
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.held_out import split
from deep_nrsfm_ros.data.mocap import trials
from deep_nrsfm_ros.data.pose2sim import JOINTS, read_session
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.presets import BODY25B, HUMAN17
from deep_nrsfm_ros.lifting.lifter import Lifter, lift_all
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, Model, load_model, save_model
from deep_nrsfm_ros.nrsfm.layout_loss import LayoutLoss
from deep_nrsfm_ros.nrsfm.metrics import camera_errors
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, LayoutLossWeights, Recipe
from deep_nrsfm_ros.training.fine_tuning import inherit, start_from
from deep_nrsfm_ros.training.finish import finish
from deep_nrsfm_ros.training.judge import Judge, worse_figures
from deep_nrsfm_ros.training.loop import Setup, train

Floats = NDArray[Any]

WHEEL = "pose2sim/pose2sim-0.6.0-py3-none-any.whl"
RIVAL = "human"
HELD_OUT = 0.1
COLUMNS = (
    *("residual", "bone_variation", "front_disagreement", "opposed", "side_difference"),
    *("flatness", "difference"),
)
COMBINATION = "residual + bone_variation + opposed"
_LIMBS = [HUMAN17.index(joint) for joint in JOINTS]
_HELP = LayoutLossWeights(bone_length_weight=3.0, handedness_weight=1.0, depth_penalty=0.1)


class Scene(NamedTuple):
    """Keypoints to train on, and their truth for the comparison alone.

    Attributes:
        data: n frames.
        truth: (n, 12, 3) mm, `JOINTS` in the camera's axes; NaN where unknown.
    """

    data: Dataset
    truth: Floats


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


SCRATCH = [Run("", 300), Run("", 1000), Run("", 1000, 1), Run("", 1000, 0, helped=True)]
TUNED = [Run(RIVAL, steps) for steps in (100, 300, 1000)]
RUNS = {
    "clip": [*SCRATCH, Run("", 2000), *TUNED, Run(RIVAL, 2000)],
    "cmu_131": [*SCRATCH, *TUNED],
    "cmu_131_few": [*SCRATCH, *TUNED],
    "cmu_03_front": [*SCRATCH, *TUNED],
}


def clip(data: Path) -> Scene:
    """Return the demo's clip: a person seen by four cameras, as a detector saw him."""
    views = read_session(data / WHEEL).views
    points = np.concatenate([view.points for view in views])
    confidence = np.concatenate([view.confidence for view in views])
    truth = np.concatenate([view.truth for view in views])
    points, confidence = KeypointMap(BODY25B, HUMAN17)(points, confidence)
    return _curated(np.asarray(points, np.float32), confidence > 0.1, truth)


def _mocap(subject: str, most: int, yaw: float, data: Path) -> Scene:
    """Return a subject before simulated cameras that stand within `yaw` degrees of the front."""
    shapes = read_shapes(trials(data / "cmu", subject), HUMAN17)
    seen = simulate_camera(shapes, np.random.default_rng(1))
    left, right = (seen.truth[:, JOINTS.index(f"{side}_shoulder")] for side in ("left", "right"))
    across = left - right
    facing = np.degrees(np.abs(np.arctan2(across[:, 2], across[:, 0]))) <= yaw
    chosen = np.flatnonzero(facing)
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(most, len(chosen))).astype(int)]
    return _curated(seen.points[chosen], seen.confidence[chosen] > 0, seen.truth[chosen])


def _curated(points: Floats, visible: NDArray[np.bool_], truth: Floats) -> Scene:
    """Return the frames that the program `train` would keep."""
    curated = curate(Dataset(np.asarray(points, np.float32), visible, HUMAN17, "benchmark"))
    return Scene(curated.dataset, truth[curated.frames])


SCENES: dict[str, Callable[[Path], Scene]] = {
    "clip": clip,
    "cmu_131": partial(_mocap, "131", 2000, 180.0),
    "cmu_131_few": partial(_mocap, "131", 300, 180.0),
    "cmu_03_front": partial(_mocap, "03", 2000, 30.0),
}


def trained(scene: Scene, run: Run, file: Path) -> Model:
    """Return the model of a run, from its file if that exists."""
    if file.exists():
        return load_model(file)
    frames = split(scene.data, HELD_OUT).training
    start = load_model(RIVAL) if run.start else None
    preset = PRESETS["default"]
    if start:
        preset = preset._replace(
            architecture=start.network.architecture, normaliser=start.normaliser
        )
    recipe = Recipe(steps=run.steps, seed=run.seed, seeds=1)
    setup = Setup(
        start_from(start, HUMAN17) if start else None,
        LayoutLoss(_HELP, HUMAN17) if run.helped else None,
    )
    trainer = train(frames.points, frames.visible, preset._replace(recipe=recipe), setup)
    model = finish(trainer, str(run), HUMAN17, "benchmark")
    save_model(file, inherit(model, start) if start else model)
    return load_model(file)


def truth(model: Model, scene: Scene) -> dict[str, float]:
    """Return the true errors of a model on all frames of a scene, lifted as the lifter does it."""
    lifted = lift_all(Lifter(model).lift, scene.data.points, scene.data.visible.astype(np.float32))
    error = camera_errors(lifted.shapes[:, _LIMBS], scene.truth)
    return {"PA mm": error.aligned, "mirrored %": 100 * error.mirrored}


def benchmark(name: str, data: Path, output: Path) -> tuple[list[str], dict[str, float]]:
    """Return the rows of a scene's models, and how each figure orders them as the truth does."""
    scene, rival = SCENES[name](data), load_model(RIVAL)
    frames = split(scene.data, HELD_OUT)
    court = Judge(frames)
    models = {RIVAL: rival} | {
        str(run): trained(scene, run, output / f"{name}_{run}{MODEL_SUFFIX}") for run in RUNS[name]
    }
    errors = {title: truth(model, scene) for title, model in models.items()}
    figures = {title: court.figures(model, rival) for title, model in models.items()}
    lines = []
    for title, each in figures.items():
        verdict = "doubtful" if worse_figures(each, figures[RIVAL]) else "better"
        verdict = "" if title == RIVAL else verdict
        values = (*errors[title].values(), *(each._asdict()[column] for column in COLUMNS))
        cells = (f"{value:.3g}" for value in values)
        lines.append(f"| {name} | {title} | {verdict} | {' | '.join(cells)} |")
    true = np.array([error["PA mm"] for error in errors.values()])
    scores = {
        column: np.array([each._asdict()[column] for each in figures.values()])
        for column in COLUMNS
    }
    parts = [scores[part] for part in COMBINATION.split(" + ")]
    scores[COMBINATION] = np.sum(parts, axis=0)
    accuracy: dict[str, float] = {}
    for column, score in scores.items():
        accuracy[f"Spearman, {column}"] = float(spearmanr(score, true).statistic)
        accuracy[f"regret %, {column}"] = 100 * float(true[score.argmin()] / true.min() - 1)
    return lines, accuracy


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", help=f"of {', '.join(SCENES)}; default: all")
    parser.add_argument("--data", type=Path, required=True, help="holds cmu/ and pose2sim/")
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks/judge"))
    args = parser.parse_args(argv)
    args.output.mkdir(parents=True, exist_ok=True)
    columns = ("scene", "model", "judge", "PA mm", "mirrored %", *COLUMNS)
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    summaries: dict[str, dict[str, float]] = {}
    try:
        for name in args.scenes or SCENES:
            lines, summaries[name] = benchmark(name, args.data, args.output)
            print("\n".join(lines), flush=True)
    except (ValueError, OSError) as error:
        print(f"failed: {error}", file=sys.stderr)
        sys.exit(2)
    print(f"\n| figure | {' | '.join(summaries)} | mean |\n{'|---' * (2 + len(summaries))}|")
    for row in next(iter(summaries.values())):
        each = [summary[row] for summary in summaries.values()]
        print(f"| {row} | {' | '.join(f'{v:.2f}' for v in (*each, np.mean(each)))} |")


if __name__ == "__main__":
    main()

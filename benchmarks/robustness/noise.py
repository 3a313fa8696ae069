# SPDX-License-Identifier: Apache-2.0
"""Error against noise of 0 to 20 % of the frame size, for training with and without noise."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from benchmarks.baselines.batches import chosen, solve
from benchmarks.harness import LIFTING_LEGEND, Session, errors_by_column, run_program, with_proper
from benchmarks.table import Table, lines
from deep_nrsfm_ros.commands.evaluate import ALONE, CONVENTIONS
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.lifting.options import LiftingOptions

SUBJECTS = ("01",)
RATIOS = {"0 %": 0.0, "5 %": 0.05, "10 %": 0.1, "15 %": 0.15, "20 %": 0.2}
LIFTING: dict[str, Callable[[float], LiftingOptions]] = {
    "network alone": lambda ratio: ALONE,
    "as shipped": lambda ratio: LiftingOptions(),
    "noise known": lambda ratio: LiftingOptions(noise=max(ratio, LiftingOptions().noise)),
}
WITH_BASELINES = (
    "Simple (Dai et al.)",
    "Simple, weighted nuclear norm (Kumar)",
    "Simple on frames that look alike",
)
"""Baselines that are solved with noise too."""
BASELINE_RATIOS = ("0 %", "20 %")
"""Columns for which they are solved."""
TEST_STRIDE = 5
"""Models are trained on all frames and tested on every n-th."""
TRAINED: dict[str, dict[str, float]] = {
    "default": {},
    "augmented by noise": {"added_noise": max(RATIOS.values())},
}
LEGEND = {
    "noise": "||noise||_F / ||W||_F of each frame, Gaussian; the truth is without",
    "default": "default recipe, trained on the frames without noise",
    "augmented by noise": "the same frames with noise up to the highest ratio added at each step",
    "network alone": LIFTING_LEGEND["network alone"],
    "as shipped": f"corrected for keypoints of {LiftingOptions().noise:.0%} noise",
    "noise known": "corrected with the true noise level (option `noise`)",
    "N %": f"shape error of every {TEST_STRIDE}th frame: {CONVENTIONS['shape %']}",
    "N % proper": CONVENTIONS["proper %"],
}


def add_noise(dataset: Dataset, ratio: float, seed: int = 0) -> Dataset:
    """Return the dataset with Gaussian noise of `ratio` times the norm of each centred frame."""
    if not ratio:
        return dataset
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal(dataset.points.shape).astype(np.float32)
    size = [np.linalg.norm(x, axis=(1, 2), keepdims=True) for x in (dataset.points, noise)]
    points = dataset.points + np.float32(ratio) * size[0] / size[1] * noise
    return dataclasses.replace(dataset, points=points)


def benchmark(session: Session) -> Table:
    """Return the table of errors of models trained with and without noise at each ratio."""
    table = Table(
        "noise",
        "Noise",
        ("subject", "trained", "lifting"),
        with_proper(RATIOS),
        LEGEND,
        lines(list(RATIOS), "noise", "shape error %"),
    )
    for subject in session.subjects:
        clean = session.mocap([subject], "train")
        test_frames = clean[slice(None, None, TEST_STRIDE)]
        tests = {name: add_noise(test_frames, ratio) for name, ratio in RATIOS.items()}
        for trained, recipe in TRAINED.items():
            for seed in session.seeds:
                title = f"{subject} {trained} seed {seed}"
                model = session.trained(title, clean, session.preset("default", seed, **recipe))
                for lifting, options in LIFTING.items():
                    row: dict[str, float] = {}
                    for name, ratio in RATIOS.items():
                        row |= errors_by_column({name: (model, tests[name])}, options(ratio))
                    table.add((subject, trained, lifting), row, seed)
        for name in chosen(session):
            if name in WITH_BASELINES:
                row = {}
                for column in BASELINE_RATIOS:
                    solved = solve(session, name, add_noise(clean, RATIOS[column]))
                    row[column] = solved.figures["shape %"]
                table.add((subject, name, "the same noise, settings by the truth"), row)
    return table


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    run_program(benchmark, __doc__, SUBJECTS, argv)


if __name__ == "__main__":
    main()

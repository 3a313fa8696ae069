# SPDX-License-Identifier: Apache-2.0
"""Share of inserted jumps and left-right swaps that curation finds in motion capture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import Session, run_program
from benchmarks.table import Table, bars
from deep_nrsfm_ros.data.curation import Curation
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.mocap import TrialSelection, read_split
from deep_nrsfm_ros.data.outliers import find_outliers
from deep_nrsfm_ros.layouts.presets import HUMAN17

SUBJECTS = ("01", "05", "49", "127")
CORRUPTED_FRACTION = 0.05
NOISE = 0.01
MIN_SWAP = 0.3
SWAPS = (
    ("wrist",),
    ("elbow", "wrist"),
    ("shoulder", "elbow", "wrist"),
    ("ankle",),
    ("knee", "ankle"),
    ("hip", "knee", "ankle"),
)
"""Body parts that are swapped together."""
FIGURES = {
    "clean points %": "keypoints hidden in uncorrupted frames",
    "clean frames %": "uncorrupted frames with a hidden keypoint",
    "jumps %": "keypoints displaced by 0.7 to 3 RMS radii that were hidden",
    "swaps %": "frames with swapped limbs in which a keypoint was hidden, of those in which the "
    f"swap moved a keypoint by more than {MIN_SWAP} RMS radii",
    "swapped points %": "swapped keypoints that were hidden; else a neighbour may be hidden",
}


class Corrupted(NamedTuple):
    """Corrupted keypoints.

    Attributes:
        points: (f, p, 2).
        jumps: (f, p) displacement by jumps in RMS radii.
        swaps: (f, p) displacement by swaps in RMS radii.
    """

    points: NDArray[np.float32]
    jumps: NDArray[np.float64]
    swaps: NDArray[np.float64]


def benchmark(session: Session) -> Table:
    """Corrupt the frames of each subject; return the table of detection rates."""
    table = Table(
        "corrupted_data",
        "Curation of corrupted frames",
        ("subject",),
        tuple(FIGURES),
        FIGURES,
        bars("jumps %", "swaps %"),
    )
    for subject in session.subjects:
        folder = session.data / "cmu"
        dataset = read_split(TrialSelection(folder, [subject], stride=session.stride), HUMAN17)
        for seed in session.seeds:
            table.add((subject,), detection_rates(dataset, corrupt(dataset, seed)), seed)
    return table


def corrupt(dataset: Dataset, seed: int) -> Corrupted:
    """Return noisy keypoints; `CORRUPTED_FRACTION` of the frames have a jump or a swap."""
    rng = np.random.default_rng(seed)
    P = dataset.points.astype(np.float64)
    f, p, _ = P.shape
    size = np.sqrt(((P - P.mean(1, keepdims=True)) ** 2).sum(2).mean(1))
    P += NOISE * size[:, None, None] * rng.standard_normal(P.shape)
    jumped, swapped = P.copy(), P.copy()
    chosen = rng.choice(f, int(CORRUPTED_FRACTION * f), replace=False)
    for i in chosen[::2]:
        angle, far = rng.uniform(0, 2 * np.pi), size[i] * rng.uniform(0.7, 3)
        jumped[i, rng.integers(p)] += far * np.array([np.cos(angle), np.sin(angle)])
    for i in chosen[1::2]:
        for part in SWAPS[rng.integers(len(SWAPS))]:
            sides = [dataset.layout.index(f"{side}_{part}") for side in ("left", "right")]
            swapped[i, sides] = P[i, sides[::-1]]
    moves = (np.linalg.norm(X - P, axis=2) / size[:, None] for X in (jumped, swapped))
    return Corrupted((jumped + swapped - P).astype(np.float32), *moves)


def detection_rates(dataset: Dataset, corrupted: Corrupted) -> dict[str, float]:
    """Return the `FIGURES` of curation with its default options."""
    hidden, _ = find_outliers(corrupted.points, dataset.visible, Curation().outlier_threshold)
    jumps, swaps = corrupted.jumps > 0, corrupted.swaps > MIN_SWAP
    clean = ~((corrupted.jumps > 0) | (corrupted.swaps > 0)).any(1)
    rates = (
        hidden[clean],
        hidden[clean].any(1),
        hidden[jumps],
        hidden[swaps.any(1)].any(1),
        hidden[swaps],
    )
    return {name: 100 * float(rate.mean()) for name, rate in zip(FIGURES, rates, strict=True)}


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    run_program(benchmark, __doc__, SUBJECTS, argv)


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: Apache-2.0
"""Classic sequences and few images of a category; fewer than the network needs.

`--subjects table bed sofa chair chairs faces` solves every fourth image of a category instead.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.baselines.batches import complete_legend, true_shapes
from benchmarks.baselines.methods import block_matrix, em_ppca, rigid
from benchmarks.data import mat_files
from benchmarks.data.synthetic_furniture import CATEGORIES
from benchmarks.harness import LIFTING_LEGEND, Session, run_program
from benchmarks.paper.table2_categories import CHAIRS, FACES, images
from benchmarks.table import Table, bars
from deep_nrsfm_ros.commands.evaluate import CONVENTIONS, LIFTING, figures
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.factorisation.consensus import consensus
from deep_nrsfm_ros.nrsfm.factorisation.em_ppca import em_ppca_by_likelihood
from deep_nrsfm_ros.nrsfm.geometry import align, centre, polar, rotation_from_camera
from deep_nrsfm_ros.nrsfm.metrics import shape_errors

Floats = NDArray[Any]

RANKS = (2, 3, 4, 5, 6, 7, 8)
"""Ranks K to choose from."""
STEPS = 10_000
"""Steps of a training."""
SEQUENCES = ("drink", "pickup", "face_mocap", "yoga", "dance", "shark")
EVERY = 4
"""Images of a category of which one is taken: about 500 are left."""
BASELINES: dict[str, Any] = {
    "Simple (Dai et al.)": block_matrix,
    "Simple, weighted nuclear norm (Kumar)": partial(block_matrix, weighted=True),
    "EM-SfM (Torresani et al.)": em_ppca,
    "EM-SfM, annealed or not by likelihood": em_ppca_by_likelihood,
}
AGREED = "factorisations that agree (no truth used)"
WITHOUT_RANK: dict[str, Any] = {
    AGREED: lambda W: consensus(W).shapes,
    "rigid factorisation (Tomasi-Kanade)": rigid,
}
_SPENT = {
    "CPU min": "CPU time on this machine of the training's steps, without the factorisations that "
    "teach it; or of the method with all K",
    "ms": "CPU time of a frame in ms, for one K",
}
_SHOWN = ("shape %", "proper %", "mirrored %")
ERRORS = {
    "e3D": "mean distance of points over the mean standard deviation of the true coordinates "
    "(Akhter et al. 2008, Dai et al. 2014): one rotation or reflection aligns the whole sequence "
    "in the axes of the ground truth, those of the world, or of the camera for face_mocap",
    "e3D by frame": "the same with one rotation or reflection per frame, which ignores wrong "
    "cameras and mirrored frames",
}
_LEGEND = {
    "frames": "few: the network overfits them; all figures are of the training frames",
    AGREED: "what a training of up to 2000 frames teaches its network, by nrsfm/factorisation",
    "bed, chair, sofa, table, chairs, faces": "every fourth image of table 2. They are of many "
    "objects, so that e3D means nothing",
    "K": "chosen by the lowest shape error against the ground truth, which favours the baselines; "
    "they solve the whole sequence at once",
}


def normalised_error(S: Floats, truth: Floats, *, by_frame: bool = False) -> float:
    """Return the e3D of S (f, p, 3), see `ERRORS`, without rescaling."""
    S, T = centre(S), centre(truth)
    deviation = T.std(1).mean()
    if not by_frame:
        S, T = S.reshape(1, -1, 3), T.reshape(1, -1, 3)
    aligned = align(S, T, allow_reflection=True).aligned
    return float(np.linalg.norm(aligned - T, axis=2).mean() / deviation)


def in_camera_axes(S: Floats, W: Floats) -> Floats:
    """Return S (f, p, 3) in the axes of the cameras that fit W (f, p, 2) best."""
    rows = polar((np.linalg.pinv(S) @ W).swapaxes(1, 2))
    turned: Floats = S @ rotation_from_camera(rows.swapaxes(1, 2)).swapaxes(1, 2)
    return turned


def lift_in_object_axes(model: Model, dataset: Dataset, options: LiftingOptions) -> Floats:
    """Return the lifted shapes (f, p, 3) of all frames in the model's object frame."""
    lifted = Lifter(model, options).lift(dataset.points, dataset.visible.astype(np.float32))
    return np.nan_to_num(lifted.scale[:, None, None] * lifted.shapes @ lifted.rotations)


def factorised(
    session: Session, name: str, sequence: mat_files.Sequence
) -> tuple[str, dict[str, float]]:
    """Return label and figures of a classic method, kept in the output folder.

    Of its ranks the one with the lowest error against the truth.
    """
    W, ranks = sequence.dataset.points, RANKS if name in BASELINES else (0,)

    def solve() -> tuple[int, dict[str, float]]:
        began = time.process_time()
        found = {}
        for K in tqdm(ranks, name, leave=False):
            S = BASELINES[name](W, K) if K else WITHOUT_RANK[name](W)
            found[K] = errors_of(S, sequence)
        spent = time.process_time() - began
        best = min(found, key=lambda K: found[K]["shape %"])
        times = {"CPU min": spent / 60, "ms": 1000 * spent / len(ranks) / len(W)}
        return best, found[best] | times

    K, row = session.kept(f"{name} {ranks}", W.tobytes(), solve)
    return (f"{name}, K = {K}" if K else name), row


def errors_of(S: Floats, sequence: mat_files.Sequence) -> dict[str, float]:
    """Return the errors of shapes (f, p, 3) in object axes."""
    truth = true_shapes(sequence.dataset)
    shown = figures(shape_errors(S, truth))
    placed = in_camera_axes(S, sequence.dataset.points) if sequence.in_camera_axes else S
    return {
        "e3D": normalised_error(placed, truth),
        "e3D by frame": normalised_error(S, truth, by_frame=True),
        **{figure: shown[figure] for figure in _SHOWN},
    }


def read(session: Session, name: str) -> mat_files.Sequence:
    """Return a sequence, or every fourth image of a category; every `stride`-th frame of it."""
    if name in (CHAIRS, FACES, *CATEGORIES):
        dataset = images(session, name)[slice(None, None, EVERY)]
        return mat_files.Sequence(dataset, in_camera_axes=False)
    sequence = mat_files.read_sequence(session.data / "nrsfm" / f"{name}.mat")
    return sequence._replace(dataset=sequence.dataset[slice(None, None, session.stride)])


def benchmark(session: Session) -> Table:
    """Train and solve each sequence; return the table of errors on its frames."""
    errors = {name: CONVENTIONS[name] for name in _SHOWN}
    table = Table(
        "classic_sequences",
        "Classic sequences, in-sample",
        ("sequence", "frames", "method"),
        (*ERRORS, *_SHOWN, *_SPENT),
        ERRORS | errors | _SPENT | _LEGEND | LIFTING_LEGEND,
        bars(*ERRORS),
    )
    table.digits |= {"e3D": 3, "e3D by frame": 3}
    for name in session.subjects:
        sequence = read(session, name)
        dataset = sequence.dataset
        labels = name, str(len(dataset))
        for seed in session.seeds:
            title, preset = f"{name} seed {seed}", session.preset("default", seed, steps=STEPS)
            model = session.trained(title, dataset, preset)
            for lifting, options in LIFTING.items():
                S = lift_in_object_axes(model, dataset, options)
                minutes = {"CPU min": model.provenance["cpu_seconds"] / 60}
                row = errors_of(S, sequence) | minutes
                table.add((*labels, f"default recipe, {lifting}"), row, seed)
        for method in (*WITHOUT_RANK, *BASELINES):
            if session.baselines is None or any(word in method for word in session.baselines):
                label, row = factorised(session, method, sequence)
                table.add((*labels, label), row)
    complete_legend(table)
    return table


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command; `--subjects` are sequences or categories here."""
    named = f"sequences, of {' '.join(SEQUENCES)}; or categories (default: all sequences)"
    run_program(benchmark, __doc__, SEQUENCES, argv, content=("nrsfm/*.mat", named))


if __name__ == "__main__":
    main()

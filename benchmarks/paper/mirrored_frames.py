"""Share of frames with mirrored depth, for each seed of the default recipe."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.harness import LIFTING_LEGEND, Session, run_program
from benchmarks.table import Table, bars
from deep_nrsfm_ros.commands.evaluate import CONVENTIONS, LIFTING, evaluate, figures

SUBJECTS = ("01", "05", "127")
SEEDS = (0, 1, 2, 3, 4)
_SPLITS = {"train": "first 80 %, in-sample", "held-out": "last 20 %"}
_LIFTED = ("network alone", "as shipped")
_SHOWN = ("shape %", "proper %", "mirrored %")


def benchmark(session: Session) -> Table:
    """Train with each seed; return the table of mirrored frames with one row per seed."""
    table = Table(
        "mirrored_frames",
        "Mirrored frames, seed by seed",
        ("subject", "tested on", "lifted", "run"),
        _SHOWN,
        {name: CONVENTIONS[name] for name in _SHOWN}
        | {name: LIFTING_LEGEND[name] for name in _LIFTED},
        bars("shape %", "proper %"),
    )
    for subject in session.subjects:
        dataset = session.mocap([subject], "train")
        tests = {
            description: session.mocap([subject], split) for split, description in _SPLITS.items()
        }
        for seed in session.seeds:
            title = f"{subject} default seed {seed}"
            model = session.trained(title, dataset, session.preset("default", seed))
            for tested_on, test in tests.items():
                for lifted in _LIFTED:
                    errors = figures(evaluate(model, test, LIFTING[lifted]))
                    shown = {name: errors[name] for name in _SHOWN}
                    table.add((subject, tested_on, lifted, f"seed {seed}"), shown, seed)
    return table


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    run_program(benchmark, __doc__, SUBJECTS, argv, seeds=SEEDS)


if __name__ == "__main__":
    main()

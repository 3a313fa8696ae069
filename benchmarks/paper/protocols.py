# SPDX-License-Identifier: Apache-2.0
"""What the paper's protocol gives: a camera a frame at 120 Hz, every 24th frame, a camera a trial.

In the protocol each frame of a 120 Hz motion has a random camera, so that frames near in time are
nearly several views of one pose. Every 24th frame (5 Hz) has few such neighbours; with one camera
for each trial there are none, as in a recording by a fixed camera.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any

from benchmarks.baselines.batches import LEGEND as BASELINE_LEGEND
from benchmarks.baselines.batches import SPENT, chosen, complete_legend, solve
from benchmarks.harness import LIFTING_LEGEND, Session, run_program
from benchmarks.table import Table, bars
from deep_nrsfm_ros.commands.evaluate import CONVENTIONS, LIFTING, evaluate, figures

SUBJECTS = ("01", "05", "127")
PROTOCOLS: dict[str, dict[str, Any]] = {
    "a camera a frame, 120 Hz (the paper's)": {},
    "a camera a frame, 5 Hz": {"stride": 24},
    "a camera a trial, 120 Hz": {"one_camera": True},
}
_LIFTED = ("network alone", "as shipped")
_SHOWN = [name for name in CONVENTIONS if name != "point cm"]


def benchmark(session: Session, words: Sequence[str] = ("",)) -> Table:
    """Train and solve each subject in each protocol; return the errors on the same frames.

    Args:
        session: data, subjects, seeds and baselines.
        words: of which the name of a protocol has one.
    """
    table = Table(
        "protocols",
        "The paper's protocol and two that are less nearly multi-view, in-sample",
        ("subject", "protocol", "method"),
        (*_SHOWN, *SPENT),
        CONVENTIONS | SPENT | LIFTING_LEGEND | BASELINE_LEGEND,
        bars("shape %", "proper %"),
    )
    table.digits["frames"] = 0
    for subject in session.subjects:
        for protocol, changes in PROTOCOLS.items():
            if not any(word in protocol for word in words):
                continue
            changed = dataclasses.replace(session, **changes)
            dataset = changed.mocap([subject], "train")
            for seed in session.seeds:
                # The first title is that of Table 1, which finds the same training.
                title = f"{subject} default seed {seed}"
                model = session.trained(title, dataset, session.preset("default", seed))
                for lifting in _LIFTED:
                    shown = figures(evaluate(model, dataset, LIFTING[lifting]))
                    row = {name: shown[name] for name in _SHOWN} | {"frames": len(dataset)}
                    row["CPU min"] = model.provenance["cpu_seconds"] / 60
                    table.add((subject, protocol, f"default recipe, {lifting}"), row, seed)
            for name in chosen(session):
                solved = solve(session, name, dataset)
                shown = {f: x for f, x in solved.figures.items() if f in table.figures}
                table.add((subject, protocol, solved.label), shown)
    complete_legend(table)
    return table


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument(
        "--protocols",
        nargs="+",
        default=[""],
        metavar="WORD",
        help="those alone whose name has one of these",
    )
    known, others = parser.parse_known_args(argv)
    run_program(partial(benchmark, words=known.protocols), __doc__, SUBJECTS, others, own=parser)


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: Apache-2.0
"""List the models that the lifter can use, with what the judge says of them and provenance."""

from __future__ import annotations

import argparse
import sys
import textwrap
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from deep_nrsfm_ros.commands.program import Parser, program, program_name
from deep_nrsfm_ros.model_files.folders import default_models_dir, model_folders
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, Model, ModelFileError, load_model
from deep_nrsfm_ros.training.same_name import CUT_OFF
from deep_nrsfm_ros.training.verdicts import ALONE, AS_GOOD, BETTER, DOUBTFUL, UNKNOWN

COLUMNS = ("model", "object", "keypoints", "judged", "date")
NOT_JUDGED = "-"
EXPLANATION = (
    "judged: whether the model was better than the one at hand at its training (as_good: alike), "
    "without labels; alone = no other model had its keypoints; - = not judged. Models of one "
    "object are in this order: better, as_good, alone, not judged, doubtful. Your newest model "
    "has file, data, reason and errors below it; --details shows them for all. "
    "Errors on the data of a training compare models of these data alone. A date with ~ is that of "
    "the file, since the model does not record the day of its training"
)


class Listed(NamedTuple):
    """A model file in the list.

    Attributes:
        row: cells of `COLUMNS`.
        notes: lines below it that are always shown: what is wrong with the file.
        details: further lines, shown for the newest model or where they are asked for.
        time: when the file was written, in s; 0: it is not in the user's own folder.
    """

    row: tuple[str, ...]
    notes: tuple[str, ...]
    details: tuple[str, ...] = ()
    time: float = 0.0


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = Parser(prog=program_name("models"), description=f"{__doc__} {EXPLANATION}.")
    parser.add_argument(
        "--models-dir",
        type=Path,
        default=default_models_dir(),
        help="folder of your own models, as the lifter's parameter models_dir; they hide those "
        "that come with the package and have the same name (default: %(default)s)",
    )
    parser.add_argument(
        "--details",
        action="store_true",
        help="show file, data, reason and errors of every model, not of the newest alone",
    )
    return parser


def find_files(folders: Sequence[Path]) -> list[Path]:
    """Return every model file in the folders, in order; the same file by the same name once."""
    files: dict[tuple[Path, str], Path] = {}
    for folder in folders:
        for path in sorted(folder.glob(f"*{MODEL_SUFFIX}")):
            files.setdefault((path.resolve(), path.stem), path)
    return list(files.values())


def list_models(folders: Sequence[Path]) -> list[Listed]:
    """Return a row and notes for every model file: by object, doubtful and unusable ones last."""
    listed: list[Listed] = []
    places: dict[str, Path] = {}
    for path in find_files(folders):
        first = places.setdefault(path.stem, path)
        note = (f"hidden by {first}",) if first != path else ()
        try:
            model = load_model(path)
        except ModelFileError as error:
            listed.append(Listed((path.stem, "unusable"), (str(error), *note)))
            continue
        row = (path.stem, model.layout.name, str(len(model.layout)), _verdict(model))
        details = (str(path), _origin(model), *_judgement(model), *_quality(model))
        written = path.stat().st_mtime if path.parent == folders[0] else 0.0
        listed.append(Listed((*row, _date(model, path)), note, details, written))
    return sorted(listed, key=_rank)


def _rank(listed: Listed) -> tuple[bool, str, int]:
    """Return the place of a model in the list."""
    usable = len(listed.row) == len(COLUMNS)
    verdicts = (BETTER, AS_GOOD, ALONE, UNKNOWN, NOT_JUDGED, DOUBTFUL)
    return not usable, listed.row[1], verdicts.index(listed.row[3]) if usable else 0


def _verdict(model: Model) -> str:
    """Return what the judge of the training says of a model."""
    judgement = model.provenance.get("judgement")
    if not isinstance(judgement, dict):
        return NOT_JUDGED
    if judgement.get("doubtful"):
        return DOUBTFUL
    if "rival" not in judgement:
        return ALONE
    said = judgement.get("verdict")
    return said if said in (AS_GOOD, UNKNOWN) else BETTER


def _quality(model: Model) -> tuple[str, ...]:
    """Return a note with the mean errors on frames of the training, if the file has them."""
    words = {"reprojection_error": "image error", "cycle_error": "cycle error"}
    figures = {word: model.quality.get(name) for name, word in words.items()}
    known = [f"{name} {f:.3f}" for name, f in figures.items() if isinstance(f, (int, float))]
    return (f"on the data of its training: {', '.join(known)}",) if known else ()


def _date(model: Model, path: Path) -> str:
    """Return the day of the training, or that of the file with a "~" before it."""
    said = model.provenance.get("date")
    if isinstance(said, str):
        return said
    return time.strftime("~%Y-%m-%d", time.gmtime(path.stat().st_mtime))


def _origin(model: Model) -> str:
    """Return what the model was trained on, and from what."""
    said: dict[str, Any] = model.provenance
    start = said.get("from")
    # A training of no steps keeps the network of its start, whose steps count.
    same_network = said.get("step") == 0 and isinstance(start, dict) and "step" in start
    counts = said | {"step": start["step"]} if same_network and isinstance(start, dict) else said
    parts = [str(said.get("data", "of unknown data"))]
    parts += [f"{counts[key]} {unit}" for key, unit in _COUNTS.items() if key in counts]
    last = said.get("last_step")
    if isinstance(last, dict) and "data" in last:
        parts.append(f"error covariance and bones from {last['data']}")
    if said.get(CUT_OFF):
        parts.append("cut off before its end")
    if isinstance(start, dict) and not same_network:
        parts.append(f"from model {start.get('model')}")
    return "; ".join(parts)


def _judgement(model: Model) -> tuple[str, ...]:
    """Return a note with the judgement, if there is one."""
    if _verdict(model) == NOT_JUDGED:
        return ()
    return (str(model.provenance["judgement"].get("reason")),)


_COUNTS = {"frames": "frames", "step": "steps"}


def show(listed: Sequence[Listed], *, details: bool = True) -> str:
    """Return the models as a table for people, each with its notes below it.

    Args:
        listed: the models.
        details: whether each has its details too; otherwise the newest one alone has.
    """
    newest = max((model.time for model in listed), default=0.0)
    rows = [COLUMNS, *(model.row for model in listed)]
    widths = [max(len(row[i]) for row in rows if len(row) > i) for i in range(len(COLUMNS))]
    lines = []
    for row, notes, more, written in [Listed(COLUMNS, ()), *listed]:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=False))
        lines.append("  ".join(cells).rstrip())
        has_details = details or (written > 0 and written == newest)
        for note in (*(more if has_details else ()), *notes):
            lines += textwrap.wrap(
                note,
                100,
                initial_indent="    ",
                subsequent_indent="      ",
                break_long_words=False,
                break_on_hyphens=False,
            )
    return "\n".join(lines)


@program
def main(argv: Sequence[str] | None = None) -> None:
    """Print the models; exit code 2 says that there are none."""
    args = arguments().parse_args(argv)
    folders = model_folders(args.models_dir.expanduser())
    listed = list_models(folders)
    if not listed:
        print(f"failed: no models in {', '.join(map(str, folders))}", file=sys.stderr)
        sys.exit(2)
    print(show(listed, details=args.details), textwrap.fill(EXPLANATION, 100), sep="\n\n")


if __name__ == "__main__":
    main()

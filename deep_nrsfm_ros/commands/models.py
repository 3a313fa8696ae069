"""List the models that the lifter can use, with their label-free quality and provenance."""

from __future__ import annotations

import argparse
import sys
import textwrap
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from deep_nrsfm_ros.commands.program import program, program_name
from deep_nrsfm_ros.model_files.folders import default_models_dir, model_folders
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, Model, ModelFileError, load_model

COLUMNS = ("model", "object", "keypoints", "reprojection", "cycle", "date")
QUALITY = ("reprojection_error", "cycle_error")
EXPLANATION = (
    "reprojection, cycle: label-free errors on the data of the training, relative, less is better; "
    "they compare models of the same data; - = not recorded. A date with ~ is that of the file, "
    "since the model does not record the day of its training"
)


class Listed(NamedTuple):
    """A model file in the list: a row of `COLUMNS`, and notes for the lines below it."""

    row: tuple[str, ...]
    notes: tuple[str, ...]


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog=program_name("models"), description=f"{__doc__} {EXPLANATION}."
    )
    parser.add_argument(
        "--models-dir",
        type=Path,
        default=default_models_dir(),
        help="folder of your own models, as the lifter's parameter models_dir; they hide those "
        "that come with the package and have the same name (default: %(default)s)",
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
    """Return a row and notes for every model file, unusable ones included."""
    listed: list[Listed] = []
    for path in find_files(folders):
        hidden = any(path.stem == other.row[0] for other in listed)
        note = ("hidden by the one of this name above",) if hidden else ()
        try:
            model = load_model(path)
        except ModelFileError as error:
            listed.append(Listed((path.stem, "unusable"), (str(error), *note)))
            continue
        row = (path.stem, model.layout.name, str(len(model.layout)), *_quality(model))
        listed.append(
            Listed((*row, _date(model, path)), (str(path), _origin(model), *_doubt(model), *note))
        )
    return listed


def _quality(model: Model) -> tuple[str, ...]:
    """Return the label-free figures, "-" where the file has none."""
    figures = (model.quality.get(name) for name in QUALITY)
    return tuple(f"{f:.3f}" if isinstance(f, (int, float)) else "-" for f in figures)


def _date(model: Model, path: Path) -> str:
    """Return the day of the training, or that of the file with a "~" before it."""
    said = model.provenance.get("date")
    if isinstance(said, str):
        return said
    return time.strftime("~%Y-%m-%d", time.gmtime(path.stat().st_mtime))


def _origin(model: Model) -> str:
    """Return what the model was trained on, and from what."""
    said: dict[str, Any] = model.provenance
    parts = [str(said.get("data", "of unknown data"))]
    parts += [f"{said[key]} {unit}" for key, unit in _COUNTS.items() if key in said]
    start = said.get("from")
    if isinstance(start, dict):
        parts.append(f"from model {start.get('model')}")
    return "; ".join(parts)


def _doubt(model: Model) -> tuple[str, ...]:
    """Return a note on a model that the judge of its training doubts."""
    judgement = model.provenance.get("judgement")
    if isinstance(judgement, dict) and judgement.get("doubtful"):
        return (str(judgement.get("reason")),)
    return ()


_COUNTS = {"frames": "frames", "step": "steps"}


def show(listed: Sequence[Listed]) -> str:
    """Return the models as a table for people, each with its notes below it."""
    rows = [COLUMNS, *(model.row for model in listed)]
    widths = [max(len(row[i]) for row in rows if len(row) > i) for i in range(len(COLUMNS))]
    lines = []
    for row, notes in [(COLUMNS, ()), *listed]:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=False))
        lines.append("  ".join(cells).rstrip())
        for note in notes:
            lines += textwrap.wrap(
                *(note, 100),
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
    print(show(listed), textwrap.fill(EXPLANATION, 100), sep="\n\n")


if __name__ == "__main__":
    main()

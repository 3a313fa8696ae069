# SPDX-License-Identifier: Apache-2.0
"""What becomes of the model that has the name of a new one.

A good model, one that was trained to its end and is not doubtful, is replaced only by one that is
not doubtful beside it. Whatever is replaced is kept once, as NAME_before. A doubtful model is
written beside a good one of the same object as NAME_doubtful, one that cannot be compared with it
as NAME_new, and one that was cut off as NAME_unfinished. A first look, of few steps from random
weights, is no good model, and neither is one that fits badly.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.model_files.folders import model_folders, shipped_models
from deep_nrsfm_ros.model_files.matching_model import knows
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, Model, ModelFileError, load_once
from deep_nrsfm_ros.training.verdicts import UNKNOWN

if TYPE_CHECKING:
    from deep_nrsfm_ros.training.judge import Judgement

BEFORE, DOUBTFUL, NEW, UNFINISHED = "_before", "_doubtful", "_new", "_unfinished"
CUT_OFF = "cut_off"
"""Key of the provenance of a model whose training did not come to its end; its value is True."""

_REPORT_SUFFIX = ".html"


class OldModel(NamedTuple):
    """The model that is in the file of a new one.

    Attributes:
        path: its file.
        model: None where it cannot be read.
    """

    path: Path
    model: Model | None

    @property
    def is_cut_off(self) -> bool:
        """Whether its training did not come to its end."""
        return self.model is not None and CUT_OFF in self.model.provenance

    @property
    def is_good(self) -> bool:
        """Whether it was trained to its end, is not doubtful, no first look, and fits."""
        if self.model is None or self.is_cut_off:
            return False
        judgement = self.model.provenance.get("judgement")
        if not isinstance(judgement, dict):
            return True
        return not any(map(judgement.get, ("doubtful", "first_look", "fits_badly")))

    def is_at_stake(self, layout: KeypointLayout, judgement: Judgement | None) -> bool:
        """Return whether a new model of a layout may not simply take the name of this good one.

        Args:
            layout: of the new model.
            judgement: of it; None: it was cut off.
        """
        return self.is_good and (judgement is None or self.is_rival(layout))

    def is_rival(self, layout: KeypointLayout) -> bool:
        """Return whether a new model of a layout must be better: it is good and of one object."""
        return self.is_good and self.model is not None and knows(self.model.layout, layout)


def old_model(folder: Path, name: str) -> OldModel | None:
    """Return the model that has a name in a folder; None if there is none."""
    path = folder / f"{name}{MODEL_SUFFIX}"
    if not path.is_file():
        return None
    try:
        return OldModel(path, load_once(path))
    except ModelFileError:
        return OldModel(path, None)


def name_beside(name: str, old: OldModel | None, judgement: Judgement | None) -> str:
    """Return the name under which a new model is written.

    Args:
        name: name that was asked for.
        old: the model of that name that is not to be lost; None: there is none.
        judgement: of the new model; None: it was cut off.
    """
    if old is None:
        return name
    if judgement is None:
        return name + UNFINISHED
    if judgement.verdict == UNKNOWN:
        return name + NEW
    return name + DOUBTFUL if judgement.doubtful else name


def keep_before(path: Path) -> str:
    """Keep a model, and its report, that a new one is about to replace; return its new name.

    What was kept by that name is replaced. The files are linked where the disk can do that, so
    that a full disk stops nothing.

    Raises OSError if the model can be neither linked nor copied.
    """
    before = path.with_name(f"{path.stem}{BEFORE}{MODEL_SUFFIX}")
    _duplicate(path, before)
    with suppress(OSError):  # a report is no model: it may be missing
        before.with_suffix(_REPORT_SUFFIX).unlink(missing_ok=True)
        _duplicate(path.with_suffix(_REPORT_SUFFIX), before.with_suffix(_REPORT_SUFFIX))
    return before.stem


def _duplicate(path: Path, other: Path) -> None:
    """Give the content of a file a second name, completely or not at all."""
    partial = other.with_name(f".{other.name}.{os.getpid()}")
    try:
        try:
            os.link(path, partial)
        except FileNotFoundError:
            raise
        except OSError:  # a disk without links
            shutil.copyfile(path, partial)
        partial.replace(other)
    finally:
        partial.unlink(missing_ok=True)


def check_not_shipped(option: str, name: str, folder: Path | None = None) -> None:
    """Raise ValueError for the name of a model of the package, which the new one would hide.

    In the package's own folders of models it may be trained anew.

    Args:
        option: what gives the name, for the message.
        name: name of the new model.
        folder: its folder; None: unknown.
    """
    shipped = {path.stem for path in shipped_models()}
    own = {each.resolve() for each in model_folders(folder)[1:]} if folder else set()
    if name in shipped and not (folder and folder.expanduser().resolve() in own):
        raise ValueError(
            f"{option} is {name!r}, the name of a model that comes with the package and that yours "
            f"would hide; choose another, such as 'my_{name}'"
        )

# SPDX-License-Identifier: Apache-2.0
"""The files that the lifter may read and write at the request of others on the network.

The owner of the lifter starts it, and may name any file at the start. Later, anybody on the
network can set parameters and call services: the files that those name must be in one of the
owner's two folders, `bags_dir` and `models_dir`, or come with the package.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path

from deep_nrsfm_ros.layouts.layout_file import LAYOUT_SUFFIXES
from deep_nrsfm_ros.layouts.presets import LAYOUTS
from deep_nrsfm_ros.model_files.folders import layout_folders, model_folders
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, ModelFileError, find_model


class PathSandboxError(ValueError):
    """A path outside the allowed folders; the text names the option, the path and the folders."""


class PathSandbox:
    """Checks paths against the owner's folders and the values that the owner gave at the start."""

    def __init__(
        self, models_dir: Path, bags_dir: Path, named_at_start: Iterable[str] = ()
    ) -> None:
        """Allow the two folders, which need not exist yet.

        Args:
            models_dir: folder of the owner's models.
            bags_dir: folder of the owner's bags.
            named_at_start: values that the owner gave for any option at the start. They are
                allowed wherever they are, relative to the working folder.
        """
        self.models_dir, self.bags_dir = models_dir, bags_dir
        self._owners = frozenset(named_at_start)
        _, *packaged = model_folders(models_dir)
        self._packaged_models = {Path(os.path.abspath(folder)) for folder in packaged}
        layouts = {Path(os.path.abspath(folder)) for folder in layout_folders()}
        self._packaged = self._packaged_models | layouts

    def model(self, option: str, word: str) -> Path:
        """Return the file of a model, given by name or path.

        A relative path begins in models_dir. Raises PathSandboxError for one that leads elsewhere,
        ModelFileError that lists the models if there is none.
        """
        folders = model_folders(self.models_dir)
        if word in self._owners:
            return find_model(str(_expanded(option, word)), folders)
        path = _expanded(option, word)
        if "/" not in word and path.suffix != MODEL_SUFFIX:
            path = find_model(word, folders)
            # An installation may be one of links into its sources; a name leads no further.
            return (
                path if path.parent in self._packaged_models else self._inside(option, word, path)
            )
        path = self._inside(option, word, self.models_dir / path)
        if path.suffix == MODEL_SUFFIX and path.is_file():
            return path
        raise ModelFileError(f"{option} is {word!r}: there is no model file {path}")

    def layout(self, option: str, word: str) -> str:
        """Return `word`, a layout as `find_layout` takes it, with a path made whole.

        A relative path begins in models_dir, or else in bags_dir. Raises PathSandboxError.
        """
        if word in LAYOUTS or not word:
            return word
        path = _expanded(option, word)
        if path.suffix not in (*LAYOUT_SUFFIXES, MODEL_SUFFIX):
            return word
        if word in self._owners:
            return os.path.abspath(path)
        inside = [self._inside(option, word, d / path) for d in (self.models_dir, self.bags_dir)]
        return str(next((path for path in inside if path.exists()), inside[0]))

    def recording(self, option: str, word: str) -> str:
        """Return the path of a bag, a file of keypoints, or a folder of such.

        A relative one begins in bags_dir. One that the owner gave at the start is looked for in the
        working folder first. No file in any other folder, or in a folder in it, may be a link that
        leads elsewhere either. Raises PathSandboxError.
        """
        path = _expanded(option, word)
        if word in self._owners and path.exists():
            return os.path.abspath(path)
        path = self._inside(option, word, self.bags_dir / path)
        for file in chain(path.glob("*"), path.glob("*/*")):
            self._inside(option, f"{word}, in which {file.name}", file)
        return str(path)

    def outputs(self, option: str, files: Iterable[Path]) -> None:
        """Raise PathSandboxError if one of the files to write is a link that leads elsewhere."""
        for file in files:
            self._inside(option, str(file), file)

    def _inside(self, option: str, word: str, path: Path) -> Path:
        """Return `path` with all links followed; raise PathSandboxError if it is outside."""
        packaged = Path(os.path.abspath(path))
        if packaged.parent in self._packaged:
            return packaged
        real = Path(os.path.realpath(path))
        if any(real.is_relative_to(os.path.realpath(folder)) for folder in self._folders()):
            return real
        raise PathSandboxError(
            f"{option} names {word}, which leads to {real}: outside of bags_dir ({self.bags_dir}) "
            f"and models_dir ({self.models_dir}); put it there, or start the lifter with "
            f"-p bags_dir:=FOLDER"
        )

    def _folders(self) -> Iterator[Path]:
        yield self.models_dir
        yield self.bags_dir


def _expanded(option: str, word: str) -> Path:
    """Return a path as given, its ~ expanded; raise PathSandboxError for what can be none."""
    try:
        if "\0" in word:
            raise ValueError("a zero byte")
        return Path(word).expanduser()
    except (ValueError, RuntimeError) as error:  # no such user, no home
        raise PathSandboxError(f"{option} is {word!r}, which is no path: {error}") from error

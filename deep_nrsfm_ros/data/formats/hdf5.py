# SPDX-License-Identifier: Apache-2.0
"""Tables in HDF5: of DeepLabCut, which pandas writes, and of SLEAP."""

from __future__ import annotations

import io
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.formats.builder import (
    DetectionsBuilder,
    KeypointFileError,
    as_identity,
)
from deep_nrsfm_ros.data.formats.individuals import (
    Column,
    add_individuals,
    find_individuals,
    parts_of,
)
from deep_nrsfm_ros.data.formats.table_frames import RowFrames
from deep_nrsfm_ros.extras import require_extra

_PROJECT = (
    "it is a project of SLEAP, not a table: export it (File > Export Analysis HDF5 or CSV, or "
    "sleap-convert --format analysis FILE), and read the .h5 or .csv"
)


def read_h5(path: Path, builder: DetectionsBuilder) -> None:
    """Read a table that DeepLabCut wrote with pandas, or the analysis file of SLEAP.

    Names of columns in the format "table" of pandas are pickled. They are read by an unpickler that
    makes lists, tuples, numbers and texts only.
    """
    require_extra("hdf5", "reading .h5 (or give the .csv that DeepLabCut writes beside it)")
    import h5py  # imported here because it is an extra

    try:
        with h5py.File(path, "r") as file:
            if "tracks" in file and "node_names" in file:
                _sleap_analysis(file, builder)
                return
            if "pred_points" in file or "metadata" in file and "points" in file:
                raise KeypointFileError(_PROJECT)
            groups = [group for group in file.values() if "pandas_type" in group.attrs]
            if not groups:
                raise KeypointFileError(
                    "no table of DeepLabCut and no analysis file of SLEAP; it holds "
                    f"{', '.join(map(str, file)) or 'nothing'}"
                )
            group = groups[0]
            if "table" in group:
                columns, index, values = _pandas_table(group)
            else:
                columns, index, values = _pandas_fixed(group)
    except (OSError, RuntimeError) as error:  # h5py raises the second for damaged groups
        raise KeypointFileError(f"damaged or no HDF5: {error}") from None
    except (KeyError, pickle.UnpicklingError, AttributeError) as error:
        raise KeypointFileError(f"no table as DeepLabCut writes it: {error}") from None
    frames = RowFrames(builder)
    table = (
        (frames.of(number + 1, number, key, ()), row)
        for number, (key, row) in enumerate(zip(index, values, strict=False))
    )
    individuals = find_individuals(parts_of([_column(c) for c in columns], builder), builder)
    add_individuals(individuals, ((at, row) for at, row in table if at >= 0), builder)
    frames.finish()


def _sleap_analysis(file: Any, builder: DetectionsBuilder) -> None:
    """Read the tracks of an analysis file of SLEAP; a keypoint without a score is labelled by hand.

    Its axes are (track, xy, node, frame), unless its attributes say otherwise. A file of a video
    without tracks has one, which has no name.
    """
    names = [str(_text(name)) for name in file["node_names"][:].tolist()]
    order = _axes(file["tracks"], ("track", "xy", "node", "frame"))
    tracks = file["tracks"][:].transpose([order.index(a) for a in ("frame", "track", "node", "xy")])
    if tracks.shape[2:] != (len(names), 2):
        shape = file["tracks"].shape
        raise KeypointFileError(
            f"its tracks are of shape {shape}, not (tracks, 2, {len(names)}, frames)"
        )
    marks = _beside(file, "point_scores", order, ("frame", "track", "node"), tracks.shape[:3])
    scores = _beside(file, "instance_scores", order, ("frame", "track"), tracks.shape[:2])
    given = file["track_names"][:].tolist() if "track_names" in file else []
    identities = [as_identity(str(_text(name))) for name in given]
    if len(identities) != tracks.shape[1]:
        identities = [None if tracks.shape[1] == 1 else str(i) for i in range(tracks.shape[1])]
    builder.name_keypoints(names)
    for frame, each in enumerate(tracks):
        index = builder.frame(frame, number=frame)
        for track in np.flatnonzero(~np.isnan(each).all((1, 2))):
            own = np.nan_to_num(marks[frame, track], nan=1.0)
            score = float(scores[frame, track])
            values = np.column_stack([each[track], own])
            builder.add(index, values, identities[track], None if np.isnan(score) else score)


def _axes(dataset: Any, usual: tuple[str, ...]) -> tuple[str, ...]:
    """Return what the axes of a dataset are: as its attribute says, or as usual."""
    if "dims" in dataset.attrs:
        return tuple(json.loads(dataset.attrs["dims"]))
    if dataset.file.attrs.get("transpose", True):
        return usual
    return tuple(axis for axis in ("frame", "node", "xy", "track") if axis in usual)


def _beside(
    file: Any,
    name: str,
    order: tuple[str, ...],
    axes: tuple[str, ...],
    shape: tuple[int, ...],
) -> NDArray[np.float64]:
    """Return scores of SLEAP with some axes; NaN where the file has none.

    Args:
        file: the analysis file.
        name: of the dataset.
        order: axes of the tracks.
        axes: of the result.
        shape: of the result.
    """
    if name not in file:
        return np.full(shape, np.nan)
    own = _axes(file[name], tuple(axis for axis in order if axis in axes))
    values = np.asarray(file[name][:], np.float64).transpose([own.index(axis) for axis in axes])
    return values if values.shape == shape else np.full(shape, np.nan)


def _pandas_table(group: Any) -> tuple[list[Any], list[Any], NDArray[np.float64]]:
    """Return columns, index and values of a DataFrame in the format "table"."""
    axes = _Unpickler(io.BytesIO(bytes(group.attrs["non_index_axes"]))).load()
    table = group["table"][:]
    blocks = [name for name in table.dtype.names if name.startswith("values_block")]
    if len(blocks) != 1:
        raise KeypointFileError("its columns are of several types; DeepLabCut writes numbers only")
    index = [_text(value) for value in table["index"].tolist()]
    return list(axes[0][1]), index, np.asarray(table[blocks[0]], np.float64)


def _pandas_fixed(group: Any) -> tuple[list[Any], list[Any], NDArray[np.float64]]:
    """Return columns, index and values of a DataFrame in the format "fixed"."""
    index = _axis(group, "axis1")
    # With three levels the last one names the image: folder, video, file.
    index = ["/".join(map(str, key)) if isinstance(key, tuple) else key for key in index]
    return _axis(group, "block0_items"), index, np.asarray(group["block0_values"][:], np.float64)


def _axis(group: Any, name: str) -> list[Any]:
    """Return the labels of an axis, tuples for several levels."""
    if f"{name}_level0" not in group:
        return [_text(value) for value in group[name][:].tolist()]
    levels: list[list[Any]] = []
    while f"{name}_level{len(levels)}" in group:
        values = group[f"{name}_level{len(levels)}"][:].tolist()
        labels = group[f"{name}_label{len(levels)}"][:].tolist()
        levels.append([_text(values[label]) for label in labels])
    return list(zip(*levels, strict=True))


def _text(value: Any) -> Any:
    """Return bytes as text, and anything else as it is."""
    return value.decode(errors="replace") if isinstance(value, bytes) else value


class _Unpickler(pickle.Unpickler):
    """Makes plain values only: it finds no class or function, so it runs no code."""

    def find_class(self, module: str, name: str) -> Any:
        """Raise UnpicklingError."""
        raise pickle.UnpicklingError(f"it holds a Python object {module}.{name}")


def _column(levels: Any) -> Column:
    """Return the column of a label of pandas: scorer, (individual,) keypoint, coordinate."""
    texts = [str(level) for level in levels] if isinstance(levels, (tuple, list)) else []
    if len(texts) not in (3, 4):
        raise KeypointFileError(
            f"its columns are {levels!r:.60}, not scorer, bodypart and coordinate of DeepLabCut; "
            "columns such as nose_x are read from a .csv (DataFrame.to_csv)"
        )
    return (texts[1] if len(texts) == 4 else "", texts[-2], texts[-1])

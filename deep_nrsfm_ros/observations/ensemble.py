"""The ensemble: every observation of one object or object category, from whatever source."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.nrsfm.keypoints import KeypointLayout


@dataclass(frozen=True)
class Ensemble:
    """The set of 2D projections that a model is trained on.

    points: (f, p, 2) float32, x right and y down, any unit; the values of missing points are 0.
    visible: (f, p) bool.
    layout: names of the p keypoints.
    source: where the frames come from, in words, for the provenance of a model.
    shapes: (f, p, 3) float32 ground truth in the frame of the data, or None. For evaluation
        only: nothing that trains reads it.
    """

    points: NDArray[np.float32]
    visible: NDArray[np.bool_]
    layout: KeypointLayout
    source: str
    shapes: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit each other or the layout."""
        f, p = len(self.points), len(self.layout)
        if self.points.shape != (f, p, 2):
            raise ValueError(f"points are {self.points.shape}; layout needs (frames, {p}, 2)")
        if self.visible.shape != (f, p):
            raise ValueError(f"visible is {self.visible.shape}; points need {(f, p)}")
        if self.shapes is not None and self.shapes.shape != (f, p, 3):
            raise ValueError(f"shapes are {self.shapes.shape}; points need {(f, p, 3)}")

    def __len__(self) -> int:
        """Return f, the number of frames."""
        return len(self.points)

    def __getitem__(self, frames: slice | NDArray[np.int64]) -> Ensemble:
        """Return the ensemble of the chosen frames."""
        shapes = None if self.shapes is None else self.shapes[frames]
        return Ensemble(self.points[frames], self.visible[frames], self.layout, self.source, shapes)


def concatenate(ensembles: list[Ensemble]) -> Ensemble:
    """Return all frames as one ensemble; the layouts must be the same.

    The ground truth is kept only if every part has it. Raises ValueError for none, or for
    layouts that differ.
    """
    if not ensembles:
        raise ValueError("no ensembles to concatenate; name at least one bag or trial")
    layouts = {e.layout.keypoints for e in ensembles}
    if len(layouts) > 1:
        raise ValueError(f"the sources have {len(layouts)} different keypoint layouts; use one")
    shapes = [e.shapes for e in ensembles if e.shapes is not None]
    return Ensemble(
        np.concatenate([e.points for e in ensembles]),
        np.concatenate([e.visible for e in ensembles]),
        ensembles[0].layout,
        "; ".join(dict.fromkeys(e.source for e in ensembles)),
        np.concatenate(shapes) if len(shapes) == len(ensembles) else None,
    )

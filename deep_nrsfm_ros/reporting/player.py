"""Recordings to look at: 2D keypoints beside the lifted 3D skeletons, with a time slider."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.recording import Recording
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.lifting.observation import Observation
from deep_nrsfm_ros.reporting.drawing import edge_colours
from deep_nrsfm_ros.reporting.template import embedded, render

MOST_FRAMES = 2000  # that a page shows unless told otherwise: some 2 MB for one person

Scene = dict[str, Any]
"""One frame for the page: see `Stage.scene`."""


@dataclass
class Stage:
    """Where the camera of a recording and its objects stand: the same for all its frames.

    The first object on it is the measure, unless `stage_of` has looked at them all. Objects that
    are centred on themselves, as lifted without a known camera, are arranged as in the image, in
    its proportions; others stay at their places before the camera.

    origin: what of the image (2,), or before the camera (3,), is in the middle. scale: pixels per
    unit of the scene; 0 when points are in place.
    """

    origin: NDArray[np.floating] | None = None
    scale: float = 0.0

    def scene(
        self,
        stamp: int,
        seen: Observation,
        lifted: Lifted | None = None,
        identities: Sequence[str] | None = None,
    ) -> Scene:
        """Return a frame as the page wants it, short enough for thousands.

        stamp: ns. seen: its n objects; lifted: what came of them, if anything did; identities: of
        the n objects, their places if None. The scene: `t` in s; `camera`, its place, None if
        unknown; `objects`, each with `identity`, `seen` (q x 3), and if it was lifted `shape`
        (p x 3, camera axes, centred), `sure` (p), `place` (3) and `size` of the shape, `rotation`
        (9 or None) and `residual`.
        """
        objects = []
        for i, points in enumerate(seen.points):
            both = np.concatenate(
                [_rounded(points, 5), _rounded(seen.confidence[i, :, None], 2)], 1
            )
            one: Scene = {
                "identity": str(i) if identities is None else identities[i],
                "seen": _flat(both),
            }
            if lifted is not None and np.isfinite(lifted.shapes[i]).all():
                one |= self._lifted(Lifted(*(part[i] for part in lifted)))
            objects.append(one)
        in_place = self.origin is not None and not self.scale
        camera = _flat(_rounded(-self.origin, 4)) if in_place and self.origin is not None else None
        return {"t": round(stamp / 1e9, 4), "camera": camera, "objects": objects}

    def _lifted(self, one: Lifted) -> Scene:
        """Return what there is to draw of one lifted object."""
        centre = one.shapes.mean(0)
        shape = one.shapes - centre
        known = np.isfinite(one.rotations).all()
        if self.origin is None:
            self._set(centre, shape, one)
        if self.scale and np.isfinite(one.scale) and self.origin is not None:
            place = np.append((one.translation - self.origin) / self.scale, 0)
            size = float(one.scale) / self.scale
        else:
            place = np.zeros(3) if self.scale or self.origin is None else centre - self.origin
            size = 1.0
        return {
            "shape": _flat(_rounded(shape, 4)),
            "sure": _flat(_rounded(one.confidence, 2)),
            "place": _flat(_rounded(place, 4)),
            "size": round(size, 4),
            "rotation": _flat(np.round(one.rotations.astype(np.float64), 4)) if known else None,
            "residual": round(float(one.residual), 4) if np.isfinite(one.residual) else None,
        }

    def _set(self, centre: NDArray[np.floating], shape: NDArray[np.floating], one: Lifted) -> None:
        """Take an object as the measure of all."""
        if in_place(centre, shape):
            self.origin = centre
        elif np.isfinite(one.scale) and one.scale > 0:
            self.origin, self.scale = one.translation, float(one.scale)


def in_place(centre: NDArray[np.floating], shape: NDArray[np.floating]) -> bool:
    """Tell whether a shape (p, 3) around `centre` (3,) is somewhere, not centred on itself."""
    return bool(np.linalg.norm(centre) > 1e-2 * np.linalg.norm(shape))


def stage_of(recording: Recording) -> Stage:
    """Return the stage in the middle of which a recording's objects are, by their medians."""
    sound = recording.is_lifted
    shapes = recording.lifted.shapes[sound]
    centres = shapes.mean(1)
    if len(shapes) and in_place(np.median(np.abs(centres), 0), shapes[len(shapes) // 2]):
        return Stage(np.median(centres, 0))
    scale, translation = (part[sound] for part in recording.lifted[2:4])
    known = np.isfinite(scale) & (scale > 0)
    if not known.any():
        return Stage()
    return Stage(np.median(translation[known], 0), float(np.median(scale[known])))


def scenes(recording: Recording, every: int = 1, stage: Stage | None = None) -> Iterator[Scene]:
    """Yield the frames of a recording, each `every`-th one.

    stage: where its camera and objects stand, if it goes on from another recording.
    """
    seen, lifted, stage = recording.detections, recording.lifted, stage or stage_of(recording)
    ends = np.searchsorted(seen.frame, np.arange(len(seen.stamps) + 1))
    for frame in range(0, len(seen.stamps), every):
        rows = slice(ends[frame], ends[frame + 1])
        observation = Observation(seen.points[rows], seen.confidence[rows])
        there = Lifted(*(part[rows] for part in lifted))
        yield stage.scene(
            int(seen.stamps[frame]), observation, there, seen.identities[rows].tolist()
        )


def stride(recording: Recording, most: int) -> int:
    """Return n such that every n-th frame makes at most `most` frames, and objects on average."""
    return max(
        1, math.ceil(max(len(recording.detections.stamps), len(recording.detections)) / most)
    )


def recording_page(
    recording: Recording, title: str, notes: Sequence[str] = (), most: int = MOST_FRAMES
) -> str:
    """Return a recording as one HTML file; of a long one, every n-th frame, and it says so."""
    every = stride(recording, most)
    shown = list(scenes(recording, every))
    if every > 1:
        notes = [
            *notes,
            f"{len(shown)} of {len(recording.detections.stamps)} frames: one in {every}",
        ]
    return _page(recording.source, recording.target, title, notes, shown)


def live_page(source: KeypointLayout, target: KeypointLayout, title: str) -> str:
    """Return the page that fetches its frames from the server it came from."""
    return _page(source, target, title, [], None)


def _page(
    source: KeypointLayout,
    target: KeypointLayout,
    title: str,
    notes: Sequence[str],
    shown: Sequence[Scene] | None,
) -> str:
    """Return the page with its frames, or without if they are to come."""
    head = {
        "source": _drawn(source),
        "target": _drawn(target),
        "upright": bool(target.handedness),
        "frames": shown,
    }
    return render(
        "player.html.j2",
        ["player.css"],
        ["orbit.js", "player.js"],
        title=title,
        notes=notes,
        upright=bool(target.handedness),
        live=shown is None,
        recording=embedded(head),
    )


def _drawn(layout: KeypointLayout) -> dict[str, Any]:
    """Return what there is to know to draw a layout."""
    edges, colours = layout.edge_indices(), edge_colours(layout)
    return {"names": list(layout.keypoints), "edges": edges, "colours": colours}


def _rounded(values: NDArray[np.floating], digits: int) -> NDArray[np.floating]:
    """Return values with as many significant digits as their largest needs."""
    largest = float(np.abs(values).max(initial=0))
    places = digits - 1 - (math.floor(math.log10(largest)) if largest > 0 else 0)
    return np.round(values.astype(np.float64), places)


def _flat(values: NDArray[np.floating]) -> list[float]:
    """Return the numbers of an array, whole ones without a point: 1, not 1.0."""
    numbers: list[float] = values.astype(np.float64).ravel().tolist()
    return [int(number) if number.is_integer() else number for number in numbers]

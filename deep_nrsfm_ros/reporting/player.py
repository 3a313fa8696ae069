# SPDX-License-Identifier: Apache-2.0
"""Pages that play recordings: 2D keypoints next to the lifted 3D skeletons, with a slider."""

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

MOST_FRAMES = 2000  # default limit of a page: about 2 MB for one person

Scene = dict[str, Any]
"""One frame for player.js: see `SceneTransform.scene`."""


@dataclass
class SceneTransform:
    """The transform from lifted objects to a common scene, the same for all frames of a recording.

    Objects lifted without intrinsics are centred at the origin. The scene arranges them as in the
    image. Objects lifted with intrinsics keep their position in front of the camera, or in a fixed
    frame, in which the camera's position is not known.

    Without values, the first object in a scene determines them.

    Attributes:
        origin: (2,) point of the image in pixels, or (3,) position in front of the camera, at the
            origin of the scene.
        scale: pixels per unit of the scene; 0 for objects at their position.
        fixed_frame: of the recording; "" = its objects are in the camera's axes.
    """

    origin: NDArray[np.floating] | None = None
    scale: float = 0.0
    fixed_frame: str = ""

    def scene(
        self,
        stamp: int,
        observation: Observation,
        lifted: Lifted | None = None,
        identities: Sequence[str] | None = None,
    ) -> Scene:
        """Return a frame as player.js takes it, rounded to keep pages of many frames small.

        Args:
            stamp: time in ns.
            observation: its n objects of q keypoints.
            lifted: the n lifted objects of p keypoints; None = not lifted.
            identities: of the n objects; None = their indices.

        Returns:
            `t` in s; `camera`, its position (3), or None if unknown; `fixed`, the name of the fixed
            frame, or "" for the camera's axes; `objects`, each with
            `identity` and `keypoints` (3 q: x, y, confidence). Lifted objects also have `shape`
            (3 p, camera axes, centred), `confidence` (p), `position` (3) and `size` of the shape,
            `rotation` (9 or None) and `residual` (or None).
        """
        objects = []
        for i, points in enumerate(observation.points):
            confidence = _rounded(observation.confidence[i, :, None], 2)
            keypoints = np.concatenate([_rounded(points, 5), confidence], 1)
            scene_object: Scene = {
                "identity": str(i) if identities is None else identities[i],
                "keypoints": _flat(keypoints),
            }
            if lifted is not None and np.isfinite(lifted.shapes[i]).all():
                scene_object |= self._lifted(lifted.at(i))
            objects.append(scene_object)
        at_position = self.origin is not None and not self.scale
        camera = None
        if at_position and self.origin is not None and not self.fixed_frame:
            camera = _flat(_rounded(-self.origin, 4))
        seconds, fixed = round(stamp / 1e9, 4), self.fixed_frame
        return {"t": seconds, "camera": camera, "fixed": fixed, "objects": objects}

    def _lifted(self, lifted: Lifted) -> Scene:
        """Return the part of a scene about one lifted object."""
        centre = lifted.shapes.mean(0)
        shape = lifted.shapes - centre
        known = np.isfinite(lifted.rotations).all()
        if self.origin is None:
            self._set(centre, shape, lifted)
        if self.scale and np.isfinite(lifted.scale) and self.origin is not None:
            position = np.append((lifted.translation - self.origin) / self.scale, 0)
            size = float(lifted.scale) / self.scale
        else:
            position = np.zeros(3) if self.scale or self.origin is None else centre - self.origin
            size = 1.0
        rotation = np.round(lifted.rotations.astype(np.float64), 4)
        residual = lifted.residual
        return {
            "shape": _flat(_rounded(shape, 4)),
            "confidence": _flat(_rounded(lifted.confidence, 2)),
            "position": _flat(_rounded(position, 4)),
            "size": round(size, 4),
            "rotation": _flat(rotation) if known else None,
            "residual": round(float(residual), 4) if np.isfinite(residual) else None,
        }

    def _set(
        self, centre: NDArray[np.floating], shape: NDArray[np.floating], lifted: Lifted
    ) -> None:
        """Take origin and scale from an object."""
        if has_position(centre, shape):
            self.origin = centre
        elif np.isfinite(lifted.scale) and lifted.scale > 0:
            self.origin, self.scale = lifted.translation, float(lifted.scale)


def has_position(centre: NDArray[np.floating], shape: NDArray[np.floating]) -> bool:
    """Return whether a shape (p, 3) with this centre (3,) has a position, or is at the origin."""
    return bool(np.linalg.norm(centre) > 1e-2 * np.linalg.norm(shape))


def scene_transform(recording: Recording) -> SceneTransform:
    """Return the transform with the median position of a recording's objects at the origin."""
    is_lifted = recording.is_lifted
    shapes = recording.lifted.shapes[is_lifted]
    centres = shapes.mean(1)
    if len(shapes) and has_position(np.median(np.abs(centres), 0), shapes[len(shapes) // 2]):
        return SceneTransform(np.median(centres, 0), fixed_frame=recording.fixed_frame)
    scale, translation = (part[is_lifted] for part in recording.lifted[2:4])
    known = np.isfinite(scale) & (scale > 0)
    if not known.any():
        return SceneTransform(fixed_frame=recording.fixed_frame)
    return SceneTransform(np.median(translation[known], 0), float(np.median(scale[known])))


def scenes(
    recording: Recording, every: int = 1, transform: SceneTransform | None = None
) -> Iterator[Scene]:
    """Yield the frames of a recording as scenes.

    Args:
        recording: detections and lifted shapes.
        every: yield every n-th frame.
        transform: of an earlier recording that this one continues; None = its own.
    """
    detections, lifted = recording.detections, recording.lifted
    transform = transform or scene_transform(recording)
    if transform.fixed_frame != recording.fixed_frame:  # the keypoints that tell it came later
        transform.origin, transform.scale = None, 0.0
        transform.fixed_frame = recording.fixed_frame
    ends = np.searchsorted(detections.frame, np.arange(len(detections.stamps) + 1))
    for frame in range(0, len(detections.stamps), every):
        rows = slice(ends[frame], ends[frame + 1])
        observation = Observation(detections.points[rows], detections.confidence[rows])
        in_frame = lifted.at(rows)
        stamp, identities = int(detections.stamps[frame]), detections.identities[rows].tolist()
        yield transform.scene(stamp, observation, in_frame, identities)


def stride(recording: Recording, most: int) -> int:
    """Return n such that every n-th frame is at most `most` frames, and objects on average."""
    return max(
        1, math.ceil(max(len(recording.detections.stamps), len(recording.detections)) / most)
    )


def recording_page(
    recording: Recording, title: str, notes: Sequence[str] = (), most: int = MOST_FRAMES
) -> str:
    """Return a recording as one HTML page.

    Args:
        recording: detections and lifted shapes.
        title: of the page.
        notes: sentences below the title.
        most: frames at most; of a longer recording, every n-th frame, with a note.
    """
    every = stride(recording, most)
    shown = list(scenes(recording, every))
    if every > 1:
        notes = [
            *notes,
            f"{len(shown)} of {len(recording.detections.stamps)} frames: one in {every}",
        ]
    return _page(recording.source, recording.target, title, notes, shown)


def live_page(source: KeypointLayout, target: KeypointLayout, title: str) -> str:
    """Return a page that receives its frames from its server; see `serving`."""
    return _page(source, target, title, [], None)


def _page(
    source: KeypointLayout,
    target: KeypointLayout,
    title: str,
    notes: Sequence[str],
    shown: Sequence[Scene] | None,
) -> str:
    """Return the page with frames, or, for None, one that receives them."""
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
    """Return names, edges and colours of a layout for player.js."""
    edges, colours = layout.edge_indices(), edge_colours(layout)
    return {"names": list(layout.keypoints), "edges": edges, "colours": colours}


def _rounded(values: NDArray[np.floating], digits: int) -> NDArray[np.floating]:
    """Return values rounded so that the largest has so many significant digits."""
    largest = float(np.abs(values).max(initial=0))
    places = digits - 1 - (math.floor(math.log10(largest)) if largest > 0 else 0)
    return np.round(values.astype(np.float64), places)


def _flat(values: NDArray[np.floating]) -> list[float]:
    """Return the numbers of an array; integers as int, which JSON writes shorter."""
    numbers: list[float] = values.astype(np.float64).ravel().tolist()
    return [int(number) if number.is_integer() else number for number in numbers]

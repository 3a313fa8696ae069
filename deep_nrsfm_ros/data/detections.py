"""Detections: everyone that a recording shows, with the time of each frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.openpose import largest
from deep_nrsfm_ros.lifting.observation import Observation


@dataclass(frozen=True)
class Detections:
    """The m objects that f frames show, frame by frame, in the detector's order of q keypoints.

    points: (m, q, 2), x right and y down; confidence: (m, q), 0 where missing: as `Observation`.
    frame: (m,) int64, ascending: the place among `stamps` of the frame that shows the object.
    identities: (m,) str: who it is, by the source; where that does not say, its place in its frame.
    stamps: (f,) int64, ns, of all frames, those that show nobody among them.
    frame_id: the camera, "" if it is not known.
    """

    points: NDArray[np.float32]
    confidence: NDArray[np.float32]
    frame: NDArray[np.int64]
    identities: NDArray[np.str_]
    stamps: NDArray[np.int64]
    frame_id: str = ""

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit each other."""
        m, q = self.confidence.shape
        for name, shape in {"points": (m, q, 2), "frame": (m,), "identities": (m,)}.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} are {getattr(self, name).shape}; {shape} is needed")
        if m and not (0 <= self.frame.min() and self.frame.max() < len(self.stamps)):
            raise ValueError(f"frame goes to {self.frame.max()}; there are {len(self.stamps)}")
        if (np.diff(self.frame) < 0).any():
            raise ValueError("frame goes back; objects come frame by frame")

    def __len__(self) -> int:
        """Return m, the number of objects."""
        return len(self.frame)

    def __getitem__(self, objects: NDArray[np.int64] | NDArray[np.bool_]) -> Detections:
        """Return the chosen objects (in order), of the same frames."""
        return dataclasses.replace(
            self,
            points=self.points[objects],
            confidence=self.confidence[objects],
            frame=self.frame[objects],
            identities=self.identities[objects],
        )

    def largest(self) -> Detections:
        """Return the object with the largest bounding box of every frame that shows one."""
        first, count = np.unique(self.frame, return_index=True, return_counts=True)[1:]
        places = []
        for start, number in zip(first.tolist(), count.tolist(), strict=True):
            rows = slice(start, start + number)
            place = largest(Observation(self.points[rows], self.confidence[rows]))
            places.append(start + (place or 0))
        return self[np.array(places, np.int64)]


def gather(
    observations: Iterable[Observation],
    stamps: Sequence[int] | NDArray[np.int64],
    keypoints: int,
    frame_id: str = "",
    identities: Sequence[str] | None = None,
) -> Detections:
    """Return what each frame shows, in order, as one; `stamps` (f,) in ns.

    keypoints: q, for recordings that show nobody. identities: of all objects; None: those of the
    observations, and the places of whom they do not name.
    """
    seen = list(observations)
    counts = [len(observation.confidence) for observation in seen]
    nothing = np.empty((0, keypoints), np.float32)
    points = np.concatenate([np.empty((0, keypoints, 2), np.float32), *(o.points for o in seen)])
    confidence = np.concatenate([nothing, *(o.confidence for o in seen)])
    return Detections(
        points,
        confidence,
        np.repeat(np.arange(len(seen)), counts),
        np.asarray(_identities(seen) if identities is None else identities, str),
        np.asarray(stamps, np.int64),
        frame_id,
    )


def _identities(seen: Sequence[Observation]) -> list[str]:
    """Return who the objects of all observations are: by name, or by place in the frame."""
    named = ((o.identities or (None,) * len(o.confidence)) for o in seen)
    return [
        str(i) if identity is None else identity
        for identities in named
        for i, identity in enumerate(identities)
    ]


def stamps_at(rate: float, frames: int) -> NDArray[np.int64]:
    """Return the stamps (f,) in ns of frames that come `rate` times a second from 0."""
    return np.round(np.arange(frames) * (1e9 / rate)).astype(np.int64)

# SPDX-License-Identifier: Apache-2.0
"""Detections: all objects in the frames of a recording, with the time of each frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.batched import slices
from deep_nrsfm_ros.data.openpose import largest
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.observation import Observation
from deep_nrsfm_ros.lifting.sanity import Finding, Size

_SIZES = 4  # sizes of images that are told one by one
_GHOST = 0.5  # of the best score in a frame: an object below it is not chosen for its size


class Frames(NamedTuple):
    """How the input calls its f frames.

    Attributes:
        numbers: (f,) int64, numbers of the frames in the input; their index if it gives none.
        names: (f,) str, names of files or images; "" where the input gives none.
    """

    numbers: NDArray[np.int64]
    names: NDArray[np.str_]


@dataclass(frozen=True)
class Detections:
    """The m objects in f frames, frame by frame, with q keypoints in the detector's order.

    Attributes:
        points: (m, q, 2) float32 in pixels, x right and y down; 0 where missing.
        confidence: (m, q) float32 in [0, 1]; 0 where missing.
        frame: (m,) int64, ascending; index into `stamps` of the frame with the object.
        identities: (m,) str, identity of the object; "" for an object without one; its index in
            the frame if the source gives none at all.
        stamps: (f,) int64 in ns, of all frames, also of those without an object.
        frame_id: name of the camera; "" if unknown.
        frames: numbers and names of the frames; None = numbered from 0, without names.
        scores: (m,) float32, score of the object in the detector's own scale; None = all 1.
        layout: layout in which the keypoints are given; None = nothing says it.
        usual_layout: layout that is usual in a file of this format, without `layout`; None = none.
        image_sizes: the different sizes of the images, width and height in pixels, as the source
            gives them, and the number of images of each, the most frequent first; None for images
            without a size.
        is_normalised: the keypoints were fractions of the image and are multiplied by its size.
        warnings: sentences about what was left out of the source.
        notes: sentences about how the source is taken, which are no cause for doubt.
        findings: what looks wrong in the source.
        is_padding: (m,) bool, objects without a keypoint that fill an array with as many objects in
            each frame; None = none of them.
    """

    points: NDArray[np.float32]
    confidence: NDArray[np.float32]
    frame: NDArray[np.int64]
    identities: NDArray[np.str_]
    stamps: NDArray[np.int64]
    frame_id: str = ""
    frames: Frames = None  # type: ignore[assignment]  # never None after __post_init__
    scores: NDArray[np.float32] = None  # type: ignore[assignment]
    layout: KeypointLayout | None = None
    usual_layout: KeypointLayout | None = None
    image_sizes: tuple[tuple[Size | None, int], ...] = ()
    is_normalised: bool = False
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    is_padding: NDArray[np.bool_] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Raise ValueError if the arrays do not match each other or frames are not ascending."""
        m, q = self.confidence.shape
        if self.frames is None:
            f = len(self.stamps)
            object.__setattr__(self, "frames", Frames(np.arange(f), np.full(f, "")))
        if self.scores is None:
            object.__setattr__(self, "scores", np.ones(m, np.float32))
        if self.is_padding is None:
            object.__setattr__(self, "is_padding", np.zeros(m, bool))
        for name, shape in {
            "points": (m, q, 2),
            "frame": (m,),
            "identities": (m,),
            "scores": (m,),
            "is_padding": (m,),
        }.items():
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
        """Return the chosen objects, in ascending order; the frames remain the same."""
        return dataclasses.replace(
            self,
            points=self.points[objects],
            confidence=self.confidence[objects],
            frame=self.frame[objects],
            identities=self.identities[objects],
            scores=self.scores[objects],
            is_padding=self.is_padding[objects],
        )

    def without_padding(self) -> Detections:
        """Return the detections without the objects that only fill an array."""
        return self[~self.is_padding] if self.is_padding.any() else self

    @property
    def image_size(self) -> Size | None:
        """Width and height of all images in pixels; None: the source gives none, or several."""
        return self.image_sizes[0][0] if len(self.image_sizes) == 1 else None

    @property
    def sizes_text(self) -> str:
        """The sizes of the images, if the source gives several; else ""."""
        known = [(size, count) for size, count in self.image_sizes if size]
        if len(known) < 2:
            return ""
        told = [f"{size[0]} x {size[1]}: {count}" for size, count in known[:_SIZES]]
        return f"{len(known)} sizes ({', '.join([*told, *['...'] * (len(known) > _SIZES)])})"

    def has_identities(self) -> bool:
        """Return whether an identity is not just the index of the object in its frame."""
        index = index_in_frame(self.frame)
        return any(
            (self.identities[rows] != index[rows].astype(str)).any() for rows in slices(len(self))
        )

    def largest(self) -> Detections:
        """Return the object with the largest bounding box of each frame that has one.

        An object with less than half of the best score in its frame is not chosen, however large
        it is.
        """
        first, count = np.unique(self.frame, return_index=True, return_counts=True)[1:]
        indices = []
        for start, number in zip(first.tolist(), count.tolist(), strict=True):
            scores = self.scores[start : start + number]
            rows = start + np.flatnonzero(~(scores < _GHOST * scores.max()))
            index = largest(Observation(self.points[rows], self.confidence[rows]))
            indices.append(int(rows[index or 0]))
        return self[np.array(indices, np.int64)]


def index_in_frame(frame: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index (m,) of each object among the objects of its frame."""
    order = np.argsort(frame, kind="stable")
    ordered = frame[order]
    index = np.empty(len(frame), np.int64)
    index[order] = np.arange(len(frame)) - np.searchsorted(ordered, ordered)
    return index


def gather(
    observations: Iterable[Observation],
    stamps: Sequence[int] | NDArray[np.int64],
    keypoints: int,
    frame_id: str = "",
    identities: Sequence[str] | None = None,
) -> Detections:
    """Return the observations of f frames, in order of time, as detections.

    Args:
        observations: one for each frame, with its objects.
        stamps: (f,) in ns.
        keypoints: number q of keypoints, for the case that there is no object.
        frame_id: name of the camera.
        identities: of all objects in order; None = those of the observations.
    """
    frames = list(observations)
    counts = [len(observation.confidence) for observation in frames]
    empty = np.empty((0, keypoints), np.float32)
    points = np.concatenate([np.empty((0, keypoints, 2), np.float32), *(o.points for o in frames)])
    confidence = np.concatenate([empty, *(o.confidence for o in frames)])
    return Detections(
        points,
        confidence,
        np.repeat(np.arange(len(frames)), counts),
        np.asarray(_identities(frames) if identities is None else identities, str),
        np.asarray(stamps, np.int64),
        frame_id,
        scores=_scores(frames),  # type: ignore[arg-type]  # None = all 1
    )


def _scores(observations: Sequence[Observation]) -> NDArray[np.float32] | None:
    """Return the score (m,) of each object; None if one has none."""
    if any(len(each.scores) != len(each.confidence) for each in observations):
        return None
    return np.array([score for each in observations for score in each.scores], np.float32)


def _identities(observations: Sequence[Observation]) -> list[str]:
    """Return the identity of each object, "" for none; its index if no object has any."""
    if any(identity is not None for each in observations for identity in each.identities):
        return [
            identity or ""
            for each in observations
            for identity in each.identities or (None,) * len(each.confidence)
        ]
    return [str(i) for each in observations for i in range(len(each.confidence))]


def stamps_at(rate: float, frames: int) -> NDArray[np.int64]:
    """Return the stamps (f,) in ns of `rate` frames per second, the first at 0."""
    return np.round(np.arange(frames) * (1e9 / rate)).astype(np.int64)

# SPDX-License-Identifier: Apache-2.0
"""Gathers the objects of a file, one by one, into detections."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.batched import slices
from deep_nrsfm_ros.data.detections import Detections, Frames, index_in_frame
from deep_nrsfm_ros.data.formats.frame_numbers import (
    MOST,
    natural,
    numbers_in,
    series_of,
    stamps_of,
)
from deep_nrsfm_ros.data.formats.names import (
    NAMED_BY_INPUT,
    are_numbers,
    contradiction,
    layout_of_names,
)
from deep_nrsfm_ros.data.formats.unused import find_unused, unused_sentence
from deep_nrsfm_ros.data.read_options import DEFAULT_RATE, ReadOptions
from deep_nrsfm_ros.layouts.layout import MAX_KEYPOINTS, KeypointLayout
from deep_nrsfm_ros.layouts.presets import COCO17, LAYOUTS
from deep_nrsfm_ros.lifting.observation import to_observation
from deep_nrsfm_ros.lifting.sanity import (
    Finding,
    Size,
    confidence_scale,
    find_origin,
    looks_normalised,
)

NO_KEYPOINTS = "have no keypoints"
_ROWS = 1024  # by which arrays grow at least
_MEDIAPIPE = 33  # landmarks of MediaPipe Pose
_FEW = 4  # keypoints, which are too few to be compared with a box
_SMALLEST_BOX = 20.0  # pixels; a smaller one is a placeholder
_CROWD = 5  # objects, of which as many in one frame may be one object in as many frames
_SAME_PLACE = 0.5  # overlap of boxes, which two people in an image hardly have
_ALIKE = 0.1  # mean distance of keypoints in sizes of the object, of one object a frame later
_ALIKE_OBJECTS = 3  # in one frame, of which most may be one object
_COMPARED = 256  # objects that are compared with each other
_REPEATED = 0.1  # fraction of objects with the identity of another one of their frame
_LOST = 0.1  # fraction of objects that are left out, from which it is a finding
_WEAK = 0.1  # fraction of keypoints below the least confidence, from which it is said
_RATES = (0.1, 1000.0)  # frames a second
_MANY = 0.5  # fraction of objects that makes a suspicion a warning
UNITS = {"seconds": 10**9, "milliseconds": 10**6, "microseconds": 1000, "nanoseconds": 1}
"""Units of time in ns."""
TIMES = {
    **dict.fromkeys(("timestamp", "time", "stamp", "ts", "t"), ""),
    **dict.fromkeys(("timestamp_s", "time_s", "seconds"), "seconds"),
    **dict.fromkeys(("timestamp_ms", "time_ms", "timestampMs"), "milliseconds"),
    **dict.fromkeys(("timestamp_us", "time_us"), "microseconds"),
    **dict.fromkeys(("timestamp_ns", "time_ns", "stamp_ns"), "nanoseconds"),
}
"""Names of the time of a frame -> its unit; "" if they do not say it."""
_BACKWARDS = 0.25  # fraction of frames after a later one, from which times are none
_YEARS = (1_200_000_000, 5_000_000_000)  # seconds since 1970, of the years 2008 and 2128
_NAMED = 3  # places that a warning names


class KeypointFileError(ValueError):
    """A file of keypoints cannot be read; the message names the file and the remedy."""


class _Group:
    """The objects of one category with one number of keypoints, in arrays that grow.

    Attributes:
        frame: (n,) index of the frame of each object.
        scores: (n,) of each object.
        identities: (n,) of each object; None where the input gives none.
        points: (n or more, q, 2), of which the first n are the objects.
        confidence: (n or more, q), likewise.
    """

    def __init__(self, keypoints: int) -> None:
        self.frame = array("q")
        self.scores = array("f")
        self.identities: list[str | None] = []
        self.points = np.empty((0, keypoints, 2), np.float32)
        self.confidence = np.empty((0, keypoints), np.float32)

    def add(self, values: NDArray[np.float64]) -> None:
        """Add x, y and confidence (q, 3) of an object."""
        row = len(self.frame)
        if row >= len(self.points):
            self._resize(row + max(_ROWS, row // 8))
        self.points[row], self.confidence[row] = values[:, :2], values[:, 2]

    def extend(self, other: _Group) -> None:
        """Add the objects of another group, with as many keypoints."""
        n, m = len(self.frame), len(other.frame)
        self._resize(n + m)
        self.points[n:], self.confidence[n:] = other.points[:m], other.confidence[:m]
        self.frame += other.frame
        self.scores += other.scores
        self.identities += other.identities

    def arrays(self, min_confidence: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return points (m, q, 2) and confidence (m, q) as of an observation, once.

        They are the arrays of the group, so that memory holds all objects but once.
        """
        self._resize(len(self.frame))
        points, confidence = self.points, self.confidence
        for rows in slices(len(points)):
            values = np.concatenate((points[rows], confidence[rows, :, None]), -1)
            observation = to_observation(values, min_confidence)
            points[rows], confidence[rows] = observation.points, observation.confidence
        return points, confidence

    def widen(self, keypoints: int) -> None:
        """Add keypoints at the end, which the objects so far lack."""
        points, confidence = self.points, self.confidence
        rows, q = confidence.shape
        self.points = np.zeros((rows, keypoints, 2), np.float32)
        self.confidence = np.zeros((rows, keypoints), np.float32)
        self.points[:, :q], self.confidence[:, :q] = points, confidence

    def _resize(self, rows: int) -> None:
        """Change the number of rows in place: the system moves large arrays without a copy."""
        q = self.confidence.shape[1]
        self.points.resize((rows, q, 2), refcheck=False)
        self.confidence.resize((rows, q), refcheck=False)


class DetectionsBuilder:
    """Gathers frames and objects in any order; `detections` returns them frame by frame.

    Attributes:
        options: of reading.
        warnings: sentences about what was left out.
        notes: sentences about how the input is taken, which are no cause for doubt.
        is_mediapipe: the input is landmarks, which MediaPipe gives as fractions of the image's
            size.
        is_coco: the input is objects with a category and an image, as COCO has them.
        weak_identity: name of the field with identities, if it may mean something else too, as
            the number of an entry or a kind of object; "" if not.
    """

    def __init__(self, options: ReadOptions) -> None:
        """Start without frames."""
        self.options = options
        self.warnings: list[str] = []
        self.notes: list[str] = []
        self._findings: dict[str, Finding] = {}
        self.is_mediapipe = self.is_coco = False
        self.weak_identity = ""
        self._own_rate: float | None = None
        self._lost = 0
        self._groups: dict[tuple[Any, int], _Group] = {}
        self._identities: dict[str, str] = {}
        self._frames: dict[Any, int] = {}
        self._keys: list[Any] = []
        self._frame_names: list[str] = []
        self._numbers: list[int | None] = []
        self._stamps: list[int | None] = []
        self._order: list[int | None] = []
        self._times: dict[int, float] = {}
        self._time_unit = ""
        self._not_confidence = 0
        self._outside_box = self._with_box = 0
        self._listed = 0
        self._left_out: dict[str, list[str]] = {}
        self._left_out_counts: Counter[str] = Counter()
        self._names: dict[Any, Sequence[str]] = {}
        self._preset: KeypointLayout | None = None
        self._categories: dict[Any, str] = {}
        self._has_scores = False
        self._image_sizes: Counter[Size | None] = Counter()

    def image_size(self, size: Size | None) -> None:
        """Add width and height in pixels of an image; None: the input lists it without them."""
        self._image_sizes[size] += 1

    def frame(
        self,
        key: Any,
        name: str = "",
        number: int | None = None,
        stamp: int | None = None,
        listed: bool = False,
    ) -> int:
        """Return the index of a frame, which is added if it is new.

        Args:
            key: what the input calls the frame: a number, a name.
            name: of its file or image; "" = the key, where that is a text.
            number: of the frame; None = the number in its name, where names have numbers.
            stamp: time in ns; None = by number and rate.
            listed: the input lists its frames in this order.
        """
        index = self._frames.setdefault(key, len(self._frames))
        if index == len(self._keys):
            self._keys.append(key)
            self._frame_names.append(key if isinstance(key, str) else "")
            for values in (self._numbers, self._stamps, self._order):
                values.append(None)
        if name:
            self._frame_names[index] = name
        if number is not None:
            self._numbers[index] = number
        if stamp is not None:
            self._stamps[index] = stamp
        if listed:
            self._order[index] = self._listed
            self._listed += 1
        return index

    def frame_name(self, index: int) -> str:
        """Return how the input calls a frame, for a warning."""
        return self._frame_names[index] or f"frame {self._keys[index]}"

    def time(self, index: int, value: float, unit: str = "") -> None:
        """Set the time of a frame as the input gives it.

        Args:
            index: of the frame.
            value: its time.
            unit: a key of `UNITS`; "" = the one in which frames are a plausible time apart.
        """
        self._times[index] = value
        self._time_unit = unit

    def own_rate(self, rate: float, name: str) -> None:
        """Set the frames a second that the input says, for frames without times.

        Args:
            rate: frames a second; an impossible one is ignored.
            name: of its field.
        """
        if _RATES[0] <= rate <= _RATES[1] and not self.options.rate and not self._own_rate:
            self._own_rate = float(rate)
            self.notes.append(f"{rate:g} frames a second, as it says (`{name}`)")

    @property
    def frames(self) -> int:
        """Number of frames so far."""
        return len(self._keys)

    def name_keypoints(self, names: Sequence[Any], category: Any = None) -> None:
        """Set the names of the keypoints that the input gives, of all or of one category."""
        if len(names) <= MAX_KEYPOINTS and all(isinstance(n, str) and n.strip() for n in names):
            self._names[category] = tuple(names)
        elif names:
            self.warnings.append(
                f"its names of keypoints are not used: {len(names)}, not all of them texts"
            )

    def use_preset(self, layout: KeypointLayout) -> None:
        """Set the layout that the input names, for an input without names of keypoints."""
        self._preset = layout

    def name_category(self, category: Any, name: str) -> None:
        """Set the name of a category."""
        self._categories[category] = name

    def find(self, finding: Finding) -> None:
        """Add what looks wrong in the input; one of its code replaces it."""
        self._findings[finding.code] = finding

    def not_used(self, kind: str, names: Iterable[str], remedies: Mapping[str, str]) -> None:
        """Say what the input holds and the reader does not use.

        Args:
            kind: as in `unused.unused_sentence`.
            names: likewise; a repeated one is said once.
            remedies: as in `unused.find_unused`.
        """
        if listed := list(dict.fromkeys(names)):
            self.notes.append(unused_sentence(kind, listed))
            for finding in find_unused(kind, listed, remedies):
                self.find(finding)

    def leave_out(self, reason: str, place: str, is_loss: bool = False) -> None:
        """Count an entry of the input that is left out.

        Args:
            reason: completes "left out: 3 that ...".
            place: of the entry.
            is_loss: it is an object that should have been read.
        """
        self._left_out_counts[reason] += 1
        self._lost += is_loss
        places = self._left_out.setdefault(reason, [])
        if len(places) <= _NAMED and place not in places:
            places.append(place)

    def add(
        self,
        frame: int,
        values: NDArray[np.float64],
        identity: str | None = None,
        score: float | None = None,
        category: Any = None,
        by_name: bool = False,
    ) -> None:
        """Add an object.

        Args:
            frame: index from `frame`.
            values: (q, 3) x, y and confidence; NaN where missing.
            identity: None = the input gives none.
            score: of the object; None = the input gives none.
            category: its number in the input.
            by_name: keypoints may be added at the end later, which this object lacks.
        """
        if score is not None:
            self._has_scores = True
            if score < self.options.min_score:
                reason = f"have a score below --min-score {self.options.min_score:g}"
                self._left_out_counts[reason] += 1
                return
        q = len(values)
        if ((values[:, 2] < 0) & (values[:, 2] != -1)).any():
            self._not_confidence += 1
        if by_name:
            self._widen(category, q)
        group = self._groups.get((category, q))
        if group is None:
            group = self._groups[category, q] = _Group(q)
        group.add(values)
        group.frame.append(frame)
        group.scores.append(1.0 if score is None else score)
        # One text for all objects of an identity.
        group.identities.append(identity and self._identities.setdefault(identity, identity))

    def _widen(self, category: Any, keypoints: int) -> None:
        """Widen the objects of a category that have fewer keypoints."""
        for own, q in list(self._groups):
            if own == category and q < keypoints:
                group = self._groups.pop((own, q))
                group.widen(keypoints)
                if wide := self._groups.get((own, keypoints)):
                    wide.extend(group)
                else:
                    self._groups[own, keypoints] = group

    def detections(self, expected: str) -> Detections:
        """Return all objects that were added.

        Args:
            expected: what the file should hold, for the case that it holds nothing.

        Raises:
            KeypointFileError: nothing is left, or the keypoints are not those of the layout.
        """
        options = self.options
        if options.min_score and not self._has_scores:
            raise KeypointFileError("it gives no object a score: leave out --min-score")
        if not self._frames and not self._groups:
            raise KeypointFileError("; ".join([expected, *self.reasons()]))
        category = self._category()
        layout = self._layout(category)
        group = self._group(layout)
        if not group.frame and (set(self._left_out_counts) - {NO_KEYPOINTS}):
            raise KeypointFileError("; ".join(["no object is left", *self.reasons()]))
        self._stamp_frames()
        self.warnings += self._looks_wrong(group)
        self._find_lost(group)
        frame = np.array(group.frame, np.int64)
        self.warnings += weak_keypoints(group, options.min_confidence)
        points, confidence = group.arrays(options.min_confidence)
        is_normalised = self.is_mediapipe and looks_normalised(points, confidence > 0)
        if is_normalised and options.image_size is None:
            raise KeypointFileError(
                "its landmarks are fractions of the image's size: give --image-width and "
                "--image-height"
            )
        if self.weak_identity and (reason := _no_identities(group)):
            self.notes.append(f"its `{self.weak_identity}` is {reason}, and no identity")
            group.identities = [None] * len(group.identities)
        identities, warning = identities_of(group.identities, frame)
        self.warnings += [warning] if warning else []
        scores = np.array(group.scores, np.float32)
        order, frames, stamps = self._in_order()
        position = np.empty(len(order), np.int64)
        position[order] = np.arange(len(order))
        frame = position[frame]
        if (np.diff(frame) < 0).any():
            rows = np.argsort(frame, kind="stable")
            frame, scores, identities = frame[rows], scores[rows], identities[rows]
            for k in range(points.shape[1]):  # one by one: a copy of all would be large
                points[:, k], confidence[:, k] = points[rows, k], confidence[rows, k]
        return Detections(
            points,
            confidence,
            frame,
            identities,
            stamps,
            frames=frames,
            scores=scores,
            layout=layout,
            usual_layout=COCO17 if self.is_coco and points.shape[1] == len(COCO17) else None,
            image_sizes=tuple(self._image_sizes.most_common()),
            warnings=(*self.warnings, *self.reasons()),
            notes=tuple(self.notes),
            findings=tuple(self._findings.values()),
        )

    def in_box(self, values: NDArray[np.float64], box: Any) -> None:
        """Compare the keypoints of an object with its box, [x, y, width, height] or two corners."""
        try:
            x, y, a, b = (float(number) for number in (box[0] if len(box) == 1 else box))
        except (TypeError, ValueError, LookupError, OverflowError):
            return
        visible = values[(values[:, 2] > 0) & values[:, :2].any(1), :2]
        if len(visible) < _FEW or min(a, b) < _SMALLEST_BOX:  # a box of [0, 0, 1, 1] says nothing
            return
        self._with_box += 1
        low, high = visible.min(0), visible.max(0)
        corners = ((x, y, x + a, y + b), (x, y, max(a, x), max(b, y)))
        self._outside_box += not any(
            (low <= (x2, y2)).all() and (high >= (x1, y1)).all() and _share(low, high, box_) > 0.3
            for box_ in corners
            for x1, y1, x2, y2 in (box_,)
        )

    def _looks_wrong(self, group: _Group) -> list[str]:
        """Return what looks wrong in the objects; mend what can be mended."""
        warnings = []
        if self._not_confidence > _MANY * max(len(group.frame), 1):
            group.confidence[:] = 1
            warnings.append(
                f"the third number of a keypoint is negative in {self._not_confidence} of "
                f"{len(group.frame)} objects: it is a depth and no confidence, so all keypoints "
                "count as seen"
            )
        points, confidence = (v[: len(group.frame)] for v in (group.points, group.confidence))
        for finding in (*confidence_scale(confidence), *find_origin(points, confidence)):
            self.find(finding)
        if self._outside_box > _MANY * max(self._with_box, 1):
            self.find(
                Finding(
                    "crop",
                    f"the keypoints of {self._outside_box} of {self._with_box} objects are not in "
                    "their box: are they pixels of the box's crop? Pixels of the image are needed",
                )
            )
        if len(self._keys) == 1 and (_is_one_object(group) or _are_same_objects(group)):
            self.find(
                Finding(
                    "one-frame",
                    f"all {len(group.frame)} objects are of one frame, and lie on each other: if "
                    "each is of a frame of its own, give it the number of its frame (`frame`), or "
                    "write a line for each frame (.jsonl)",
                )
            )
        return warnings

    def _find_lost(self, group: _Group) -> None:
        """Find that many objects are left out."""
        total = len(group.frame) + self._lost
        if self._lost > _LOST * total and group.frame:
            self.find(
                Finding(
                    "left-out",
                    f"{self._lost} of {total} objects are left out; the warnings say why",
                )
            )

    def _stamp_frames(self) -> None:
        """Set the stamps by the times of the input, if it gives all of them."""
        if not self._times:
            return
        rate = self.options.rate or self._own_rate or DEFAULT_RATE
        if missing := len(self._keys) - len(self._times):
            self.find(
                Finding(
                    "times",
                    f"its times are not used: {missing} of {len(self._keys)} frames have none; "
                    f"frames follow each other at {rate:g} a second",
                )
            )
            return
        if self.options.rate:
            raise KeypointFileError("it has times of its own: leave out --rate")
        values = np.array([self._times[i] for i in range(len(self._keys))])
        unit = self._time_unit or plausible_unit(values)
        if not unit and len(self._keys) == 1:
            return
        if not self._do_grow(values):
            self.notes.append(
                f"its times ({values[0]:g}, ...) do not grow with the frames, and are not used"
            )
            return
        if not unit:
            self.find(
                Finding(
                    "times",
                    f"its times ({values[0]:g}, ...) are not used: in no unit are frames 1 ms to "
                    f"10 s apart; they follow each other at {rate:g} a second",
                )
            )
            return
        if not self._time_unit:
            self.warnings.append(f"its times ({values[0]:g}, ...) are taken for {unit}")
        # Relative to the first one: a float64 of seconds since 1970 has steps of 0.2 us.
        stamps = np.round((values - values.min()) * UNITS[unit]).astype(np.int64)
        stamps += round(float(values.min())) * UNITS[unit] if abs(values.min()) < 2**53 else 0
        self._stamps = stamps.tolist()

    def _do_grow(self, times: NDArray[Any]) -> bool:
        """Return whether times (f,) of the frames are in their order, but for a few.

        How long a detector took for each image is no time of a frame.
        """
        if all(isinstance(key, float) for key in self._keys):
            return True  # frames that only their times tell apart
        numbers = self._frame_numbers()
        steps = np.diff(times if numbers is None else times[np.argsort(numbers, kind="stable")])
        return bool(not len(steps) or (steps < 0).mean() <= _BACKWARDS and steps.any())

    def reasons(self) -> list[str]:
        """Return a sentence for each reason for which entries were left out."""
        sentences = []
        for reason, count in self._left_out_counts.items():
            places = self._left_out.get(reason, [])
            more = ", ..." if len(places) > _NAMED else ""
            named = f" ({', '.join(places[:_NAMED])}{more})" if places else ""
            sentences.append(f"left out: {count} that {reason}{named}")
        return sentences

    def _category(self) -> Any:
        """Return the category to read; raise KeypointFileError if the choice is not clear."""
        wanted = self.options.category
        present = list(dict.fromkeys(category for category, _ in self._groups))
        # A category without keypoints of its own is one more name of nothing: a car, a ball.
        known = dict.fromkeys([*self._names, *present])
        named = {c: self._categories.get(c, "") for c in known if c is not None}
        text = ", ".join(f"{n} ({c})" if n else str(c) for c, n in named.items()) or "none"
        if wanted:
            chosen = [c for c, n in named.items() if wanted in (n, str(c))]
            if not chosen:
                raise KeypointFileError(
                    f"it has no category {wanted!r} with keypoints; there are: {text}"
                )
            for c, q in list(self._groups):
                if c not in (chosen[0], None):
                    del self._groups[c, q]
            return chosen[0]
        names = {self._names.get(c) for c in present}
        if len(present) > 1 and (len(names) > 1 or len({q for _, q in self._groups}) > 1):
            raise KeypointFileError(
                f"it has objects of several categories: {text}; choose one with --category"
            )
        if len(present) > 1 and names == {None}:
            self.warnings.append(
                f"its objects are of several categories ({text}) without names of keypoints, and "
                "are read as one: choose one with --category"
            )
        return present[0] if present else next(iter(self._names), None)

    def _layout(self, category: Any) -> KeypointLayout | None:
        """Return the layout of the keypoints; None if nothing says it."""
        options = self.options
        names = self._names.get(category, self._names.get(None))
        if names and are_numbers(names) and not self._knows(names):
            names = None
        if names is None:
            layout = self._preset or self._of_mediapipe()
        else:
            try:
                layout = layout_of_names(names, self.options.owners())
            except ValueError as error:
                self.warnings.append(f"its names of keypoints are not used: {error}")
                layout = self._preset
        if options.layout is None:
            return layout or options.fallback
        if layout and (reason := contradiction(options.layout, layout)):
            shown = ", ".join(layout.keypoints[:6]) + (", ..." if len(layout) > 6 else "")
            raise KeypointFileError(
                f"it names its keypoints ({shown}), not as the keypoint layout "
                f"{options.layout.name}: {reason}; leave out --keypoint-layout to use the names of "
                "the file"
            )
        return options.layout

    def _knows(self, names: Sequence[str]) -> bool:
        """Return whether a layout that the options name has a keypoint of these names."""
        return any(not set(names).isdisjoint(each.keypoints) for each in self.options.owners())

    def _of_mediapipe(self) -> KeypointLayout | None:
        """Return the layout of MediaPipe's landmarks; None if the objects are no such landmarks.

        A layout that the options name goes before it.
        """
        is_pose = self.is_mediapipe and {q for _, q in self._groups} == {_MEDIAPIPE}
        return LAYOUTS["mediapipe33"] if is_pose and self.options.layout is None else None

    def _group(self, layout: KeypointLayout | None) -> _Group:
        """Return the objects with the number of keypoints of the layout; count the others."""
        counts: Counter[int] = Counter()
        for (_, q), group in self._groups.items():
            counts[q] += len(group.frame)
        most = max(counts, key=lambda q: counts[q]) if counts else 0
        q = len(layout) if layout else most
        if counts and q not in counts:
            raise KeypointFileError(wrong_count(most, layout))
        for other in counts:
            if other != q:
                self._leave_out_groups(other, f"have {other} keypoints, not {q}")
        groups = [group for (_, count), group in self._groups.items() if count == q]
        merged = groups[0] if groups else _Group(q)
        for group in groups[1:]:
            merged.extend(group)
        return merged

    def _leave_out_groups(self, keypoints: int, reason: str) -> None:
        """Count the objects of so many keypoints as left out, in their frames."""
        for (_, q), group in self._groups.items():
            if q == keypoints:
                for frame in group.frame:
                    self.leave_out(reason, self.frame_name(frame), is_loss=True)

    def _in_order(self) -> tuple[NDArray[np.int64], Frames, NDArray[np.int64]]:
        """Return the order of the frames in time, what they are called, and their stamps."""
        f, names, stamps = len(self._keys), self._frame_names, self._stamps
        numbers = self._frame_numbers()
        if numbers is not None:
            order = np.argsort(numbers, kind="stable")
        elif f and None not in stamps:
            order = np.argsort(np.array(stamps, np.int64), kind="stable")
        else:
            order = np.array(sorted(range(f), key=self._place_in_order), np.int64)
        numbers = None if numbers is None else numbers[order]
        rate = self.options.rate or self._own_rate or DEFAULT_RATE
        times = stamps_of(numbers, f, rate)
        unit = "" if numbers is None or self.options.rate else unit_of_epoch(numbers)
        if numbers is not None and unit:
            times = numbers * UNITS[unit]
            self.warnings.append(
                f"numbers of frames such as {numbers[0]} are taken for times in {unit}"
            )
        elif numbers is not None and f and numbers.max() >= MOST and None in stamps:
            self.warnings.append(
                f"numbers of frames such as {numbers.max()} are no count at a rate: frames follow "
                f"each other at {rate:g} a second"
            )
        if f and None not in stamps:
            if self.options.rate:
                raise KeypointFileError("it has times of its own: leave out --rate")
            times = np.array(stamps, np.int64)[order]
        called = Frames(
            np.arange(f) if numbers is None else numbers,
            np.array([names[i] for i in order.tolist()], str),
        )
        return order, called, times

    def _place_in_order(self, index: int) -> tuple[int, list[tuple[int, int, str]]]:
        """Return the sorting key of a frame without a number: listed frames come first."""
        place = self._order[index]
        return (self._listed, natural(self._keys[index])) if place is None else (place, [])

    def _frame_numbers(self) -> NDArray[np.int64] | None:
        """Return the number (f,) of each frame; None if the input does not say it."""
        keys = self._keys
        if keys and None not in self._numbers:
            numbers = np.array(self._numbers, np.int64)
            if len(np.unique(numbers)) == len(numbers):
                is_count = numbers.max() < MOST or unit_of_epoch(numbers)
                found = None if is_count else numbers_in(self._frame_names)
                return numbers if found is None else found
            self._find_series()
            return None
        if all(self._frame_names) and (found := numbers_in(self._frame_names)) is not None:
            return found
        self._find_series()
        if all(isinstance(key, int) and abs(key) < 2**62 for key in keys):
            return np.array(keys, np.int64)
        return None

    def _find_series(self) -> None:
        """Find that the names of the frames are numbered anew, as those of several videos."""
        if series := series_of(self._frame_names):
            self.find(
                Finding(
                    "series",
                    f"the names of its frames are {len(series)} series ({', '.join(series[:4])}): "
                    "are they of several cameras or videos? Read each by itself",
                )
            )


def plausible_unit(times: NDArray[np.float64]) -> str:
    """Return the largest unit in which frames are 1 ms to 10 s apart; "" if there is none."""
    spacing = np.diff(np.unique(times))
    return next((name for name, ns in UNITS.items() if plausible_spacing(spacing, ns)), "")


def unit_of_epoch(numbers: NDArray[np.int64]) -> str:
    """Return the unit in which numbers are times since 1970, and frames apart; "" if in none."""
    for unit, ns in UNITS.items() if len(numbers) else ():
        seconds = 10**9 // ns
        if _YEARS[0] * seconds <= numbers.min() and numbers.max() < _YEARS[1] * seconds:
            return unit if plausible_spacing(np.diff(np.unique(numbers)), ns) else ""
    return ""


def plausible_spacing(spacing: NDArray[Any], ns: int) -> bool:
    """Return whether frames are 1 ms to 10 s apart.

    Args:
        spacing: (f - 1,) of their times.
        ns: the unit of the times.
    """
    return bool(len(spacing)) and 0.001 <= float(np.median(spacing)) / 1e9 * ns <= 10


def weak_keypoints(group: _Group, min_confidence: float) -> list[str]:
    """Return what to say where many keypoints are below the least confidence, before they go."""
    weak = present = 0
    n = len(group.frame)
    for rows in slices(n):
        confidence = group.confidence[:n][rows]
        given = confidence > 0
        present += int(given.sum())
        weak += int((given & (confidence < min_confidence)).sum())
    if weak <= _WEAK * present:
        return []
    sample = group.confidence[: min(n, _ROWS)]
    middle = float(np.median(sample[sample > 0])) if (sample > 0).any() else 0.0
    return [
        f"{weak} of {present} keypoints have a confidence below --min-confidence "
        f"{min_confidence:g}, and count as missing (the median of all is {middle:.2g}): lower it "
        "if they are right"
    ]


def _no_identities(group: _Group) -> str:
    """Return why values are no identities: they tell no objects apart, or are never the same."""
    given = [(f, i) for f, i in zip(group.frame, group.identities, strict=True) if i is not None]
    distinct = len(set(given))
    if len(given) - distinct > _REPEATED * len(given):
        return "the same for several objects of a frame"
    several = len({frame for frame, _ in given}) > 1 and len(given) >= _ALIKE_OBJECTS
    if several and len({identity for _, identity in given}) == len(given):
        return "another one for each object"
    return ""


def _share(low: NDArray[Any], high: NDArray[Any], box: tuple[float, ...]) -> float:
    """Return the share of the area of keypoints from `low` to `high` that is in a box."""
    inside = np.minimum(high, box[2:]) - np.maximum(low, box[:2])
    return float(np.prod(inside) / max(np.prod(high - low), 1e-9))


def _boxes(group: _Group, most: int) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return keypoints (n, q, 2), NaN where missing, and corners (n, 2) of the first objects."""
    n = min(len(group.frame), most)
    points = group.points[:n].astype(np.float64)
    usable = (group.confidence[:n] > 0) & points.any(-1) & np.isfinite(points).all(-1)
    points[~usable] = np.nan
    points = points[usable.sum(1) >= _FEW]
    if not len(points):
        return points, np.empty((0, 2)), np.empty((0, 2))
    return points, np.nanmin(points, 1), np.nanmax(points, 1)


def _is_one_object(group: _Group) -> bool:
    """Return whether most objects lie where the one before lies, as the same object later does."""
    points, low, high = _boxes(group, _ROWS)
    if len(points) < _CROWD:
        return False
    inside = np.clip(np.minimum(high[1:], high[:-1]) - np.maximum(low[1:], low[:-1]), 0, None)
    area, common = np.prod(high - low, 1), np.prod(inside, 1)
    union = area[1:] + area[:-1] - common
    return bool(np.median(common / np.maximum(union, 1e-9)) > _SAME_PLACE)


def _are_same_objects(group: _Group) -> bool:
    """Return whether most objects have the pose and place of another one, nearly.

    Equal ones are copies, and are left out elsewhere.
    """
    points, low, high = _boxes(group, _COMPARED)
    if len(points) < _ALIKE_OBJECTS:
        return False
    size = np.linalg.norm(high - low, axis=1)
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    distance = np.where(np.isfinite(apart).any(-1), np.nanmean(np.nan_to_num(apart), -1), np.inf)
    distance = distance / np.maximum(size, 1e-9)[:, None]
    distance[distance == 0] = np.inf
    return bool(np.median(distance.min(1)) < _ALIKE)


def wrong_count(q: int, layout: KeypointLayout | None) -> str:
    """Return the error text for objects none of which has the keypoints of the layout."""
    name, size = (layout.name, len(layout)) if layout else ("", 0)
    fitting = [preset for preset in LAYOUTS if len(LAYOUTS[preset]) == q]
    others = f" ({', '.join(fitting)} has {q})" if len(fitting) == 1 else ""
    others = f" ({', '.join(fitting)} have {q})" if len(fitting) > 1 else others
    if name == NAMED_BY_INPUT:
        return (
            f"its objects have {q} keypoints, and it names {size}: correct the names, or leave "
            f"them out and name the layout with --keypoint-layout{others}"
        )
    return (
        f"its objects have {q} keypoints; the keypoint layout {name} has {size}: name the layout "
        f"in which they were written with --keypoint-layout{others}"
    )


def identities_of(
    given: Sequence[str | None], frame: NDArray[np.int64]
) -> tuple[NDArray[np.str_], str]:
    """Return the identities (m,) of objects, and a warning, "" for none.

    Args:
        given: m identities of the input; None for an object without one.
        frame: (m,) the frame of each.

    Returns:
        The identities of the input, "" for an object without one and for the second of the same
        identity in a frame; the index in the frame if the input has none at all.
    """
    if not any(identity is not None for identity in given):
        index = index_in_frame(frame)
        return index.astype(f"U{len(str(index.max(initial=0)))}"), ""
    identities = np.array([identity or "" for identity in given], str)
    codes = np.unique(identities, return_inverse=True)[1]
    pairs = frame * (int(codes.max()) + 1) + codes
    first = np.unique(pairs, return_index=True)[1]
    repeated = np.ones(len(pairs), bool)
    repeated[first] = False
    repeated &= identities != ""
    if not repeated.any():
        return identities, ""
    example = identities[repeated][0]
    identities[repeated] = ""
    return identities, (
        f"{repeated.sum()} objects have the identity of another one in their frame, such as "
        f"{example}; they are read without identity"
    )


def as_identity(value: Any) -> str | None:
    """Return the identity that a field of a detector gives; None for none (-1, [-1], "", null)."""
    while isinstance(value, list):  # [3], [[3.0], [3.0]] of AlphaPose
        value = value[0] if value and all(each == value[0] for each in value) else None
    if isinstance(value, bool) or value is None:
        return None
    if isinstance(value, (int, float)):
        if not abs(value) < 2**62 or value == -1:
            return None
        return str(int(value)) if value == int(value) else str(value)
    return value if isinstance(value, str) and value not in ("", "-1") else None


def as_score(value: Any) -> float | None:
    """Return the score that a field of a detector gives; None for none."""
    while isinstance(value, list) and len(value) == 1:
        value = value[0]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or value != value:
        return None
    return float(value)


def as_values(keypoints: Any, scores: Any = None, expected: int | None = None) -> NDArray[Any]:
    """Return x, y and confidence (q, 3) of an object in any of the forms that detectors write.

    Args:
        keypoints: [x, y, s, ...], [[x, y, s], ...], or with `scores` or without any confidence
            [x, y, ...] or [[x, y], ...].
        scores: q confidences beside them; None = there are none.
        expected: number of keypoints of the layout, to tell x, y, ... from x, y, s, ...

    Raises:
        ValueError: they have none of these forms; the text says what is wrong.
    """
    try:
        values = np.asarray(keypoints, np.float64)
        beside = None if scores is None else np.asarray(scores, np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        raise ValueError("have keypoints that are no numbers, or not as many each") from None
    if values.ndim == 3 and len(values) == 1:
        values = values[0]
    if not values.size or values.ndim == 0:
        raise ValueError(NO_KEYPOINTS)
    if values.ndim == 1 and values.size in (4 * (expected or 0), 4 * _MEDIAPIPE):
        values = values.reshape(-1, 4)
    if values.ndim == 2 and values.shape[1] == 4:  # x, y, z and visibility of MediaPipe
        values = values[:, [0, 1, 3]]
    if values.ndim == 1:
        pairs = values.size % 3 != 0 or values.size == 2 * (expected or 0)
        if beside is not None and values.size != 3 * beside.size:
            pairs = True
        width = 2 if pairs else 3
        if values.size % width:
            raise ValueError(f"have {values.size} numbers, which are no pairs or triples")
        values = values.reshape(-1, width)
    if values.ndim != 2 or values.shape[1] not in (2, 3):
        raise ValueError(f"have keypoints of shape {values.shape}, not (q, 2) or (q, 3)")
    if beside is not None:
        if beside.size != len(values):
            raise ValueError(f"have {len(values)} keypoints and {beside.size} confidences")
        return np.column_stack([values[:, :2], beside])
    if values.shape[1] == 2:
        return np.column_stack([values, np.ones(len(values))])
    return values

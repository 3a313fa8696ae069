# SPDX-License-Identifier: Apache-2.0
"""JSON of detectors: COCO, OpenPose, MMPose, AlphaPose, MediaPipe and PoseNet.

They differ in what holds the frames, and in the names of the same few fields of an object. One
reader takes them all, so that a mixture (COCO results with nested keypoints, identities of
AlphaPose) is read as well; and arrays written as lists, and keypoints by name, as scripts write
them.

A list at the top is of frames if its elements are frames, as results of MediaPipe are; else it is
of the objects of one frame. An object at the top is a frame, or the only object of one, if it has
what they have; else it holds them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from itertools import chain, islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.formats.builder import (
    NO_KEYPOINTS,
    DetectionsBuilder,
    as_identity,
    as_score,
    as_values,
)
from deep_nrsfm_ros.data.formats.json_fields import (
    frame_field,
    frame_key,
    identity_field,
    is_annotation,
    is_usual,
    letters,
    role,
    time_field,
    time_of,
)
from deep_nrsfm_ros.data.formats.json_items import JsonItem, Readable, items_of, json_items
from deep_nrsfm_ros.data.formats.names import layout_of_dataset
from deep_nrsfm_ros.data.formats.unused import meaning
from deep_nrsfm_ros.layouts.layout import MAX_KEYPOINTS
from deep_nrsfm_ros.lifting.sanity import Finding

EXPECTED = (
    "neither COCO (`annotations`, or a list of results), OpenPose (`people`), MMPose "
    "(`instance_info`), AlphaPose, MediaPipe (`landmarks`) nor of a script of your own (a list "
    'with an object a frame, {"nose": [x, y, confidence], ...})'
)
_KEYPOINTS = (
    *("keypoints", "pose_keypoints_2d", "pose_keypoints", "joints", "landmarks", "landmark"),
    *("pose_landmarks", "poseLandmarks"),
)
_OBJECTS = ("people", "bodies", "instances", "predictions", "poses", "objects", "persons")
_RECORDING = ("annotations", "images", "categories", "meta_info", "instance_info", "frames")
"""Fields of a document that is a recording, and no frame."""
_FRAMES = ("frames", "results")
"""Fields with lists of frames, or of objects that are frames each."""
_SCORES = ("keypoint_scores", "keypoints_scores", "keypoint_score", "scores", "confidence")
_SCORE = ("score", "bbox_score", "confidence")
_ROLES_BESIDE = ("frame", "time", "identity", "confidence")
_MAX_SIDE = 1_000_000  # pixels of an image; a larger number is no size
_FEWEST = 3  # keypoints of an object without a field that names them
_CONFIDENCE = ("visibility", "score", "confidence", "presence", "likelihood")
_WHOLE = 4096  # elements of a document up to which it may be a frame
_VIDEO = ("video_id", "vid_id", "video_name")
_NAMED_VIDEOS = 4  # that a finding names
_MOST_VIDEOS = 100  # that are told apart
_LOOKS = 20  # objects of the same fields in which unused ones are looked for
_MOST_FORMS = 1000  # sets of fields, likewise
_MOST_CONFIDENCE = 100.0  # of a list of confidences; they may be percent
_SEVERAL = 5  # arrays of objects that are frames, and no people of one
_FEW = 100  # characters of a name, an identity or a time
_RATES = ("fps", "framerate", "videofps")
_MEANINGS = {
    "frame": "the frame",
    "time": "the time",
    "identity": "an identity",
    "confidence": "a confidence",
}
"""Roles of fields -> what `unused.meaning` calls them."""
_REMEDIES = {
    "frame": "frame",
    "time": "timestamp",
    "identity": "track_id",
    "confidence": "keypoint_scores",
}
"""Roles of fields -> a name under which they are read."""


class _Unused:
    """A field that is not used: what it may mean, and whether its values are such."""

    def __init__(self, meaning: str) -> None:
        """Start without values."""
        self.meaning, self.is_plausible, self.varies = meaning, False, False
        self._first: Any = None
        self._count = 0

    def look(self, value: Any) -> None:
        """Look at a value."""
        if self.meaning == "a confidence":
            self.is_plausible |= isinstance(value, list) and len(value) >= _FEWEST
        else:
            self.is_plausible |= isinstance(value, (int, float, str)) and len(str(value)) < _FEW
        self._count += 1
        if self._count == 1:
            self._first = value
        elif value != self._first:
            self.varies = True

    def is_told(self, remedies: Mapping[str, str]) -> bool:
        """Return whether to say that the field is not used.

        Args:
            remedies: roles that the reader lacks -> a name under which it reads them.
        """
        if not self.meaning:
            return True
        lacks = any(_MEANINGS[what] == self.meaning for what in remedies)
        is_same = self.meaning != "a confidence" and not self.varies and self._count > 1
        return lacks and self.is_plausible and not is_same


class DefaultFrame(NamedTuple):
    """The frame of objects that name none: that of their file or line.

    Attributes:
        name: of the file or line.
        number: of the frame; None = the number in its name, where the names have one.
        is_document: the document is this frame: a list in it is of objects, not of frames.
        known: its index, where the builder has it already.
    """

    name: str
    number: int | None = None
    is_document: bool = False
    known: int | None = None


class JsonReader:
    """Reads documents into a builder, each a whole recording or one frame."""

    def __init__(self, builder: DetectionsBuilder) -> None:
        """Add frames and objects to a builder."""
        self._builder = builder
        layout = builder.options.layout or builder.options.fallback
        self._expected = len(layout) if layout else None
        self._wants_hands = layout is not None and layout.name.startswith("hand")
        self._order: dict[str, int] = {}  # places of keypoints with names
        self._has: set[str] = set()  # roles of fields that objects or frames had
        self._nobody: list[DefaultFrame] = []  # frames without objects, and without a name
        self._videos: dict[Any, None] = {}
        self._forms: Counter[tuple[str, ...]] = Counter()  # of the fields of an object
        self._unused: dict[str, _Unused] = {}
        self._odd_times: list[Any] = []

    def read(self, file: Readable, frame: DefaultFrame) -> str:
        """Read a document; return what is wrong if it is of no known form, else "".

        Args:
            file: the document.
            frame: the frame of objects without one of their own.

        Raises:
            ValueError: the document is no JSON, or ends early; what comes before is read.
        """
        return self._read(json_items(file), frame)

    def read_value(self, value: Any, frame: DefaultFrame) -> str:
        """Read a document that is decoded; return as `read` does."""
        return self._read(items_of(value), frame)

    def finish(self) -> None:
        """Add the frames without objects, and say what was not used, after the last document."""
        if "frame" not in self._has:  # where frames are named, those without a name have no place
            for frame in self._nobody:
                self._builder.frame(frame.name, number=frame.number)
        self._nobody.clear()
        if len(self._videos) > 1:
            named = ", ".join(map(str, list(self._videos)[:_NAMED_VIDEOS]))
            self._builder.find(
                Finding(
                    "series",
                    f"its images are of {len(self._videos)} videos ({named}), and are lifted as "
                    "one: write a file for each",
                )
            )
        if self._odd_times:
            shown = ", ".join(f"{time!r:.40}" for time in self._odd_times[:2])
            self._builder.find(
                Finding(
                    "times",
                    f"its times ({shown}, ...) are not used: write them as numbers of seconds, or "
                    "as dates such as 2024-05-01T10:00:00.300Z",
                )
            )
        remedies = {what: name for what, name in _REMEDIES.items() if what not in self._has}
        used = {name: field for name, field in self._unused.items() if field.is_told(remedies)}
        self._builder.not_used(
            "fields",
            used,
            {_MEANINGS[what]: name for what, name in remedies.items()},
        )

    def _read(self, items: Iterator[JsonItem], frame: DefaultFrame) -> str:
        """Read the items of a document; return as `read` does."""
        start: list[JsonItem] = []
        error: Exception | None = None
        try:
            for item in islice(items, _WHOLE):
                start += [item]  # one by one, so that an error leaves those before it
                if _is_recording(item, frame):
                    break
        except (ValueError, RecursionError) as caught:
            error = caught
        problem = self._read_start(start, items, frame, is_cut=error is not None)
        if error:
            raise error
        return problem

    def _read_start(
        self, start: list[JsonItem], items: Iterator[JsonItem], frame: DefaultFrame, is_cut: bool
    ) -> str:
        """Read a document, of which the start is read so far; return as `read` does."""
        is_whole = len(start) < _WHOLE and not any(_is_recording(each, frame) for each in start)
        values = [value for _, value, _ in start]
        if not start or start[0].key is not None:
            fields = _fields_of(start)
            if is_whole and self._document(fields, frame, is_cut):
                return ""
            frame = self._frame_beside(fields, frame)
        elif is_whole and _are_coordinates(values) and _are_numbers(values):
            self._person({"keypoints": values}, self._frame_of({}, frame))
            return ""
        return self._items(chain(start, items), _series(start), frame)

    def _document(self, fields: Mapping[str, Any], frame: DefaultFrame, is_cut: bool) -> bool:
        """Read a document that is one frame, or one object; return False if it is neither."""
        if not fields:
            if frame.is_document and not is_cut:
                self._nobody.append(frame)
                return True
            return False
        if any(isinstance(fields.get(name), (list, dict)) for name in _RECORDING):
            return False
        objects = _object_fields(fields)
        keypoints = self._keypoint_fields(fields)
        if frame.is_document:
            if objects or keypoints or _named_points(fields) or _is_empty_frame(fields):
                return self._element(fields, frame, None)
            return False
        if objects:
            values = [each for name in objects for each in _as_list(fields[name])]
            return not _holds_frames(values) and self._element(fields, frame, None)
        if not keypoints:
            return bool(_named_points(fields)) and self._element(fields, frame, None)
        value, is_landmarks = fields[keypoints[0]], _is_landmarks(keypoints[0])
        if self._by_number(fields, value, frame):
            return True
        if _people_in(value) >= _SEVERAL and not frame_field(fields) and not is_landmarks:
            for i, one in enumerate(_split(fields, keypoints[0])):
                self._element(one, DefaultFrame(f"{frame.name} [{i}]", i), None)
            return True
        if isinstance(value, list) and any(map(_has_keypoints, value)):
            return False  # `keypoints` are objects
        return self._element(fields, frame, None)

    def _by_number(self, fields: Mapping[str, Any], value: Any, frame: DefaultFrame) -> bool:
        """Read frames of easy_ViTPose, {number: [[y, x, score], ...]}; return False for others."""
        skeleton = fields.get("skeleton")
        names = list(skeleton.values()) if isinstance(skeleton, dict) else skeleton
        if not isinstance(value, list) or not isinstance(names, list):
            return False
        if not all(isinstance(one, dict) for one in value):
            return False
        if not any(map(_people_by_id, value)):
            return False
        if all(isinstance(name, str) for name in names):
            self._builder.name_keypoints(names)
        for i, people in enumerate(value):
            index = self._builder.frame(f"{frame.name} [{i}]", number=i)
            for identity, points in _people_by_id(people).items():
                turned = [[point[1], point[0], *point[2:]] for point in points]
                self._person({"keypoints": turned, "track_id": identity}, index)
        return True

    def _frame_beside(self, fields: Mapping[str, Any], frame: DefaultFrame) -> DefaultFrame:
        """Return the frame of the lists of a document, with what it says beside them."""
        if not frame.is_document:
            self._rate(fields)
            return frame
        if not frame_field(fields):
            return frame
        index = self._frame_of(fields, frame)
        self._time(fields, index)
        return frame._replace(known=index)

    def _rate(self, fields: Mapping[str, Any]) -> None:
        """Take the frame rate that a recording says."""
        for name, value in fields.items():
            if letters(name) in _RATES and isinstance(value, (int, float)):
                self._builder.own_rate(value, name)

    def _items(self, items: Iterator[JsonItem], series: set[str], frame: DefaultFrame) -> str:
        """Read the items of a document that is a recording; return as `read` does."""
        known = has_frames = False
        elements = 0
        points: list[Any] = []
        points_key: str | None = None
        nobody: list[DefaultFrame] = []
        keys: dict[str | None, None] = {}
        for key, value, is_element in items:
            keys[key] = None
            if points and key != points_key:
                known |= self._array(points_key, points, frame)
                points = []
            if is_element and _is_point_of(key, value):
                points.append(value)
                points_key = key
                continue
            inner = frame
            if is_element and _is_frame(key, value, frame, series):
                # Frames without a name or number of their own follow one another.
                inner = DefaultFrame(f"{frame.name} [{elements}]", elements)
                has_frames |= bool(value)
            if value == {} and is_element and not frame.is_document:
                nobody.append(DefaultFrame(f"{frame.name} [{elements}]", elements))
            else:
                known |= self._item(key, value, is_element, inner)
            elements += 1
        if points:
            known |= self._array(points_key, points, frame)
        if has_frames:
            self._nobody += nobody
        else:
            for one in nobody:
                self._builder.leave_out(f"{NO_KEYPOINTS}, but nothing", one.name)
        if known:
            return ""
        names = ", ".join(f"`{key}`" for key in list(keys)[:8] if key is not None)
        return EXPECTED + (f"; it has {names}" if names else "")

    def _array(self, key: str | None, points: list[Any], frame: DefaultFrame) -> bool:
        """Read an object that is a list of its keypoints; return False if it is none."""
        are_landmarks = all(map(_is_point, points))
        if not are_landmarks and not _are_numbers(points):
            return False
        if key is not None and role(key) not in ("keypoints", "hands"):
            frame = DefaultFrame(key)
        field = "landmarks" if are_landmarks else "keypoints"
        self._person({field: points}, self._frame_of({}, frame))
        return True

    def _item(self, key: str | None, value: Any, is_element: bool, frame: DefaultFrame) -> bool:
        """Read an item of a document; return False if it is of no known form."""
        if key == "images":
            if is_element:
                self._image(value)
            return True
        if key == "categories":
            if is_element:
                self._category(value)
            return False
        if key == "meta_info":
            self._meta_info(value)
            return False
        is_place = key is None or key in _OBJECTS or _is_landmarks(key)
        if value is None or value == []:
            if is_place:
                self._nobody.append(frame)
            return is_place or key in ("annotations", "instance_info")
        if key is None or key == "instance_info" or role(key) == "objects":
            if isinstance(value, dict) and not is_element and not _has_keypoints(value):
                known = [self._item(k, each, False, frame) for k, each in value.items()]
                return any(known)  # {"frames": {"0": ...}}
            return self._element(value, frame, key)
        if role(key) in ("keypoints", "hands"):
            if isinstance(value, dict) and (frame_field(value) or _has_keypoints(value)):
                return self._element(value, frame, key)
            if isinstance(value, list if is_element else dict):
                self._person({key: value}, self._frame_of({}, frame))
                return True
            return False
        if not isinstance(value, dict):
            return False
        if is_element and _has_keypoints(value):
            if frame_field(value) and not identity_field(value):  # track -> its frames
                value = {**value, "track_id": key}
            return self._element(value, DefaultFrame(key), key)
        if _object_fields(value) or not is_element and _names_a_frame(key, value):
            return self._element(value, DefaultFrame(key), key)  # AlphaPose: image -> people
        return False

    def _element(self, value: Any, frame: DefaultFrame, key: str | None) -> bool:
        """Read an object, a frame, or the list of the objects of a frame."""
        if isinstance(value, list) and (_are_numbers(value) or _are_landmarks(value)):
            field = "keypoints" if _are_numbers(value) else "landmarks"
            self._person({field: value}, self._frame_of({}, frame))
            return True
        if isinstance(value, list):  # a list of instances inside `predictions`
            if not value and frame.known is None:
                self._nobody.append(frame)
            known = [self._element(each, frame, key) for each in value]
            return any(known)
        if not isinstance(value, dict):
            self._builder.leave_out("are no object", f"{frame.name}: {value!r:.30}")
            return False
        try:
            _check_frame(value)
        except ValueError as error:
            self._builder.leave_out(str(error), f"{frame.name}: {value!r:.40}", is_loss=True)
            return True
        if objects := _object_fields(value):
            self._frame(value, objects, frame)
            return True
        if points := _named_points(value):
            index = self._frame_of(value, frame)
            self._time(value, index)
            self._person({**_beside(value), "keypoints": points}, index)
            return True
        fields = self._keypoint_fields(value)
        if fields and _is_landmarks(fields[0]):
            self._result(value, fields, frame)
            return True
        if not fields:
            return self._other(value, frame, key)
        index = self._frame_of(value, frame)
        self._time(value, index)
        self._person(value, index)
        return True

    def _other(self, value: Mapping[str, Any], frame: DefaultFrame, key: str | None) -> bool:
        """Read a frame without objects, or with objects by identity; else leave it out."""
        if _is_empty_frame(value):
            self._time(value, self._frame_of(value, frame))
            return True
        if people := _people_by_id(value):
            index = self._frame_of({}, frame)
            for identity, person in people.items():
                one = person if isinstance(person, dict) else {"keypoints": person}
                self._person({"track_id": identity, **one}, index)
            return True
        # Annotations of COCO are boxes of cars, too.
        if key != "annotations":
            is_3d = any("3d" in letters(name) or "world" in letters(name) for name in value)
            more = " (3D, and the 2D keypoints are needed)" if is_3d else ""
            self._builder.leave_out(
                f"{NO_KEYPOINTS}, but {', '.join(map(str, value))[:60] or 'nothing'}{more}",
                frame.name,
            )
        return key == "annotations"

    def _result(self, value: Mapping[str, Any], fields: list[str], frame: DefaultFrame) -> None:
        """Read a result of MediaPipe: the landmarks of a person, or those of each person."""
        index = self._frame_of(value, frame)
        self._time(value, index)
        for field in fields:
            people = value[field]
            if isinstance(people, list) and all(map(_is_person, people)):
                for person in people:
                    self._person({field: person}, index)
            elif people is not None:  # null: nobody is seen
                self._person({**_without(value, fields), field: people}, index)

    def _time(self, value: Mapping[str, Any], index: int) -> None:
        """Set the time of a frame, if an object or frame says one."""
        field = time_field(value)
        if not field:
            return
        self._has.add("time")
        if time := time_of(value, field):
            self._builder.time(index, *time)
        elif len(self._odd_times) <= 1:
            self._odd_times.append(value[field])

    def _frame(self, value: Mapping[str, Any], objects: list[str], frame: DefaultFrame) -> None:
        """Read the objects of a frame.

        Args:
            value: the frame.
            objects: its fields with objects.
            frame: of the objects, where it does not say it.
        """
        people = [each for name in objects for each in _as_list(value[name])]
        if frame_field(value) or time_field(value):
            index = self._frame_of(value, frame)
            self._time(value, index)
            frame = frame._replace(known=index)
        elif not people and frame.known is None:
            self._nobody.append(frame)
        elif frame.known is None and not any(map(_names_its_frame, people)):
            frame = frame._replace(known=self._frame_of({}, frame))
        self._look(value, objects)
        for name in objects:
            if value[name] is not None and not isinstance(value[name], (list, dict)):
                self._builder.leave_out(f"have no list `{name}`", frame.name)
        identity = identity_field(value)
        for person in people:
            if identity and isinstance(person, dict):
                person = {identity: value[identity], **person}  # a track with its frames
            self._element(person, frame, None)

    def _frame_of(self, value: Mapping[str, Any], frame: DefaultFrame) -> int:
        """Return the index of the frame that an object or frame names, or of the default."""
        if frame.known is not None:
            return frame.known
        if field := frame_field(value):
            self._has.add("frame")
            return self._builder.frame(frame_key(value, field))
        is_listed = not frame.is_document and frame.number is None
        if is_listed and (field := time_field(value)) and (time := time_of(value, field)):
            return self._builder.frame(float(time.value))  # a list of objects with times only
        return self._builder.frame(frame.name, number=frame.number)

    def _keypoint_fields(self, value: Mapping[str, Any]) -> list[str]:
        """Return the fields of an object with keypoints: one, or those of its hands."""
        hands = [name for name in value if role(name) == "hands"]
        if self._wants_hands and hands:
            return hands
        found = next((n for n in _KEYPOINTS if n in value and not _are_texts(value[n])), "")
        if not found:
            names = (name for name in value if role(name) == "keypoints")
            kinds = {"pose": list, "xy": list}
            found = next((n for n in names if isinstance(value[n], kinds.get(n, (list, dict)))), "")
        if found:
            return [found]
        return [name for name in hands if "landmark" in letters(name)]

    def _person(self, person: Mapping[str, Any], frame: int) -> None:
        """Add an object, or those of an array; count what is wrong with one."""
        for field in self._keypoint_fields(person) or [""]:
            for one in _split(person, field):
                self._one(one, field, frame)

    def _one(self, person: Mapping[str, Any], field: str, frame: int) -> None:
        """Add an object with keypoints in a field, or count what is wrong with it."""
        scores_field = next((n for n in _SCORES if isinstance(person.get(n), list)), "")
        scores = person.get(scores_field)
        try:
            keypoints: Any = person.get(field)
            self._builder.is_mediapipe |= _is_landmarks(field)
            if keypoints is None:
                raise ValueError(NO_KEYPOINTS)
            if isinstance(keypoints, dict) and isinstance(keypoints.get("landmark"), list):
                keypoints = keypoints["landmark"]  # of a message of protobuf
            if isinstance(keypoints, dict):
                keypoints = _named_points(keypoints) or _columns(keypoints)
                scores = None
            by_name = False
            if _are_points(keypoints):
                by_name = self._have_names(keypoints)
                keypoints, scores = self._points(keypoints, by_name), None
                self._has.add("confidence")
            values = as_values(keypoints, scores, self._expected)
            if scores is None:
                scores_field = _confidence_field(person, values)
                if scores_field:
                    scores = person[scores_field]
                    values = as_values(keypoints, scores, self._expected)
            self._builder.in_box(values, person.get("bbox", person.get("box")))
        except ValueError as error:
            is_loss = str(error) != NO_KEYPOINTS
            self._builder.leave_out(str(error), self._builder.frame_name(frame), is_loss)
            return
        if scores is not None or not (values[:, 2] == 1).all():
            self._has.add("confidence")
        identity_name = identity_field(person)
        identity = as_identity(person[identity_name]) if identity_name else None
        if identity is not None:
            self._has.add("identity")
            self._builder.has_plain_ids |= letters(identity_name) in ("id", "ids", "poseid")
        if role(field) == "hands" and _is_landmarks(field) and identity is None:
            identity = next((side for side in ("left", "right") if side in letters(field)), None)
        score = next((s for n in _SCORE if (s := as_score(person.get(n))) is not None), None)
        category = person.get("category_id")
        category = category if isinstance(category, (int, str)) else None
        self._builder.is_coco |= category is not None and "image_id" in person
        self._look(person, [field, scores_field, identity_name, *_SCORE])
        self._builder.add(frame, values, identity, score, category, by_name)

    def _look(self, value: Mapping[str, Any], used: list[str]) -> None:
        """Look for fields of an object or frame that are not used."""
        form = tuple(value)
        if self._forms[form] >= _LOOKS or len(self._forms) > _MOST_FORMS:
            return
        self._forms[form] += 1
        taken = {*used, frame_field(value), time_field(value), identity_field(value)}
        if is_annotation(value):
            taken.add("id")
        for name, given in value.items():
            if name in taken or name in _KEYPOINTS or is_usual(name) or not given:
                continue
            if role(name) not in ("keypoints", "hands", "objects"):
                self._unused.setdefault(name, _Unused(meaning(name))).look(given)

    def _have_names(self, points: list[Mapping[str, Any]]) -> bool:
        """Return whether points are told apart by their names; give the builder all names so far.

        Raises:
            ValueError: the objects so far have too many names.
        """
        names = [_name(point) for point in points]
        if not all(isinstance(name, str) for name in names):
            return False
        if len(set(names)) < len(names):
            self._builder.name_keypoints(names)
            return False
        new = [name for name in names if name not in self._order]
        if len(self._order) + len(new) > MAX_KEYPOINTS:
            raise ValueError(f"have names of more than {MAX_KEYPOINTS} keypoints with the others")
        for name in new:
            self._order[name] = len(self._order)
        if new:
            self._builder.name_keypoints(list(self._order))
        return True

    def _points(self, points: list[Mapping[str, Any]], by_name: bool) -> list[list[Any]]:
        """Return x, y and confidence of points with named coordinates.

        Args:
            points: of an object.
            by_name: their names say their places, whatever their order; those that the object
                lacks are NaN.
        """
        rows = [[np.nan] * 3 for _ in (self._order if by_name else points)]
        for i, point in enumerate(points):
            position = point.get("position", point)
            confidence = next((point[n] for n in _CONFIDENCE if n in point), 1.0)
            place = self._order[_name(point)] if by_name else i
            rows[place] = [position.get("x"), position.get("y"), confidence]
        return rows

    def _image(self, image: Any) -> None:
        """Read an entry of `images`."""
        key = image.get("id") if isinstance(image, dict) else None
        if not isinstance(key, (int, str)):
            self._builder.leave_out("are images without `id`", f"{image!r:.40}")
            return
        video = next((image[n] for n in _VIDEO if isinstance(image.get(n), (int, str))), None)
        if video is not None and len(self._videos) < _MOST_VIDEOS:
            self._videos[video] = None
        name = image.get("file_name")
        number = image.get("frame_id", image.get("frame_number"))
        self._builder.frame(
            key,
            name if isinstance(name, str) else "",
            number if isinstance(number, int) else None,
            listed=True,
        )
        width, height = image.get("width"), image.get("height")
        known = all(isinstance(side, int) and 0 < side <= _MAX_SIDE for side in (width, height))
        self._builder.image_size((width, height) if known else None)

    def _category(self, category: Any) -> None:
        """Read an entry of `categories`."""
        if not isinstance(category, dict) or not isinstance(category.get("id"), (int, str)):
            return
        name, names = category.get("name"), category.get("keypoints")
        if isinstance(names, list) and names:
            self._builder.name_keypoints(names, category["id"])
            self._builder.name_category(category["id"], name if isinstance(name, str) else "")

    def _meta_info(self, info: Any) -> None:
        """Read `meta_info` of MMPose."""
        if not isinstance(info, dict):
            return
        if layout := layout_of_dataset(str(info.get("dataset_name", ""))):
            self._builder.use_preset(layout)
        names = info.get("keypoint_id2name")
        if isinstance(names, dict):
            try:
                ordered = [names[key] for key in sorted(names, key=int)]
            except ValueError:
                return
            self._builder.name_keypoints(ordered)


def _fields_of(start: list[JsonItem]) -> dict[str, Any]:
    """Return the fields of a document, of its items."""
    fields: dict[str, Any] = {}
    for key, value, is_element in start:
        if key is None:
            continue
        if not is_element:
            fields[key] = value
        elif isinstance(fields.get(key), list):
            fields[key].append(value)
        else:
            fields[key] = [value]
    return fields


def _is_recording(item: JsonItem, frame: DefaultFrame) -> bool:
    """Return whether a document with such an item is a recording, whatever else is in it."""
    if item.key is None:
        return not isinstance(item.value, (int, float))
    return item.key in _RECORDING and not frame.is_document


def _series(start: list[JsonItem]) -> set[str]:
    """Return the fields with several lists of objects, which are frames: `predictions`."""
    counts = Counter(
        key
        for key, value, is_element in start
        if key and is_element and isinstance(value, list) and not _is_array(value)
    )
    return {key for key, count in counts.items() if count > 1 and role(key) == "objects"}


def _is_frame(key: str | None, value: Any, document: DefaultFrame, series: Collection[str]) -> bool:
    """Return whether an element of a list at the top is a frame, not an object."""
    if key in _FRAMES:
        return isinstance(value, (dict, list))
    if key is not None and (role(key) != "objects" or document.is_document):
        return False
    if isinstance(value, dict):
        if document.is_document:
            return False
        return bool(_object_fields(value) or _named_points(value)) or _is_result(value)
    return key is None and not document.is_document or key in series


def _is_result(value: Mapping[str, Any]) -> bool:
    """Return whether an entry is a result of MediaPipe or an array of people, one for each image.

    An entry with an identity is a person.
    """
    names = [name for name in value if role(name) in ("keypoints", "hands")]
    are_people = any(_is_landmarks(name) or _people_in(value[name]) for name in names)
    return are_people and not identity_field(value)


def _holds_frames(values: list[Any]) -> bool:
    """Return whether the objects of a document are frames: several lists, or lists in them."""
    lists = sum(isinstance(each, list) and not _is_array(each) for each in values)
    return lists > 1 or any(isinstance(each, dict) and _object_fields(each) for each in values)


def _names_its_frame(value: Any) -> bool:
    """Return whether an object of a frame, or each of a list of them, names its own frame."""
    values = value if isinstance(value, list) else [value]
    return any(isinstance(each, dict) and frame_field(each) for each in values)


def _check_frame(value: Mapping[str, Any]) -> None:
    """Raise ValueError if an object names its frame by neither a number nor a text."""
    for name in ("image_id", "frame_id"):
        if value.get(name) is not None and not frame_field({name: value[name]}):
            raise ValueError(f"have an `{name}` that is neither a number nor a text")


def _names_a_frame(key: str, value: Mapping[str, Any]) -> bool:
    """Return whether a key of a document is the name of the frame whose object is its value."""
    if _named_points(value):
        return True
    has_number = any(character.isdigit() for character in key)
    return has_number and (_has_keypoints(value) or bool(_people_by_id(value)))


def _object_fields(value: Mapping[str, Any]) -> list[str]:
    """Return the fields of a frame with its objects."""
    found = [name for name in _OBJECTS if name in value]
    for name, given in value.items():
        if name in found or role(name) != "objects":
            continue
        objects = _as_list(given)
        if given == [] or any(map(_is_like_object, objects[:_FEWEST])):
            found.append(name)
    return found


def _is_like_object(value: Any) -> bool:
    """Return whether a value is like an object or a frame."""
    if isinstance(value, dict):
        return _has_keypoints(value) or bool(_named_points(value) or _object_fields(value))
    return isinstance(value, list) and _is_array(value)


def _has_keypoints(value: Any) -> bool:
    """Return whether a value has a field of keypoints."""
    if not isinstance(value, dict):
        return False
    return any(
        (name in _KEYPOINTS or role(name) == "keypoints" and isinstance(given, list))
        and not _are_texts(given)
        for name, given in value.items()
    )


def _are_texts(value: Any) -> bool:
    """Return whether a list begins with a text that is no number: the names of keypoints."""
    if not isinstance(value, list) or not value or not isinstance(value[0], str):
        return False
    return not value[0].strip().lstrip("+-").replace(".", "", 1).isdigit()


def _is_empty_frame(value: Mapping[str, Any]) -> bool:
    """Return whether a value is a frame without objects: its name, and nothing else that counts.

    An entry with `image_id` is an object.
    """
    if not frame_field(value) or "image_id" in value:
        return False
    return all(
        given is None or given in ([], {}) or role(name) in ("frame", "time") or name == "header"
        for name, given in value.items()
    )


def _people_by_id(value: Mapping[str, Any]) -> dict[str, Any]:
    """Return the objects of {identity: object}; {} if they are none."""
    if not all(any(character.isdigit() for character in name) for name in value):
        return {}
    is_people = all(
        _has_keypoints(one) or isinstance(one, list) and _is_array(one) for one in value.values()
    )
    return dict(value) if is_people else {}


def _people_in(keypoints: Any) -> int:
    """Return the number of objects in keypoints (n, q, 2 or 3) or (n, 3q); 0 for one object."""
    if not isinstance(keypoints, list) or not all(isinstance(r, list) and r for r in keypoints):
        return 0
    if all(isinstance(row[0], (list, dict)) for row in keypoints):
        return len(keypoints)
    return len(keypoints) if all(len(row) >= 2 * _FEWEST for row in keypoints) else 0


def _split(value: Mapping[str, Any], field: str) -> list[Mapping[str, Any]]:
    """Return the objects of arrays: keypoints (n, q, 2) with scores (n, q), n identities, ..."""
    n = _people_in(value.get(field))
    if not n:
        return [value]
    shared = {k: v for k, v in value.items() if not isinstance(v, list) or len(v) != n}
    own = {k: v for k, v in value.items() if k not in shared}
    return [{**shared, **{k: v[i] for k, v in own.items()}} for i in range(n)]


def _confidence_field(person: Mapping[str, Any], values: NDArray[np.float64]) -> str:
    """Return the field with a confidence for each keypoint under an unusual name; "" for none.

    Args:
        person: the object.
        values: (q, 3) its keypoints as they are without the field.
    """
    third = values[:, 2]
    if ((third >= 0) & (third <= 1)).all() and (third < 1).any():
        return ""
    for name, given in person.items():
        if not isinstance(given, list) or role(name) != "confidence" or "box" in letters(name):
            continue
        try:
            beside = np.asarray(given, np.float64).ravel()
        except (TypeError, ValueError, OverflowError):
            continue
        is_plausible = ((beside >= 0) & (beside <= _MOST_CONFIDENCE)) | np.isnan(beside)
        if beside.size == len(values) and is_plausible.all():
            return name
    return ""


def _as_list(value: Any) -> list[Any]:
    """Return a list as it is, an object as a list of it, and [] for all else."""
    return value if isinstance(value, list) else [value] if isinstance(value, dict) else []


def _without(value: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Return the other fields."""
    return {name: given for name, given in value.items() if name not in names}


def _is_landmarks(name: str) -> bool:
    """Return whether a field of this name is of MediaPipe."""
    return "landmark" in letters(name)


def _is_point_of(key: str | None, value: Any) -> bool:
    """Return whether an element is a keypoint of an object that is all of the list."""
    is_listed = isinstance(value, list) and 2 <= len(value) <= 4 and _are_coordinates(value)
    if not is_listed and not _is_point(value):
        return False
    if key is None or role(key) in ("keypoints", "hands"):
        return True
    return any(character.isdigit() for character in key) and not is_usual(key)


def _is_point(value: Any) -> bool:
    """Return whether a value is a keypoint with `x` and `y`, and not an object with its centre."""
    if not isinstance(value, dict) or "x" not in value or "y" not in value:
        return False
    return not any(role(name) in ("keypoints", "frame") for name in value)


def _is_person(value: Any) -> bool:
    """Return whether an element of the landmarks of an image is all landmarks of a person."""
    is_array = isinstance(value, list) and all(isinstance(each, list) for each in value)
    is_message = isinstance(value, dict) and isinstance(value.get("landmark"), list)
    return is_array or is_message or _are_points(value)


def _are_landmarks(value: list[Any]) -> bool:
    """Return whether a list is an object, of keypoints with `x` and `y`."""
    return len(value) >= _FEWEST and all(map(_is_point, value))


def _is_array(value: list[Any]) -> bool:
    """Return whether a list is an object of keypoints."""
    return _are_numbers(value) or _are_landmarks(value)


def _are_numbers(value: list[Any]) -> bool:
    """Return whether a list is an object as an array: [[x, y, s], ...] or [x, y, s, ...]."""
    if value and all(isinstance(point, list) and 2 <= len(point) <= 4 for point in value):
        value = [number for point in value for number in point]
    return len(value) >= 2 * _FEWEST and _are_coordinates(value)


def _named_points(value: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return points with their names, of {name: {x, y, ...}} or {name: [x, y, s]}; else [].

    A point may be null, or [x, y, z, s], and beside the points there may be a frame, a time, an
    identity, a score and what is usual.
    """
    points: list[dict[str, Any]] = []
    for name, point in value.items():
        if isinstance(point, dict) and "x" in point and "y" in point:
            points.append({**point, "name": name})
        elif isinstance(point, list) and len(point) in (2, 3) and _are_coordinates(point):
            points.append({"name": name, **dict(zip(("x", "y", "score"), point, strict=False))})
        elif _is_point_with_z(name, point):
            points.append({"name": name, "x": point[0], "y": point[1], "score": point[3]})
        elif role(name) in _ROLES_BESIDE or name == "header":
            continue
        elif point is None:
            points.append({"name": name, "x": None, "y": None})
        elif not is_usual(name) or isinstance(point, dict):
            return []
    present = sum(point["x"] is not None for point in points)
    return points if present >= _FEWEST else []


def _is_point_with_z(name: str, point: Any) -> bool:
    """Return whether a field is a keypoint [x, y, z, visibility], and no box."""
    is_list = isinstance(point, list) and len(point) == 4 and _are_coordinates(point)
    return is_list and "box" not in letters(name)


def _beside(value: Mapping[str, Any]) -> dict[str, Any]:
    """Return what an object says of itself beside its named points."""
    return {name: given for name, given in value.items() if role(name) in _ROLES_BESIDE}


def _name(point: Mapping[str, Any]) -> Any:
    """Return the name of a keypoint; None if it has none."""
    return point.get("name", point.get("part"))


def _are_coordinates(values: list[Any]) -> bool:
    """Return whether all values are numbers, or null for a missing one."""
    return all(value is None or isinstance(value, (int, float)) for value in values)


def _columns(keypoints: Mapping[str, Any]) -> list[list[Any]]:
    """Return x, y and confidence of keypoints given as lists of each (Ultralytics).

    Raises:
        ValueError: there are no such lists, or they are not of one length.
    """
    x, y = keypoints.get("x"), keypoints.get("y")
    names = ("visible", *_CONFIDENCE)
    c = next((keypoints[n] for n in names if isinstance(keypoints.get(n), list)), None)
    columns = [column for column in (x, y, c) if isinstance(column, list)]
    if len(columns) < 2 or not isinstance(x, list) or not isinstance(y, list):
        raise ValueError(f"have keypoints with {', '.join(map(str, keypoints))[:60]}, not x and y")
    if len({len(column) for column in columns}) > 1:
        raise ValueError("have lists x and y of other lengths")
    return [list(row) for row in zip(*columns, strict=True)]


def _are_points(keypoints: Any) -> bool:
    """Return whether keypoints are objects with `x` and `y` (MediaPipe, PoseNet)."""
    if not isinstance(keypoints, list) or not keypoints:
        return False
    if not all(isinstance(point, dict) for point in keypoints):
        return False
    return all(isinstance(point.get("position", point), dict) for point in keypoints)

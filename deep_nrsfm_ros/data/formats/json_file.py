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

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
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
    IDENTITIES,
    frame_field,
    frame_key,
    identity_field,
    letters,
    role,
    time_field,
    time_of,
)
from deep_nrsfm_ros.data.formats.json_forms import (
    CONFIDENCE,
    KEYPOINTS,
    NUMBER,
    NUMBERS,
    OBJECTS,
    RECORDING,
    are_coordinates,
    are_landmarks,
    are_numbers,
    are_points,
    are_texts,
    as_list,
    at_their_places,
    beside_points,
    check_frame,
    columns_of,
    confidence_field,
    fields_of,
    has_keypoints,
    hint_of,
    holds_frames,
    is_empty_frame,
    is_frame,
    is_landmarks,
    is_person,
    is_point,
    is_point_of,
    is_recording,
    name_of,
    named_points,
    names_a_frame,
    names_its_frame,
    object_fields,
    objects_of,
    other_fields,
    people_by_id,
    people_in,
    series_in,
    with_number,
)
from deep_nrsfm_ros.data.formats.json_items import JsonItem, Readable, items_of, json_items
from deep_nrsfm_ros.data.formats.json_unused import UnusedFields
from deep_nrsfm_ros.data.formats.names import layout_of_dataset
from deep_nrsfm_ros.data.formats.overlap import CROWD, SAME_PLACE, overlap_in_turn
from deep_nrsfm_ros.layouts.layout import MAX_KEYPOINTS
from deep_nrsfm_ros.lifting.sanity import Finding

EXPECTED = (
    "neither COCO (`annotations`, or a list of results), OpenPose (`people`), MMPose "
    "(`instance_info`), AlphaPose, MediaPipe (`landmarks`) nor of a script of your own (a list "
    'with an object a frame, {"nose": [x, y, confidence], ...})'
)
_SCORES = ("keypoint_scores", "keypoints_scores", "keypoint_score", "scores", "confidence")
_SCORE = ("score", "bbox_score", "confidence")
_BESIDE = ("frame", "time", "identity", "confidence")  # roles of lists that go with frames
_MAX_SIDE = 1_000_000  # pixels of an image; a larger number is no size
_WHOLE = 4096  # elements of a document up to which it may be a frame
_VIDEO = ("video_id", "vid_id", "video_name")
_NAMED_VIDEOS = 4  # that a finding names
_MOST_VIDEOS = 100  # that are told apart
_SEVERAL = 5  # arrays of objects that are frames, and no people of one
_COMPARED = 64  # entries by number that tell whether they are people or frames
_RATES = ("fps", "framerate", "videofps")


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
        self._unused = UnusedFields()
        self._odd_times: list[Any] = []
        self._last_name: Any = None  # of the frame before

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

    @property
    def names_frames(self) -> bool:
        """Whether objects or frames named their frame."""
        return "frame" in self._has

    def finish(self) -> None:
        """Add the frames without objects, and say what was not used, after the last document."""
        if not self.names_frames:  # where frames are named, those without a name have no place
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
        self._unused.tell(self._builder, self._has)

    def _read(self, items: Iterator[JsonItem], frame: DefaultFrame) -> str:
        """Read the items of a document; return as `read` does."""
        start: list[JsonItem] = []
        error: Exception | None = None
        try:
            for item in islice(items, _WHOLE):
                start += [item]  # one by one, so that an error leaves those before it
                if is_recording(item, frame.is_document):
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
        ends_early = any(is_recording(item, frame.is_document) for item in start)
        is_whole = len(start) < _WHOLE and not ends_early
        values = [value for _, value, _ in start]
        if not start or start[0].key is not None:
            fields = fields_of(start)
            if is_whole and self._document(fields, frame, is_cut):
                return ""
            frame = self._frame_beside(fields, frame)
        elif is_whole and are_coordinates(values) and are_numbers(values):
            self._person({"keypoints": values}, self._frame_of({}, frame))
            return ""
        return self._items(chain(start, items), series_in(start), frame)

    def _document(self, fields: Mapping[str, Any], frame: DefaultFrame, is_cut: bool) -> bool:
        """Read a document that is one frame, or one object; return False if it is neither."""
        if not fields:
            if frame.is_document and not is_cut:
                self._nobody.append(frame)
                return True
            return False
        if any(isinstance(fields.get(name), (list, dict)) for name in RECORDING):
            return False
        objects = object_fields(fields)
        keypoints = self._keypoint_fields(fields)
        if frame.is_document:
            if objects or keypoints or named_points(fields) or is_empty_frame(fields):
                return self._element(fields, frame, None)
            return False
        if objects:
            values = [each for name in objects for each in as_list(fields[name])]
            return not holds_frames(values) and self._element(fields, frame, None)
        if not keypoints:
            return bool(named_points(fields)) and self._element(fields, frame, None)
        field = keypoints[0]
        value = fields[field]
        if self._by_number(fields, value, frame):
            return True
        if people_in(value) >= _SEVERAL and not frame_field(fields) and not is_landmarks(field):
            for i, one in enumerate(objects_of(fields, field)):
                self._element(one, DefaultFrame(f"{frame.name} [{i}]", i), None)
            return True
        if isinstance(value, list) and any(map(has_keypoints, value)):
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
        if not any(map(people_by_id, value)):
            return False
        if all(isinstance(name, str) for name in names):
            self._builder.name_keypoints(names)
        for i, people in enumerate(value):
            index = self._builder.frame(f"{frame.name} [{i}]", number=i)
            for identity, points in people_by_id(people).items():
                turned = [[point[1], point[0], *point[2:]] for point in points]
                self._person({"keypoints": turned, "track_id": identity}, index)
        return True

    def _frame_beside(self, fields: Mapping[str, Any], frame: DefaultFrame) -> DefaultFrame:
        """Return the frame of the lists of a document, with what it says beside them."""
        if not frame.is_document or not frame_field(fields):
            return frame
        index = self._frame_of(fields, frame)
        self._time(fields, index)
        return frame._replace(known=index)

    def _rate(self, name: str, value: Any) -> None:
        """Take the frame rate that a recording says in a field, or in one in it."""
        if isinstance(value, dict):
            for inner, number in value.items():
                if letters(inner) in _RATES:
                    self._rate(inner, number)
        elif letters(name) in _RATES and isinstance(value, (int, float)):
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
            if key is not None and not is_element and not frame.is_document:
                self._rate(key, value)
            if key is not None and is_element and role(key) in _BESIDE:
                self._unused.look_at(key, value)
            if points and key != points_key:
                known |= self._array(points_key, points, frame)
                points = []
            if is_element and is_point_of(key, value):
                points.append(value)
                points_key = key
                continue
            inner = frame
            if is_element and is_frame(key, value, series, frame.is_document):
                # Frames without a name or number of their own follow one another.
                inner = DefaultFrame(f"{frame.name} [{elements}]", elements)
                has_frames |= bool(value)
            is_empty = value == {} and is_element and key not in ("images", "categories")
            if is_empty and not frame.is_document:
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
        are_landmarks = all(map(is_point, points))
        if not are_landmarks and not are_numbers(points):
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
        is_place = key is None or key in OBJECTS or is_landmarks(key)
        if value is None or value == []:
            if is_place:
                self._nobody.append(frame)
            return is_place or key in ("annotations", "instance_info")
        if key is None or key == "instance_info" or role(key) == "objects":
            if isinstance(value, dict) and not is_element and not has_keypoints(value):
                known = [self._item(k, each, False, frame) for k, each in value.items()]
                return any(known)  # {"frames": {"0": ...}}
            return self._element(value, frame, key)
        if role(key) in ("keypoints", "hands"):
            if isinstance(value, dict) and (frame_field(value) or has_keypoints(value)):
                return self._element(value, frame, key)
            if isinstance(value, list if is_element else dict):
                self._person({key: value}, self._frame_of({}, frame))
                return True
            return False
        if not isinstance(value, dict):
            return False
        if is_element and has_keypoints(value):
            if frame_field(value) and not identity_field(value):  # track -> its frames
                value = {**value, "track_id": key}
            return self._element(value, DefaultFrame(key), key)
        if object_fields(value) or not is_element and names_a_frame(key, value):
            return self._element(value, DefaultFrame(key), key)  # AlphaPose: image -> people
        return False

    def _element(self, value: Any, frame: DefaultFrame, key: str | None) -> bool:
        """Read an object, a frame, or the list of the objects of a frame."""
        if isinstance(value, list) and (are_numbers(value) or are_landmarks(value)):
            field = "keypoints" if are_numbers(value) else "landmarks"
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
            check_frame(value)
        except ValueError as error:
            self._builder.leave_out(str(error), f"{frame.name}: {value!r:.40}", is_loss=True)
            return True
        if objects := object_fields(value):
            self._frame(value, objects, frame)
            return True
        if points := named_points(value):
            index = self._frame_of(value, frame)
            self._time(value, index)
            self._person({**beside_points(value), "keypoints": points}, index)
            return True
        fields = self._keypoint_fields(value)
        if fields and is_landmarks(fields[0]):
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
        if is_empty_frame(value):
            self._time(value, self._frame_of(value, frame))
            return True
        if people := people_by_id(value):
            entries = {
                name: person if isinstance(person, dict) else {"keypoints": person}
                for name, person in people.items()
            }
            if not frame.is_document and self._is_one_object(entries.values()):
                for name, one in entries.items():  # identity -> frame -> object
                    self._element({"track_id": frame.name, **one}, DefaultFrame(name), key)
                return True
            index = self._frame_of({}, frame)
            for identity, one in entries.items():
                self._person({"track_id": identity, **one}, index)
            return True
        # Annotations of COCO are boxes of cars, too.
        if key != "annotations":
            names = ", ".join(value)[:60] or "nothing"
            self._builder.leave_out(f"{NO_KEYPOINTS}, but {names}{hint_of(value)}", frame.name)
        return key == "annotations"

    def _is_one_object(self, entries: Iterable[Mapping[str, Any]]) -> bool:
        """Return whether entries lie where the one before lies, as one object in frames does."""
        found: list[NDArray[np.float64]] = []
        for entry in islice(entries, _COMPARED):
            if fields := self._keypoint_fields(entry):
                with suppress(ValueError):
                    found.append(as_values(entry[fields[0]], None, self._expected))
        found = [each for each in found if each.shape == found[0].shape]
        return len(found) >= CROWD and overlap_in_turn(np.stack(found)[None]) > SAME_PLACE

    def _result(self, value: Mapping[str, Any], fields: list[str], frame: DefaultFrame) -> None:
        """Read a result of MediaPipe: the landmarks of a person, or those of each person."""
        index = self._frame_of(value, frame)
        self._time(value, index)
        for field in fields:
            people = value[field]
            if isinstance(people, list) and all(map(is_person, people)):
                for person in people:
                    self._person({field: person}, index)
            elif people is not None:  # null: nobody is seen
                self._person({**other_fields(value, fields), field: people}, index)

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
        people = [each for name in objects for each in as_list(value[name])]
        if not frame_field(value) and not any(map(names_its_frame, people)):
            value = with_number(value)
        if name := frame_field(value):
            # A video, a camera or a coordinate frame has the same name for each frame.
            is_weak = name == NUMBER or isinstance(value[name], str)
            is_repeated = is_weak and value[name] == self._last_name
            self._last_name = value[name]
            value = other_fields(value, [name]) if is_repeated else value
        if frame_field(value) or time_field(value):
            index = self._frame_of(value, frame)
            self._time(value, index)
            frame = frame._replace(known=index)
        elif not people and frame.known is None:
            self._nobody.append(frame)
        elif frame.known is None and not any(map(names_its_frame, people)):
            frame = frame._replace(known=self._frame_of({}, frame))
        self._unused.look(value, [*objects, NUMBER, *NUMBERS])
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
        found = next((n for n in KEYPOINTS if n in value and not are_texts(value[n])), "")
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
            for one in objects_of(person, field):
                self._one(one, field, frame)

    def _one(self, person: Mapping[str, Any], field: str, frame: int) -> None:
        """Add an object with keypoints in a field, or count what is wrong with it."""
        lists = (n for n in _SCORES if isinstance(person.get(n), list) and person[n])
        scores_field = next(lists, "")
        scores = person.get(scores_field)
        try:
            keypoints: Any = person.get(field)
            self._builder.is_mediapipe |= is_landmarks(field)
            if keypoints is None:
                raise ValueError(NO_KEYPOINTS)
            if isinstance(keypoints, dict) and isinstance(keypoints.get("landmark"), list):
                keypoints = keypoints["landmark"]  # of a message of protobuf
            if isinstance(keypoints, dict):
                keypoints = named_points(keypoints) or columns_of(keypoints)
                scores = None
            by_name = False
            if are_points(keypoints):
                by_name = self._have_names(keypoints)
                keypoints, scores = self._points(keypoints, by_name), None
                self._has.add("confidence")
            values = as_values(keypoints, scores, self._expected)
            if scores is None and (scores_field := confidence_field(person, values)):
                scores = person[scores_field]
                values = as_values(keypoints, scores, self._expected)
            values = at_their_places(values, person.get("labels"), self._expected)
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
            if identity_name not in IDENTITIES:
                self._builder.weak_identity = identity_name
        if role(field) == "hands" and is_landmarks(field) and identity is None:
            identity = next((side for side in ("left", "right") if side in letters(field)), None)
        score = next((s for n in _SCORE if (s := as_score(person.get(n))) is not None), None)
        category = person.get("category_id")
        category = category if isinstance(category, (int, str)) else None
        self._builder.is_coco |= category is not None and "image_id" in person
        self._unused.look(person, [field, scores_field, identity_name, *_SCORE])
        self._builder.add(frame, values, identity, score, category, by_name)

    def _have_names(self, points: list[Mapping[str, Any]]) -> bool:
        """Return whether points are told apart by their names; give the builder all names so far.

        Raises:
            ValueError: the objects so far have too many names.
        """
        names = [name_of(point) for point in points]
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
            confidence = next((point[n] for n in CONFIDENCE if n in point), 1.0)
            place = self._order[name_of(point)] if by_name else i
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

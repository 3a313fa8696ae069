# SPDX-License-Identifier: Apache-2.0
"""What the columns of a table mean, by the words of their names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

CONFIDENCE = (
    *("likelihood", "visibility", "score", "confidence", "conf", "presence", "v", "c", "s"),
    *("p", "prob", "probability", "certainty", "vis", "visible", "pres", "scores"),
)
"""Names of a keypoint's confidence; the first one that a keypoint has is used."""
COORDINATES = ("x", "y", "z", *CONFIDENCE)
"""Names of a keypoint's columns."""

_SURE = {
    *("likelihood", "score", "scores", "confidence", "conf", "prob", "probability", "certainty"),
    *("visibility", "visible", "vis", "presence"),
}
_FRAMES = ({"frame", "frames", "fnum"}, {"image", "images", "img", "imgs", "picture"}, {"file"})
"""Words of the frame, the surer ones first."""
_TRACKS = (
    {
        *("person", "people", "track", "tracks", "tracking", "tracker", "tracklet", "individual"),
        *("individuals", "animal", "animals", "subject", "player", "identity", "actor", "human"),
        *("participant", "pid", "tid", "skeleton", "mouse", "rat"),
    },
    {"body", "object", "obj", "target"},
    {"pose", "instance", "inst", "detection", "det"},
)
"""Words of an identity, the surer ones first."""
_POINTS = {
    *("landmark", "keypoint", "kp", "kpt", "joint", "bodypart", "bodyparts", "part", "node"),
    *("marker", "point"),
}
_OBJECTS = {*_TRACKS[1], *_TRACKS[2], "person", "bbox", "box", "detection", "det", "mean", "animal"}
_NUMBERED = {
    *("id", "ids", "idx", "index", "no", "num", "number", "nr", "name", "i", "n", "count"),
    *("counter", "key", "current", "source", "src", "the", "of", "label"),
}
_TIMES = {
    *("time", "timestamp", "timestamps", "stamp", "ts", "t", "datetime", "clock", "pts", "elapsed"),
}
UNIT_OF = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "seconds"),
    **dict.fromkeys(
        ("ms", "msec", "msecs", "millis", "millisecond", "milliseconds"), "milliseconds"
    ),
    **dict.fromkeys(
        ("us", "µs", "μs", "usec", "usecs", "micros", "microsecond", "microseconds"),
        "microseconds",
    ),
    **dict.fromkeys(
        ("ns", "nsec", "nsecs", "nanos", "nanosec", "nanosecs", "nanosecond", "nanoseconds"),
        "nanoseconds",
    ),
}
"""Words of units of time -> the unit."""
_OF_TIME = {
    *("frame", "video", "header", "unix", "utc", "epoch", "system", "camera", "cam", "recording"),
    *(
        "capture",
        "relative",
        "rel",
        "local",
        "since",
        "start",
        "in",
        "of",
        "device",
        "ros",
        "image",
    ),
    *("from", "the"),
}
_VIDEO = {"video", "videos", "clip", "movie", "camera", "cam", "view"}
_OF_VIDEO = {*_NUMBERED, "file", "path", "filename"}
_GLUED = ("frame", "image", "img", "track", "person", "landmark", "keypoint", "joint", "body")
_USUAL = {
    *("bbox", "box", "rect", "roi", "area", "class", "cls", "category", "scorer", "width"),
    *("height", "w", "h", "iscrowd", "unnamed", "ncams", "error"),
}
"""Words of columns that never matter here."""
_BOXES = {"bbox", "box", "rect", "roi", "crop"}
_UNIT = re.compile(r"(.*?)[\s_.]*(?:[\[(]\s*([^\])]*?)\s*[\])]|[_ ](px|pix|pixels?))\s*")
_SHOWN = 4
_FEW = 4  # keypoints, fewer of which are no individual of their own


def words(name: str) -> list[str]:
    """Return the words of a name in small letters: ["frame", "number"] of frameNumber."""
    spaced = re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", name).lower()
    found: list[str] = []
    for word in re.split(r"[^a-z0-9µμ]+", spaced):
        head = next((head for head in _GLUED if word.startswith(head)), "")
        rest = word[len(head) :]
        glued = head and rest in {*_NUMBERED, "path", "part", "filename"}
        found += [head, rest] if glued else [word]
    return [word for word in found if word]


@dataclass(frozen=True)
class Columns:
    """Columns by what they mean; None or () for what a table does not have.

    Attributes:
        frame: of the frame's number or name.
        time: of its time: one column, or those of its seconds and nanoseconds.
        unit: of the time, a key of `builder.UNITS`; "" = the name does not say it.
        identities: of a person or animal, the surest one first.
        score: of the object's score.
        keypoint: of the keypoint's name, in a table with a keypoint a row.
        x, y, z, confidence: of the keypoint, in such a table.
        video: of the video.
        unused: of what is not used and may matter.
    """

    frame: int | None = None
    time: tuple[int, ...] = ()
    unit: str = ""
    identities: tuple[int, ...] = ()
    score: int | None = None
    keypoint: int | None = None
    x: int | None = None
    y: int | None = None
    z: int | None = None
    confidence: int | None = None
    video: int | None = None
    unused: tuple[int, ...] = field(default=())


def find_columns(head: Sequence[str], taken: Iterable[int], *, has_points: bool) -> Columns:
    """Return what the columns of a table mean.

    Args:
        head: names of the columns.
        taken: columns that are those of keypoints.
        has_points: a row is a keypoint, with columns x and y; else it is an object or a frame.
    """
    free = {i: words(name) for i, name in enumerate(head)}
    for i in taken:
        free.pop(i, None)
    used: set[int | None] = set()

    def best(ranks: Mapping[int, int | None]) -> list[int]:
        """Return columns by rank, and those of a rank in the table's order."""
        known = {i: rank for i, rank in ranks.items() if rank is not None and i not in used}
        return sorted(known, key=lambda i: (known[i], i))

    def first(ranks: Mapping[int, int | None]) -> int | None:
        found = next(iter(best(ranks)), None)
        used.add(found)
        return found

    x = y = z = confidence = keypoint = None
    if has_points:
        x, y, z = (first({i: 0 for i in free if without_unit(head[i]).lower() == c}) for c in "xyz")
        keypoint = first({i: _rank_of_point(each) for i, each in free.items()})
        ranks = {i: _rank_of_confidence(each, _POINTS) for i, each in free.items()}
        confidence = first(ranks)
    clocks = [i for i, each in free.items() if i not in used and is_time(each)]
    time = tuple(clocks[:1])
    for i in clocks[1:]:
        if time and _is_pair(free[time[0]], free[i]):
            time = (*time[:1], i)
    used.update(clocks)
    video = first({i: _rank_of_video(each) for i, each in free.items()})
    frame = first({i: _rank_of_frame(each) for i, each in free.items()})
    identities = best({i: _rank_of_identity(each) for i, each in free.items()})
    used.update(identities)
    score = first({i: _rank_of_confidence(each, _OBJECTS) for i, each in free.items()})
    unit = next((UNIT_OF[word] for word in free[time[0]] if word in UNIT_OF), "") if time else ""
    unused = [
        i for i, each in free.items() if i not in used and each and not _is_usual(each, has_points)
    ]
    return Columns(
        frame,
        time,
        unit,
        tuple(identities),
        score,
        keypoint,
        x,
        y,
        z,
        confidence,
        video,
        tuple(unused),
    )


def _is_usual(name: Sequence[str], has_points: bool) -> bool:
    """Return whether a name is one of those that never matter here."""
    known = {*_USUAL, *(CONFIDENCE if has_points else ())}
    is_of_track = {"track", "tracking"} & set(name) and "score" in name
    return bool(known & set(name)) or bool(is_of_track) or name == ["index"]


def is_time(name: Sequence[str]) -> bool:
    """Return whether words are those of a time."""
    found = set(name)
    if not found <= {*_TIMES, *UNIT_OF, *_OF_TIME}:
        return False
    return bool(found & _TIMES) or bool({w for w in found if w in UNIT_OF and len(w) > 2})


def _is_pair(first: Sequence[str], second: Sequence[str]) -> bool:
    """Return whether two times are seconds and the nanoseconds beside them."""
    units = [
        next((UNIT_OF[word] for word in name if word in UNIT_OF), "") for name in (first, second)
    ]
    rest = [[word for word in name if word not in UNIT_OF] for name in (first, second)]
    return units == ["seconds", "nanoseconds"] and rest[0] == rest[1]


def _rank_of_frame(name: Sequence[str]) -> int | None:
    found = set(name)
    if "filename" in found:
        found = found - {"filename"} | {"file"}
    known = {*_NUMBERED, *_VIDEO, "path"}.union(*_FRAMES)
    if not found <= known:
        return None
    return next((rank for rank, heads in enumerate(_FRAMES) if found & heads), None)


def _rank_of_video(name: Sequence[str]) -> int | None:
    found = set(name)
    return 0 if found & _VIDEO and found <= {*_VIDEO, *_OF_VIDEO} else None


def _rank_of_identity(name: Sequence[str]) -> int | None:
    found = set(name)
    if name == ["id"]:
        return len(_TRACKS)
    if not found <= _NUMBERED.union(*_TRACKS):
        return None
    return next((rank for rank, heads in enumerate(_TRACKS) if found & heads), None)


def _rank_of_point(name: Sequence[str]) -> int | None:
    found = set(name)
    if found & _POINTS and found <= {*_POINTS, *_NUMBERED, "body"}:
        return 0
    return {"name": 1, "index": 2, "id": 3}.get(" ".join(name))


def _rank_of_confidence(name: Sequence[str], of: set[str]) -> int | None:
    """Return the rank of a confidence or score of some things; None if it is none of them."""
    found = set(name)
    plain = [word for word in name if word in CONFIDENCE]
    if len(plain) != 1 or not found <= {*CONFIDENCE, *of}:
        return None
    if plain[0] not in _SURE and of is not _POINTS:
        return None
    return CONFIDENCE.index(plain[0])


def without_unit(cell: str) -> str:
    """Return the name of a column without the unit behind it: nose_x of nose_x [px].

    A coordinate in brackets is no unit: nose_x of nose (x).
    """
    found = _UNIT.fullmatch(cell)
    if not found or not found[1]:
        return cell.strip()
    inner = found[2] or ""
    return f"{found[1]}_{inner}" if inner.lower() in COORDINATES else found[1].strip()


def unit_of(cell: str) -> str:
    """Return the unit of length in brackets behind the name of a column; "" for none and px."""
    found = _UNIT.fullmatch(cell)
    unit = (found[2] or "").lower() if found else ""
    return unit if unit in ("mm", "cm", "m", "meter", "metre", "meters", "metres") else ""


@dataclass(frozen=True)
class Part:
    """A keypoint of a table with a column for each coordinate.

    Attributes:
        individual: of whom it is; "" where there is one only.
        name: of the keypoint.
        at: coordinate or confidence -> column.
    """

    individual: str
    name: str
    at: Mapping[str, int]

    @property
    def is_complete(self) -> bool:
        """Whether it has x and y."""
        return "x" in self.at and "y" in self.at


def find_parts(head: Sequence[str]) -> list[Part]:
    """Return the keypoints that the names of columns say: nose_x, x_nose, x0, noseX, ..."""
    names = [_plain(cell) for cell in head]
    for split in (_split, _split_glued):
        places: dict[tuple[str, str], dict[str, int]] = {}
        for i, name in enumerate(names):
            if found := split(name):
                individual, part, coordinate = found
                if words(part)[-1:] and words(part)[-1] in _BOXES:
                    continue
                places.setdefault((individual, part), {}).setdefault(coordinate, i)
        _join_confidences(places)
        parts = [Part(*key, at) for key, at in places.items()]
        if any(part.is_complete for part in parts):
            return _of_individuals(parts, names)
    return []


def _plain(cell: str) -> str:
    """Return the name of a column without unit, and of a tuple of pandas with underscores."""
    if cell.startswith("(") and (labels := re.findall(r"'([^']*)'|\"([^\"]*)\"", cell)):
        return "_".join(one or other for one, other in labels[-2:])
    return without_unit(cell)


def _split(cell: str) -> tuple[str, str, str] | None:
    """Return individual, keypoint and coordinate of nose_x, x_nose, x0 or x_0."""
    low = cell.lower().replace(" ", "_")
    after = re.fullmatch(r"(.+)[_. :-]([A-Za-z]+)", cell)
    before = re.fullmatch(r"([a-z]+)_?(\d+)", low)
    prefix = re.fullmatch(r"([A-Za-z]+)[_. :-](.+)", cell)
    if after and after[2].lower() in COORDINATES:
        return "", after[1], after[2].lower()
    if before and before[1] in COORDINATES:
        return "", before[2], before[1]
    if prefix and prefix[1].lower() in COORDINATES:
        return "", prefix[2], prefix[1].lower()
    return None


def _split_glued(cell: str) -> tuple[str, str, str] | None:
    """Return individual, keypoint and coordinate of noseX, noseScore or nose_x_0."""
    among = re.fullmatch(r"(.+)[_. :-]([A-Za-z]+)[_. :-]?(\d+)", cell)
    if among and among[2].lower() in COORDINATES:
        return among[3], among[1], among[2].lower()
    glued = re.fullmatch(r"(.*[A-Za-z0-9])([XYZPCVS]|[A-Z][a-z]+)", cell)
    if glued and glued[2].lower() in COORDINATES:
        return "", glued[1].rstrip("_. -"), glued[2].lower()
    return None


def _join_confidences(places: dict[tuple[str, str], dict[str, int]]) -> None:
    """Give a keypoint the confidence that has one more word: nose_kp_score of nose_x, nose_y."""
    for individual, part in list(places):
        own = places[individual, part]
        shorter = re.sub(r"[_. -](kp|kpt|keypoint|point|joint|landmark)$", "", part)
        at = places.get((individual, shorter), {})
        if shorter != part and not {"x", "y"} & set(own) and {"x", "y"} <= set(at):
            if not set(CONFIDENCE) & set(at):
                at.update(own)
            del places[individual, part]


def _of_individuals(parts: list[Part], names: Sequence[str]) -> list[Part]:
    """Return the parts with the individuals that their names begin with: person1_nose, inst0.nose.

    They are individuals only if all have the same keypoints.
    """
    whole = [part for part in parts if part.is_complete]
    if any(part.individual for part in whole):  # nose_x_0, nose_x_1
        if len({part.name for part in whole}) >= _FEW:
            return whole
        return [Part("", f"{part.name}{part.individual}", part.at) for part in whole]
    splits = []
    for part in whole:
        dotted = re.fullmatch(r"([^.]+)\.(.+)", part.name)
        is_track = dotted and any(f"{dotted[1]}.{c}" in names for c in ("track", "score"))
        numbered = re.fullmatch(r"([A-Za-z]+)[_ ]?(\d+)[_. :-](.+)", part.name)
        known = {"id", "ind", "p"}.union(*_TRACKS)
        if dotted and is_track:
            splits.append((dotted[1], dotted[2]))
        elif numbered and numbered[1].lower() in known:
            splits.append((part.name[: numbered.start(3) - 1], numbered[3]))
        else:
            return parts
    of_each: dict[str, set[str]] = {}
    for individual, name in splits:
        of_each.setdefault(individual, set()).add(name)
    most = max(of_each.values(), key=len)
    if len(most) < _FEW or set.union(*of_each.values()) != most:
        return parts
    return [
        Part(individual, name, part.at)
        for part, (individual, name) in zip(whole, splits, strict=True)
    ]

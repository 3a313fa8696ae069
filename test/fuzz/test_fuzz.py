"""Whatever comes in from outside is read or refused, and what comes after is lifted as before.

`make fuzz` gives each class 100000 inputs and prints what became of them; here it is 200. An input
follows from its number alone, so a failure can be looked at again: FUZZ_FIRST=number.
"""

from __future__ import annotations

import json
import os
import random
import resource
import struct
import tracemalloc
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import apsw
import numpy as np
import pytest
from rclpy.parameter import Parameter
from rosbags.typesys import Stores, get_typestore

from deep_nrsfm_ros.configuration import options
from deep_nrsfm_ros.node import parameters as ros_parameters
from deep_nrsfm_ros.node.fence import Fence
from deep_nrsfm_ros.node.lifter import LifterNode
from deep_nrsfm_ros.node.parameters import name_of
from deep_nrsfm_ros.node.pipeline import InputOptions, Pipeline
from deep_nrsfm_ros.node.training_job import parse_progress
from deep_nrsfm_ros.node.training_request import TrainingOptions, fenced
from deep_nrsfm_ros.node.unfinished import look, record_file
from deep_nrsfm_ros.nrsfm.keypoints import KeypointLayout
from deep_nrsfm_ros.nrsfm.lifting import Lifted, LiftingOptions
from deep_nrsfm_ros.nrsfm.limits import Limits
from deep_nrsfm_ros.nrsfm.model_file import Model, ModelFileError, load_model, save_model
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normaliser import Normaliser
from deep_nrsfm_ros.nrsfm.object_file import ObjectFileError, read_object
from deep_nrsfm_ros.nrsfm.recipe import Recipe
from deep_nrsfm_ros.nrsfm.steadying import SteadyingOptions
from deep_nrsfm_ros.observations import bags
from deep_nrsfm_ros.observations.bags import BagError, frames, read_bags, write_bag
from deep_nrsfm_ros.observations.curation import Curation
from deep_nrsfm_ros.observations.messages import MULTI_ARRAY, POINT_CLOUD, POLYGON, read

INPUTS = int(os.environ.get("FUZZ", "200"))
FIRST = int(os.environ.get("FUZZ_FIRST", "0"))
P = 6
MB = 2**20
SIZES = (
    0,
    1,
    2,
    3,
    4,
    5,
    P,
    P + 1,
    16,
    100,
    -1,
    -7,
    255,
    65535,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**63,
)
NUMBERS = (0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 1e-45, 1e9, 3e38, 1e308, -1e30)
WORDS = ("", "x", "y", "confidence", "a" * 300, "é\ud800", "../..", "\0", "%s{}", "nan", "1e999")
STORE = get_typestore(Stores.ROS2_JAZZY)
KINDS = (POINT_CLOUD, MULTI_ARRAY, POLYGON)
NAMES = ("left", "right", "up", "front", "tip", "tail")
LAYOUT = KeypointLayout("thing", NAMES, (("left", "right"),), (NAMES[:4],), ("up", "tip"))

Outcome = str
Input = Callable[[random.Random], Outcome]


def model() -> Model:
    network = initialise(Architecture(widths=(8, 4)), P, np.random.default_rng(0))
    return Model("thing", network, LAYOUT, Normaliser(), np.eye(3, dtype=np.float32))


def message(kind: str) -> Any:
    """Return a valid message of the type `kind`, as rosbags has it."""
    points = np.random.default_rng(0).uniform(50, 600, (1, P, 2))
    return bags._ENCODERS[kind](next(frames(points, np.ones((1, P)))))


def lift(pipeline: Pipeline, message: Any, kind: str) -> Lifted:
    seen = pipeline.observe(message, kind)
    if not len(seen.confidence):
        raise ValueError("no object, which is no error and no answer either")
    return pipeline.lift(seen, None, ("one",) * len(seen.confidence), "topic", 0.0)[0]


def loose(value: Any) -> Any:
    """Return a message whose fields take anything."""
    if hasattr(value, "__dataclass_fields__"):
        fields = value.__dataclass_fields__
        return SimpleNamespace(**{name: loose(getattr(value, name)) for name in fields})
    return [loose(item) for item in value] if isinstance(value, list) else value


def places(value: Any) -> list[tuple[Any, Any]]:
    """Return every (container, key) inside a loose message."""
    if isinstance(value, SimpleNamespace):
        own = [(value.__dict__, name) for name in value.__dict__]
    elif isinstance(value, list):
        own = [(value, i) for i in range(len(value))]
    elif isinstance(value, dict):
        own = [(value, key) for key in value]
    else:
        return []
    return own + [place for container, key in own for place in places(container[key])]


def spoil_bytes(rng: random.Random, data: bytes) -> bytes:
    """Return bytes cut off, lengthened, with bits flipped, runs replaced or parts moved."""
    spoilt = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 5, 30))):
        at, run = rng.randrange(len(spoilt) + 1), rng.choice((1, 1, 2, 4, 8, 40))
        what = rng.randrange(6)
        if what == 0:
            del spoilt[at:]
        elif what == 1:
            spoilt[at : at + run] = rng.randbytes(run)
        elif what == 2:
            spoilt[at : at + 4] = struct.pack("<q", rng.choice(SIZES) % 2**32)[:4]
        elif what == 3:
            spoilt[at:at] = rng.randbytes(run)
        elif what == 4:
            del spoilt[at : at + run]
        elif at < len(spoilt):
            spoilt[at] ^= 1 << rng.randrange(8)
    return bytes(spoilt)


def anything(rng: random.Random, old: Any) -> Any:
    """Return something in the place of `old`: often alike, sometimes of another type."""
    if rng.random() < 0.15:
        return rng.choice((None, [], {}, "x", 1.5, -1, True, b"\0", object()))
    if isinstance(old, bool):
        return not old
    if isinstance(old, int):
        return rng.choice(SIZES)
    if isinstance(old, float):
        return rng.choice(NUMBERS)
    if isinstance(old, str):
        return rng.choice(WORDS)
    if isinstance(old, np.ndarray):
        if old.dtype == np.uint8:
            return np.frombuffer(spoil_bytes(rng, old.tobytes()), np.uint8)
        new = np.resize(old, rng.choice((0, 1, max(old.size - 1, 0), old.size + 1, old.size, 5000)))
        for _ in range(rng.randrange(1 + min(len(new), 4))):
            new[rng.randrange(len(new))] = np.float64(rng.choice(NUMBERS)).astype(old.dtype)
        return new
    if isinstance(old, list):
        return rng.choice(([], old[1:], old * 2, old[::-1], old[:1] * 300))
    return None


def spoil(rng: random.Random, value: Any) -> None:
    """Change a loose message in a few places."""
    for _ in range(rng.choice((1, 1, 2, 3, 6))):
        spots = places(value)
        container, key = rng.choice(spots)
        with np.errstate(all="ignore"):
            container[key] = anything(rng, container[key])


def live(kind: str) -> Input:
    """Spoil a message and lift it: only ValueError may come of it, and no trace may stay."""
    pipeline = Pipeline(
        model(), None, InputOptions(input_type=kind), LiftingOptions(), SteadyingOptions()
    )
    plain = LiftingOptions(correction="none", refill=0, turns=1)
    quick = Pipeline(model(), None, InputOptions(input_type=kind), plain, SteadyingOptions())
    valid, expected = message(kind), lift(pipeline, message(kind), kind)

    def one(rng: random.Random) -> Outcome:
        spoilt = loose(valid)
        spoil(rng, spoilt)
        try:
            lifted = lift(pipeline if rng.random() < 0.1 else quick, spoilt, kind)
        except ValueError as refusal:
            assert str(refusal)
            outcome = "refused"
        else:
            assert len(lifted.shapes) <= 100
            outcome = "lifted"
        if rng.random() < 0.02:
            for old, new in zip(expected, lift(pipeline, valid, kind), strict=True):
                np.testing.assert_array_equal(old, new)
        return outcome

    return one


def serialised() -> Input:
    """Spoil the bytes of a message as they are on the wire."""
    kinds = [*KINDS]
    names = {kind: kind.replace("/", "/msg/") for kind in kinds}
    raws = {k: bytes(STORE.serialize_cdr(message(k), names[k])) for k in kinds}

    def one(rng: random.Random) -> Outcome:
        kind = rng.choice(kinds)
        raw = spoil_bytes(rng, raws[kind])
        try:
            came = STORE.deserialize_cdr(raw, names[kind])
        except Exception:  # what bags.py does with it too
            return "undecodable"
        try:
            read(came, kind, P)
        except ValueError:
            return "refused"
        return "read"

    return one


def bag(folder: Path) -> Input:
    """Spoil a file of a bag: mostly the data, as metadata.yaml takes long to read."""
    wholes = {}
    for storage in ("sqlite3", "mcap"):
        path = folder / storage
        points = np.random.default_rng(0).uniform(50, 600, (3, P, 2))
        write_bag(path, "/k", frames(points, np.ones((3, P))), storage)
        wholes[storage] = {file.name: file.read_bytes() for file in path.iterdir()}

    def one(rng: random.Random) -> Outcome:
        storage = rng.choice([*wholes])
        path, whole = folder / storage, wholes[storage]
        data, metadata = sorted(whole, key=lambda name: name.endswith(".yaml"))
        with_metadata = rng.random() < 0.02
        name = rng.choice((data, metadata)) if with_metadata else data
        (path / name).write_bytes(spoil_bytes(rng, whole[name]))
        try:
            reading = read_bags(
                [path if with_metadata else path / data], "", LAYOUT, LAYOUT, max_frames=1000
            )
            assert len(reading.ensemble) <= 1000
        except BagError as refusal:
            assert str(refusal)
            return "refused"
        finally:
            (path / name).write_bytes(whole[name])
            for connection in apsw.connections():  # rosbags leaves one open for each file
                connection.close()
        return "read in part" if reading.warnings or reading.unreadable else "read"

    return one


def object_file(folder: Path) -> Input:
    """Spoil the text of an object file, or what it says."""
    root = Path(__file__).resolve().parents[2]
    texts = [p.read_bytes() for p in (root / "config" / "objects").glob("*.yaml")]
    texts.append(b"name: t\nkeypoints: [a, b, c, d]\nedges: [[a, b]]\nreference: [a, b]\n")
    bits = (b"*a", b"&a", b"!!int ''", b"<<: ", b"[", b"{", b"? ", b": ", b"\n- ", b"'", b"\x00",
            b"0x", b"2001-01-01", b"!!binary x", b".nan", b"1e999", b"~", b"|", b"\t")  # fmt: skip

    def one(rng: random.Random) -> Outcome:
        text = rng.choice(texts[-1:] * 8 + texts)
        text = spoil_bytes(rng, text) if rng.random() < 0.5 else text
        for _ in range(rng.randrange(4)):
            at = rng.randrange(len(text) + 1)
            text = text[:at] + rng.choice(bits) + text[at:]
        file = folder / "object.yaml"
        file.write_bytes(text)
        try:
            return f"read {'with' if read_object(file).edges else 'without'} edges"
        except ObjectFileError as refusal:
            assert "object.yaml" in str(refusal)
            return "refused"

    return one


def model_file(folder: Path) -> Input:
    """Spoil the bytes of a model file, or the values of its header; what loads must lift."""
    save_model(folder / "whole.safetensors", model())
    whole = (folder / "whole.safetensors").read_bytes()
    length = int.from_bytes(whole[:8], "little")
    header = json.loads(whole[8 : 8 + length])
    said = json.loads(header["__metadata__"]["model"])
    valid = message(POINT_CLOUD)

    def one(rng: random.Random) -> Outcome:
        content = spoil_bytes(rng, whole)
        if rng.random() < 0.7:
            changed = json.loads(json.dumps(said))
            spoil(rng, changed)
            head = {**header, "__metadata__": {**header["__metadata__"]}}
            try:
                head["__metadata__"]["model"] = json.dumps(changed)
            except TypeError:  # nothing that JSON has
                return "not written"
            text = json.dumps(head).encode()
            content = len(text).to_bytes(8, "little") + text + whole[8 + length :]
        file = folder / "spoilt.safetensors"
        file.write_bytes(content)
        try:
            loaded = load_model(file)
        except ModelFileError as refusal:
            assert "spoilt" in str(refusal)
            return "refused"
        try:
            lift(
                Pipeline(loaded, None, InputOptions(), LiftingOptions(), SteadyingOptions()),
                valid,
                POINT_CLOUD,
            )
        except ValueError:
            return "loaded, does not fit"
        return "loaded, lifts"

    return one


def training(folder: Path) -> Input:
    """Spoil what a training process says, and the record that it leaves."""
    line = b'{"state": "training", "step": 3, "steps": 9, "loss": 0.5, "seconds_left": 7, "a": [1]}'

    def one(rng: random.Random) -> Outcome:
        text = spoil_bytes(rng, line) if rng.random() < 0.9 else b"[" * rng.randrange(60000)
        record_file(folder, "mine").write_bytes(text)
        progress, found = parse_progress(text.decode(errors="replace")), look(folder, "mine")
        assert found is None or str(found) and found.advice
        return "progress" if progress else "words"

    return one


def parameters(folder: Path) -> Input:
    """Set parameters to anything of their type, as the lifter considers it; ask for a training."""
    save_model(folder / "thing.safetensors", model())
    (folder / "link.safetensors").symlink_to("/etc/passwd")
    inputs = InputOptions(model="thing", models_dir=str(folder), bags_dir=str(folder))
    stub = SimpleNamespace(get_parameter_or=lambda name, default: default)
    stub._fence = Fence(folder, folder, ["thing"])
    stub._pipeline = Pipeline(model(), None, inputs, LiftingOptions(), SteadyingOptions())
    stub._prepare = lambda changes: LifterNode._prepare(stub, changes)
    valid = message(POINT_CLOUD)
    expected = lift(stub._pipeline, valid, POINT_CLOUD)
    known = [(c, "") for c in (InputOptions, LiftingOptions)]
    known += [(c, "train.") for c in (TrainingOptions, Recipe, Limits, Curation)]
    defaults = [(name_of(f, prefix), f.default) for c, prefix in known for f, _, _ in options(c)]
    bits = (*WORDS, "thing", "link", "link.safetensors", "/etc/passwd", "~", "~x/y.yaml", "coco17",
            "model", "thing.safetensors", "../" * 9, "numbered", "a.yaml", "x" * 5000)  # fmt: skip

    def value(rng: random.Random, default: Any) -> Any:
        if isinstance(default, bool):
            return rng.random() < 0.5
        if isinstance(default, int):
            return max(-(2**63), min(rng.choice(SIZES), 2**63 - 1))
        if isinstance(default, float):  # of dynamic type
            return rng.choice((*NUMBERS, 0.5, 3, -1, True, "x", ["x"]))
        words = [rng.choice(("", "/")).join(rng.choices(bits, k=rng.choice((1, 1, 2, 3))))
                 for _ in range(rng.randrange(1, 4))]  # fmt: skip
        return words if isinstance(default, tuple) else words[0]

    def one(rng: random.Random) -> Outcome:
        chosen = rng.choices(defaults, k=rng.choice((1, 1, 2, 5)))
        changes = [Parameter(name, value=value(rng, default)) for name, default in chosen]
        result = LifterNode._consider(stub, changes)
        assert result.successful != bool(result.reason)
        assert "internal error" not in result.reason, result.reason
        given = {change.name: change.value for change in changes}
        stub.get_parameter_or = lambda name, default: (
            Parameter(name, value=given[name]) if name in given else default
        )
        try:
            fenced(ros_parameters.read(stub, TrainingOptions, "train."), stub._fence)
        except (ValueError, OSError) as refusal:
            assert str(refusal)
        finally:
            stub.get_parameter_or = lambda name, default: default
        if rng.random() < 0.02:
            for old, new in zip(expected, lift(stub._pipeline, valid, POINT_CLOUD), strict=True):
                np.testing.assert_array_equal(old, new)
        return "accepted" if result.successful else "refused"

    return one


def classes(folder: Path) -> dict[str, Callable[[], Input]]:
    cases: dict[str, Callable[[], Input]] = {k: lambda k=k: live(k) for k in KINDS}  # type: ignore[misc]
    return cases | {
        "serialised message": serialised,
        "bag": lambda: bag(folder),
        "object file": lambda: object_file(folder),
        "model file": lambda: model_file(folder),
        "training": lambda: training(folder),
        "parameters": lambda: parameters(folder),
    }


@pytest.mark.timeout(0 if INPUTS > 1000 else 180)
@pytest.mark.parametrize("name", classes(Path()))
def test_anything_is_read_or_refused(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, outcomes = classes(tmp_path)[name](), Counter[str]()
    before, traced = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, INPUTS <= 1000
    if traced:
        tracemalloc.start()
        tracemalloc.reset_peak()  # of a class that failed before
    for number in range(FIRST, FIRST + INPUTS):
        try:
            outcomes[one(random.Random(number))] += 1
        except Exception as problem:
            raise AssertionError(f"input {number} of {name}: {problem!r}") from problem
    peak = tracemalloc.get_traced_memory()[1] / MB if traced else 0.0
    tracemalloc.stop()
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    said = ", ".join(f"{count} {what}" for what, count in outcomes.most_common())
    with capsys.disabled():
        if not traced:
            print(f"\n{name}: {INPUTS} inputs: {said}; memory grew by {grown:.0f} MB")
    assert sum(outcomes.values()) == INPUTS and len(outcomes) > 1
    # An mcap record may claim terabytes: asked for, never touched, and given back.
    assert max(0 if name == "bag" else peak, grown) < 100

# SPDX-License-Identifier: Apache-2.0
"""Files of every kind are read or refused."""

from __future__ import annotations

import gzip
import io
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import apsw
import numpy as np

from deep_nrsfm_ros.data import bags
from deep_nrsfm_ros.data.bag_files import BagError
from deep_nrsfm_ros.data.bags import frames, read_bags, write_bag
from deep_nrsfm_ros.data.keypoint_files import KeypointFileError, read_keypoints
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.layout_file import LayoutFileError, read_layout
from deep_nrsfm_ros.messages.decoding import POINT_CLOUD
from deep_nrsfm_ros.messages.mapping_file import MappingError, read_mapping
from deep_nrsfm_ros.model_files.model_file import ModelFileError, load_model, save_model
from test.fuzz.conftest import Bench, Fuzz, Spoiler

ROOT = Path(__file__).resolve().parents[2]
YAML = (b"*a", b"&a", b"!!int ''", b"<<: ", b"[", b"{", b"? ", b": ", b"\n- ", b"'", b"\x00",
        b"0x", b"2001-01-01", b"!!binary x", b".nan", b"1e999", b"~", b"|", b"\t")  # fmt: skip
JSON = (b"[", b"{", b"]", b"}", b",", b":", b'"', b"NaN", b"1e999", b"-Infinity", b"null", b"\xff",
        b"[" * 3000, b'{"people": []}', b"9" * 5000)  # fmt: skip

CSV = (b",", b";", b"\n", b'"', b"#", b"sep=;\n", b"nan", b"1e999", b"-", b"x", b"frame", b"\xff",
       b"\x00", b"9" * 30, b"0.5", b"10:00:00", b"(", b"[px]", b"a/b", b"\t")  # fmt: skip


def views(f: int, p: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(50, 600, (f, p, 2))


def test_a_bag_is_read_or_refused(bench: Bench, fuzz: Fuzz, tmp_path: Path) -> None:
    """Mostly its data is spoilt, as metadata.yaml takes long to read."""
    wholes, layout = {}, bench.layout
    for storage in ("sqlite3", "mcap"):
        p = len(layout)
        write_bag(tmp_path / storage, "/k", frames(views(3, p), np.ones((3, p))), storage)
        wholes[storage] = {file.name: file.read_bytes() for file in (tmp_path / storage).iterdir()}

    def one(spoiler: Spoiler) -> str:
        storage = spoiler.choice([*wholes])
        path, whole = tmp_path / storage, wholes[storage]
        data, metadata = sorted(whole, key=lambda name: name.endswith(".yaml"))
        with_metadata = spoiler.random() < 0.02
        name = spoiler.choice((data, metadata)) if with_metadata else data
        (path / name).write_bytes(spoiler.spoil_bytes(whole[name]))
        try:
            named = [path if with_metadata else path / data]
            reading = read_bags(named, layout, layout, ReadOptions(max_frames=1000))
            assert len(reading.dataset) <= 1000
        except BagError as refusal:
            assert str(refusal)
            return "refused"
        finally:
            (path / name).write_bytes(whole[name])
            for connection in apsw.connections():  # rosbags leaves one open for each file
                connection.close()
        return "read in part" if reading.warnings or reading.unreadable else "read"

    # An mcap record may claim terabytes: asked for, never touched, and given back.
    fuzz("bag", one, touched=False)


def test_a_layout_file_is_read_or_refused(fuzz: Fuzz, tmp_path: Path) -> None:
    texts = [p.read_bytes() for p in (ROOT / "config" / "layouts").glob("*.yaml")]
    texts.append(b"name: t\nkeypoints: [a, b, c, d]\nedges: [[a, b]]\nreference: [a, b]\n")
    file = tmp_path / "object.yaml"

    def one(spoiler: Spoiler) -> str:
        text = spoiler.choice(texts[-1:] * 8 + texts)
        file.write_bytes(spoiler.spoil_text(text, YAML))
        try:
            return f"read {'with' if read_layout(file).edges else 'without'} edges"
        except LayoutFileError as refusal:
            assert "object.yaml" in str(refusal)
            return "refused"

    fuzz("layout file", one)


def test_a_mapping_file_is_read_or_refused_and_what_is_read_reads_messages(
    bench: Bench, fuzz: Fuzz, tmp_path: Path
) -> None:
    texts = [p.read_bytes() for p in (ROOT / "config" / "mappings").glob("*.yaml")]
    texts.append(
        b"type: a/B\nobjects: found\nidentity: number\nkeypoints: joints\nx: place.u\ny: place.v\n"
        b"confidence: sure\nkeypoint_id: which\nfirst_id: 0\nmissing: -1\nunits: pixels\n"
    )
    p, file = len(bench.layout), tmp_path / "mapping.yaml"
    joints = [
        SimpleNamespace(which=i, sure=0.9, place=SimpleNamespace(u=u, v=v))
        for i, (u, v) in enumerate(views(1, p)[0].tolist())
    ]
    some = SimpleNamespace(found=[SimpleNamespace(number=7, joints=joints)])
    pipeline = bench.pipeline(quick=True)

    def one(spoiler: Spoiler) -> str:
        file.write_bytes(spoiler.spoil_text(spoiler.choice(texts[-1:] * 8 + texts), YAML))
        try:
            mapping = read_mapping(file)
        except MappingError as refusal:
            assert "mapping.yaml" in str(refusal)
            return "refused"
        try:
            bench.lift(pipeline, some, mapping)
        except ValueError as refusal:
            assert str(refusal)
            return "read, fits no message"
        return "read, lifts"

    fuzz("mapping file", one)


def test_a_model_file_is_read_or_refused_and_what_is_read_lifts(
    bench: Bench, fuzz: Fuzz, tmp_path: Path
) -> None:
    save_model(tmp_path / "whole.safetensors", bench.model)
    whole = (tmp_path / "whole.safetensors").read_bytes()
    length, p = int.from_bytes(whole[:8], "little"), len(bench.layout)
    header = json.loads(whole[8 : 8 + length])
    said = json.loads(header["__metadata__"]["model"])
    valid = bags._ENCODERS[POINT_CLOUD](next(frames(views(1, p), np.ones((1, p)))))
    file = tmp_path / "spoilt.safetensors"

    def one(spoiler: Spoiler) -> str:
        content = spoiler.spoil_bytes(whole)
        if spoiler.random() < 0.7:
            changed = json.loads(json.dumps(said))
            spoiler.spoil(changed)
            head = {**header, "__metadata__": {**header["__metadata__"]}}
            try:
                head["__metadata__"]["model"] = json.dumps(changed)
            except TypeError:  # nothing that JSON has
                return "not written"
            text = json.dumps(head).encode()
            content = len(text).to_bytes(8, "little") + text + whole[8 + length :]
        file.write_bytes(content)
        try:
            loaded = load_model(file)
        except ModelFileError as refusal:
            assert "spoilt" in str(refusal)
            return "refused"
        try:
            bench.lift(bench.pipeline(loaded), valid, POINT_CLOUD)
        except ValueError:
            return "loaded, does not fit"
        return "loaded, lifts"

    fuzz("model file", one)


def npz(**arrays: Any) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def test_a_keypoint_file_is_read_or_refused(bench: Bench, fuzz: Fuzz, tmp_path: Path) -> None:
    p = len(bench.layout)
    rows = np.concatenate([views(4, p), np.ones((4, p, 1))], -1).reshape(4, -1).tolist()
    images = [{"id": i, "file_name": f"{i}.jpg"} for i in range(3)]
    people = [{"image_id": i // 2, "keypoints": row} for i, row in enumerate(rows)]
    coco = {"images": images, "annotations": people}
    openpose = {"people": [{"pose_keypoints_2d": row} for row in rows]}
    values = {
        "points": views(4, p),
        "confidence": np.ones((4, p)),
        "frame": np.array([0, 0, 1, 3]),
        "stamps": np.arange(5) * 10**7,
        "identities": np.array(["a", "b", "a", "c"]),
    }

    others = {  # known by their shapes and the words in their names
        "points": values["points"],
        "keypoint_scores": np.ones((4, p)),
        "frame_idx": np.array([0, 0, 1, 3]),
        "timestamps": np.array([0.0, 0.0, 0.1, 0.2]),
        "track_ids": np.array([1, 2, 1, 3]),
        "fps": np.array([10.0]),
    }

    def jsonl(content: object) -> bytes:
        return b"\n".join([json.dumps(content).encode()] * 2)

    def one(spoiler: Spoiler) -> str:
        kind = spoiler.choice(("json", "jsonl", "jsonl.gz", "npz"))
        if kind == "npz":
            chosen = spoiler.choice((values, others))
            arrays = {name: value.copy() for name, value in chosen.items()}
            name = spoiler.choice([*arrays])
            changed = (
                spoiler.anything(arrays[name].ravel()) if name != "identities" else arrays[name][1:]
            )
            keep = isinstance(changed, np.ndarray) and changed.size == arrays[name].size
            arrays[name] = changed.reshape(arrays[name].shape) if keep else np.array(changed)
            content = npz(**arrays)
        else:
            said = json.loads(json.dumps(spoiler.choice((coco, people, openpose))))
            spoiler.spoil(said)
            try:
                content = json.dumps(said).encode() if kind == "json" else jsonl(said)
            except TypeError:  # nothing that JSON has
                return "not written"
            content = spoiler.spoil_text(content, JSON) if spoiler.random() < 0.3 else content
            content = gzip.compress(content, 1) if kind.endswith("gz") else content
        if spoiler.random() < 0.3:
            content = spoiler.spoil_bytes(content)
        file = tmp_path / f"spoilt.{kind}"
        file.write_bytes(content)
        try:
            seen = read_keypoints(file, ReadOptions(fallback=KeypointLayout.numbered(p)))
        except KeypointFileError as refusal:
            assert "spoilt" in str(refusal)
            return f"{kind} refused"
        assert np.isfinite(seen.points).all() and (np.diff(seen.frame) >= 0).all()
        return f"{kind} read"

    # An array of an npz may claim terabytes: asked for, never touched, and given back.
    fuzz("keypoint file", one, touched=False)


def test_a_table_is_read_or_refused(fuzz: Fuzz, tmp_path: Path) -> None:
    rows = np.concatenate([views(6, 3), np.ones((6, 3, 1))], -1).reshape(6, -1).tolist()
    names = [f"{name}_{c}" for name in ("nose", "ear", "tail") for c in ("x", "y", "score")]
    flat = [point for row in rows for point in np.reshape(row, (3, 3)).tolist()]
    levels = [["scorer", *["DLC"] * 9], ["bodyparts", *"aaabbbccc"], ["coords", *"xypxypxyp"]]
    tables: list[list[list[Any]]] = [
        [
            ["frame", "time", "track", *names],
            *([i // 2, i / 10, i % 2, *r] for i, r in enumerate(rows)),
        ],
        [["timestamp", *names], *([f"2024-05-01T10:00:0{i}", *r] for i, r in enumerate(rows))],
        [
            ["frame", "node", "x", "y", "score"],
            *([i // 3, "abc"[i % 3], *p] for i, p in enumerate(flat)),
        ],
        [*levels, *([f"dir/{i}.png", *r] for i, r in enumerate(rows))],
    ]
    texts = ["\n".join(",".join(map(str, row)) for row in table).encode() for table in tables]

    def one(spoiler: Spoiler) -> str:
        content = spoiler.spoil_text(spoiler.choice(texts), CSV)
        if spoiler.random() < 0.3:
            content = spoiler.spoil_bytes(content)
        file = tmp_path / "spoilt.csv"
        file.write_bytes(content)
        try:
            seen = read_keypoints(file)
        except KeypointFileError as refusal:
            assert "spoilt" in str(refusal)
            return "refused"
        assert np.isfinite(seen.points).all() and (np.diff(seen.frame) >= 0).all()
        return "read"

    fuzz("table", one)

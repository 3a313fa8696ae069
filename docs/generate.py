# SPDX-License-Identifier: Apache-2.0
"""Write the pages that follow from the code: parameters, layouts, command line, API, schema.

Run `make reference` after a change of an option or a layout. A test fails when a page is stale.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import importlib
import inspect
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from deep_nrsfm_ros.commands import demo, doctor, echo, evaluate, lift, models, replay, train
from deep_nrsfm_ros.commands.cli import PROGRAMS
from deep_nrsfm_ros.configuration import options
from deep_nrsfm_ros.data.curation import Curation
from deep_nrsfm_ros.layouts.layout_file import FIELDS, HANDEDNESS
from deep_nrsfm_ros.layouts.presets import LAYOUTS
from deep_nrsfm_ros.lifting.options import (
    FieldOfViewOptions,
    GravityOptions,
    HistoryOptions,
    LiftingOptions,
)
from deep_nrsfm_ros.lifting.smoothing import SmoothingOptions
from deep_nrsfm_ros.messages.field_mapping import NEGATIVE, NORMALISED, PIXELS, FieldMapping
from deep_nrsfm_ros.messages.options import InputOptions
from deep_nrsfm_ros.node.bodies import BodyOptions
from deep_nrsfm_ros.node.camera import CameraOptions
from deep_nrsfm_ros.node.depth import DepthOptions
from deep_nrsfm_ros.node.gravity import GravitySources
from deep_nrsfm_ros.node.lifter import NodeOptions
from deep_nrsfm_ros.node.parameter_bridge import parameter_name
from deep_nrsfm_ros.node.target_frame import TargetOptions
from deep_nrsfm_ros.nrsfm.recipe import LayoutLossWeights, Recipe
from deep_nrsfm_ros.training.limits import Limits
from deep_nrsfm_ros.training.request import TrainingOptions

FOLDER = Path(__file__).parent / "reference"
_PACKAGE = Path(__file__).parents[1] / "deep_nrsfm_ros"
_HOME = "$ROS_HOME/deep_nrsfm_ros"
_SHOWN = {"models_dir": f"{_HOME}/models", "bags_dir": f"{_HOME}/bags"}
_GROUPS: tuple[tuple[str, type, str], ...] = (
    ("Model and input", InputOptions, ""),
    ("Lifting", LiftingOptions, ""),
    ("Camera", CameraOptions, ""),
    ("Field of view", FieldOfViewOptions, ""),
    ("Fixed frame", TargetOptions, ""),
    ("Measured depth", DepthOptions, "depth."),
    ("Lifting over time", HistoryOptions, "history."),
    ("Gravity", GravityOptions, "gravity."),
    ("Gravity: sources", GravitySources, "gravity."),
    ("Smoothing", SmoothingOptions, "smoothing."),
    ("Joints", BodyOptions, "body."),
    ("Lifecycle", NodeOptions, ""),
    ("Training: data and result", TrainingOptions, "train."),
    ("Training: recipe", Recipe, "train."),
    ("Training: losses of the layout", LayoutLossWeights, "train."),
    ("Training: limits", Limits, "train."),
    ("Training: curation of the data", Curation, "train."),
)


PARSERS: dict[str, Callable[[], argparse.ArgumentParser]] = {
    "demo": demo.arguments,
    "lift": lift.arguments,
    "train": train.parser,
    "evaluate": evaluate.arguments,
    "models": models.arguments,
    "replay": replay.arguments,
    "echo": echo.arguments,
    "doctor": doctor.arguments,
}
"""The parser of each program that has one."""


def parameter_names() -> set[str]:
    """Return the names of all parameters of the lifter."""
    return {
        parameter_name(field, prefix) for _, cls, prefix in _GROUPS for field, _, _ in options(cls)
    }


def parameters_page() -> str:
    """Return the page of all parameters of the lifter, in Markdown."""
    parts = [
        "# Parameters of the lifter",
        "Every parameter of `ros2 run deep_nrsfm_ros lifter`. A parameter marked with * is read at "
        "the start and cannot change afterwards. Made by `make reference`; do not edit.",
    ]
    for title, cls, prefix in _GROUPS:
        rows = ["| parameter | default | meaning | allowed |", "|---|---|---|---|"]
        for field, _, opt in options(cls):
            star = "*" if opt.read_only else ""
            allowed = ", ".join(opt.choices) or opt.allowed()
            shown = _SHOWN.get(field.name) or _default(field.default)
            name = parameter_name(field, prefix)
            rows.append(f"| `{name}`{star} | {shown} | {opt.description} | {allowed} |")
        parts += [f"## {title}", "\n".join(rows)]
    return "\n\n".join(parts) + "\n"


def layouts_page() -> str:
    """Return the page of all keypoint layouts, in Markdown."""
    rows = ["| layout | keypoints | picture | in order |", "|---|---|---|---|"]
    rows += [
        f"| `{preset.name}` | {len(preset)} | [picture](layouts/{preset.name}.png) | "
        f"{', '.join(preset.keypoints)} |"
        for preset in LAYOUTS.values()
    ]
    return (
        "# Keypoint layouts\n\nThe presets, each with its keypoints in the order in which they "
        "come. Made by `make reference`; do not edit. A picture has the index "
        "of each keypoint: left is blue, right is red, as in reports and viewers. "
        "`python -m docs.draw_layouts` draws them.\n\n" + "\n".join(rows) + "\n"
    )


def command_line_page() -> str:
    """Return the page of all programs and their options, in Markdown."""
    parts = [
        "# Command line",
        "Each program is called as `deep-nrsfm NAME` or, in a ROS workspace, as `ros2 run "
        "deep_nrsfm_ros NAME`. Made by `make reference`; do not edit.",
    ]
    for name, line in PROGRAMS.items():
        parts.append(f"## {name}\n\n{line[0].upper()}{line[1:]}.")
        if name not in PARSERS:
            parts.append(
                "Its options are ROS [parameters](parameters.md): `--ros-args -p NAME:=VALUE`."
            )
            continue
        parser = PARSERS[name]()
        parts.append((parser.description or "").strip())
        for group in parser._action_groups:
            rows = list(_option_rows(parser, group))
            if rows:
                title = (group.title or "options").capitalize()
                parts.append(
                    "\n".join([f"**{title}**", "", "| option | meaning |", "|---|---|", *rows])
                )
    return "\n\n".join(parts) + "\n"


def _option_rows(parser: argparse.ArgumentParser, group: Any) -> Iterator[str]:
    """Yield a row for each option of a group."""
    for action in group._group_actions:
        if action.help == argparse.SUPPRESS or isinstance(action, argparse._HelpAction):
            continue
        word = action.metavar or action.dest.upper()
        choices = "{" + ",".join(map(str, action.choices)) + "}" if action.choices else ""
        value = "" if action.nargs == 0 else f" {choices or word}"
        names = [f"`{name}{value}`" for name in action.option_strings] or [f"`{word}`"]
        text = parser._get_formatter()._expand_help(action) if action.help else ""
        home = str(Path.home())
        yield f"| {', '.join(names)} | {_cell(' '.join(text.split()).replace(home, '~'))} |"


def _cell(text: str) -> str:
    """Return text that Markdown shows as it is in a cell of a table."""
    for character in "|<>*_":
        text = text.replace(character, f"\\{character}")
    return text


def troubleshooting_page() -> str:
    """Return the page of faults and remedies, from `doctor` and the checks of keypoints."""
    rows = ["| found by doctor | remedy |", "|---|---|"]
    rows += [f"| {_cell(seen)} | {_cell(remedy)} |" for seen, remedy in _doctor_findings()]
    kinds = ["| kind | message and remedy |", "|---|---|"]
    kinds += [f"| {kind} | {_cell(text)} |" for kind, text in _keypoint_findings()]
    return (
        "\n\n".join(
            [
                "# Troubleshooting",
                "You get: every fault that the package finds by itself, and its remedy. `…` "
                "stands for what depends on the case. Made by `make reference`; do not edit.",
                "## The installation\n\n`ros2 run deep_nrsfm_ros doctor`, or `deep-nrsfm doctor`, "
                "checks imports, environment, disk, model, bags and an answer over DDS.",
                "\n".join(rows),
                "## The keypoints\n\nThe lifter says these in its log and on `/diagnostics`; "
                "`lift` says them at its end.",
                "\n".join(kinds),
                "## Nothing comes out\n\n`ros2 topic echo --once /diagnostics` names the topic, "
                "the numbers of messages, and the last reason. A message that cannot be used is "
                "never answered by a guess.",
                "| on `/diagnostics` | counts since the start |\n|---|---|\n"
                "| messages lifted | answered |\n"
                "| messages without objects | received, nobody in them; not answered |\n"
                "| messages rejected | received, and not usable: malformed, or no object with "
                "enough keypoints; `last problem` says why; not answered |\n"
                "| messages dropped | sent, and never received: they came while another was "
                "lifted, or were lost on the way |",
                "`wrong keypoints` there are those that contradict the others of their object and "
                "are left out, with their share of the objects of the last 15 seconds.",
            ]
        )
        + "\n"
    )


def _doctor_findings() -> Iterator[tuple[str, str]]:
    """Yield what each check of doctor finds, with the remedy, as they stand in its source."""
    tree = ast.parse((_PACKAGE / "commands" / "doctor.py").read_text(encoding="utf-8"))
    for check in ast.walk(tree):
        if not (isinstance(check, ast.FunctionDef) and check.name.startswith("check_")):
            continue
        texts: dict[str, str] = {}
        nodes = [n for n in ast.walk(check) if isinstance(n, ast.Assign | ast.AugAssign | ast.Call)]
        for node in sorted(nodes, key=lambda n: (n.lineno, n.col_offset)):
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                texts[node.targets[0].id] = _text(node.value, texts)
            elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Result":
                seen, *rest = node.args
                if rest:
                    yield _text(seen, texts), _text(rest[0], texts)


def _keypoint_findings() -> Iterator[tuple[str, str]]:
    """Yield kind and text of each finding about keypoints, as they stand in the source."""
    for path in sorted(_PACKAGE.rglob("*.py")):
        calls = (n for n in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(n, ast.Call))
        found = [n for n in calls if getattr(n.func, "id", "") == "Finding" and len(n.args) > 1]
        for node in sorted(found, key=lambda n: n.lineno):
            kind, text = _text(node.args[0], {}), _text(node.args[1], {})
            if set(text) - set("… "):
                yield kind, text


def _text(node: ast.expr, texts: dict[str, str]) -> str:
    """Return the text of an expression; `…` for what only the program can say."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        parts = [_text(part, {}) for part in node.values]
        return "".join(parts)
    if isinstance(node, ast.BinOp):
        return _text(node.left, texts) + _text(node.right, texts)
    if isinstance(node, ast.Name):
        return texts.get(node.id, "…")
    if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "wording":
        return _text(node.args[0], texts)
    return "…"


_FIELDS = {
    "name": ("name of the object", {"type": "string", "minLength": 1}),
    "keypoints": ("names of the keypoints, in the order of the detector", "names"),
    "edges": ("pairs to draw; those that keep their lengths are bones", "pairs"),
    "rigid": ("further pairs that keep their distance", "pairs"),
    "handedness": (
        "four keypoints that tell the object from its mirror image, or a list of such fours",
        "handedness",
    ),
    "reference": ("the pair that sets the size", "pair"),
    "reference_length": ("its length in metres", {"type": "number", "exclusiveMinimum": 0}),
    "derived": (
        "keypoints that are means of others",
        {"type": "object", "additionalProperties": {"$ref": "#/$defs/names"}},
    ),
    "top": ("the keypoints at the top of an upright object", "one_or_more"),
    "bottom": ("the keypoints at its bottom", "one_or_more"),
    "joints": (
        "the kinematic tree: a mapping, or the name of one of the package",
        {"type": ["object", "string"]},
    ),
}


def schema_of_objects() -> str:
    """Return the JSON Schema of an object file (a layout file)."""
    name = {"type": "string", "minLength": 1}
    pair = {"type": "array", "items": name, "minItems": 2, "maxItems": 2}
    names = {"type": "array", "items": name, "minItems": 1}
    four = {
        "type": "object",
        "properties": dict.fromkeys(HANDEDNESS, name),
        "required": list(HANDEDNESS),
        "additionalProperties": False,
    }
    kinds: dict[str, Any] = {
        "names": names,
        "pair": pair,
        "pairs": {"type": "array", "items": pair},
        "handedness": {"anyOf": [four, {"type": "array", "items": four}]},
        "one_or_more": {"anyOf": [name, names]},
    }
    properties = {}
    for field in FIELDS:
        text, kind = _FIELDS[field]
        shape = {"$ref": f"#/$defs/{kind}"} if isinstance(kind, str) else kind
        # A template leaves fields without a value; they count as absent.
        properties[field] = {"description": text, "anyOf": [shape, {"type": "null"}]}
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Object file of deep_nrsfm_ros",
        "type": "object",
        "properties": properties,
        "required": ["name", "keypoints"],
        "additionalProperties": False,
        "$defs": kinds,
    }
    return json.dumps(schema, indent=2) + "\n"


_PATH = {"type": "string"}
_NAMES = {"type": "array", "items": {"type": "string"}, "minItems": 1}
_PATHS = {"anyOf": [_PATH, _NAMES]}
_SIZE = {"type": "array", "items": {"type": "integer", "minimum": 1}, "minItems": 2, "maxItems": 2}
_MAPPING_KINDS: dict[str, dict[str, Any]] = {
    "type": {"type": "string", "pattern": r"^[A-Za-z]\w*/(msg/)?[A-Za-z]\w*$"},
    **dict.fromkeys(("keypoints", "x", "y", "confidence"), _PATHS),
    **dict.fromkeys(("objects", "where", "identity", "score", "count", "keypoint_id"), _PATH),
    "first_id": {"type": "integer"},
    "max_confidence": {"type": "number", "exclusiveMinimum": 0},
    "names": _NAMES,
    "units": {"anyOf": [{"enum": [PIXELS, NORMALISED]}, _SIZE]},
    "missing": {
        "anyOf": [
            {"enum": [NEGATIVE]},
            {"type": "number"},
            {"type": "array", "items": {"type": "number"}},
        ]
    },
    "counts": {"type": "object", "additionalProperties": {"type": "integer"}},
}


def schema_of_mappings() -> str:
    """Return the JSON Schema of a field mapping; the texts are those of `FieldMapping`."""
    texts = _items(FieldMapping, "Attributes")
    properties = {
        name: {"description": texts[name], "anyOf": [kind, {"type": "null"}]}
        for name, kind in _MAPPING_KINDS.items()
    }
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Field mapping of deep_nrsfm_ros",
        "type": "object",
        "properties": properties,
        "required": ["type"],
        "anyOf": [{"required": ["keypoints"]}, {"required": ["x", "y"]}],
        "additionalProperties": False,
    }
    return json.dumps(schema, indent=2) + "\n"


def object_file_page() -> str:
    """Return the page of the fields of an object file, in Markdown."""
    rows = [f"| `{name}` | {_FIELDS[name][0]} |" for name in FIELDS]
    return (
        "\n\n".join(
            [
                "# Object files",
                "You get: the fields of a layout file, and a JSON Schema by which an editor checks "
                "them: [object.schema.json](object.schema.json). With the YAML language server, "
                "begin the file with",
                "    # yaml-language-server: $schema=object.schema.json",
                "`name` and `keypoints` are needed. What each is for: [objects of your own]"
                "(../tutorials/object_files.md). Made by `make reference`; do not edit.",
                "\n".join(["| field | meaning |", "|---|---|", *rows]),
            ]
        )
        + "\n"
    )


_API: tuple[tuple[str, tuple[str, ...]], ...] = (
    (
        "Lifting",
        (
            "model_files.model_file:load_model",
            "lifting.lifter:Lifter",
            "lifting.lifter:Lifter.__call__",
            "lifting.lifter:Lifter.check",
            "lifting.lifter:Lifted",
            "lifting.options:LiftingOptions",
        ),
    ),
    (
        "Lifting with a camera, over time",
        (
            "data.video_lifter:VideoLifter",
            "data.video_lifter:VideoLifter.__call__",
            "lifting.intrinsics:Intrinsics",
            "lifting.intrinsics:Intrinsics.from_field_of_view",
            "lifting.options:HistoryOptions",
        ),
    ),
    (
        "Models and layouts",
        (
            "model_files.model_file:Model",
            "model_files.model_file:save_model",
            "layouts.layout:KeypointLayout",
        ),
    ),
    ("Training", ("training.from_arrays:train", "nrsfm.recipe:Recipe")),
    (
        "Your own truth",
        (
            "nrsfm.metrics:camera_errors",
            "nrsfm.metrics:CameraErrors",
            "nrsfm.metrics:shape_errors",
            "nrsfm.metrics:ShapeErrors",
            "nrsfm.metrics:procrustes_distances",
            "nrsfm.factorisation.rigid:rigid",
        ),
    ),
)
"""Sections of the Python API, and the module and the name of each entry."""
_INTRODUCTIONS = {
    "Lifting with a camera, over time": """\
`Lifter` lifts each object by itself and centres it. `VideoLifter` puts it at its place before
the camera, and remembers it from frame to frame, as the ROS node does:

    from deep_nrsfm_ros import Intrinsics, Lifter, VideoLifter
    camera = Intrinsics((1000, 1000), (640, 360))  # fx, fy and cx, cy in pixels
    # or as OpenCV and ROS calibrate: Intrinsics.from_matrix(K, distortion)
    camera = Intrinsics.from_field_of_view(65, (1280, 720))  # or roughly: degrees of the width
    video = VideoLifter(Lifter("human", layout="coco17"), camera)
    for i, frame in enumerate(points):  # a person, or (n, 17, 2) of n people
        lifted = video(frame, seconds=i / 30)
        print(video.identities, lifted.shapes[0, 0])  # metres, from the camera

Without `seconds` each object is lifted by itself: `video(points)` lifts all frames at once.
[lift_video.py](../../examples/lift_video.py) does it with a real video and its calibration, and
measures the answer against the true 3D with `nrsfm.metrics`; put your own arrays
(frames, keypoints, 3) there.""",
    "Lifting": """\
A call of a `Lifter` checks the shapes of its arrays alone. Units, axes, sides and a poor fit are
checked by `lifter.check(points)`, as by the program `lift` at its end.""",
    "Your own truth": """\
The functions of `nrsfm.metrics` compare shapes with a truth of yours, at the points of both:

    from deep_nrsfm_ros.nrsfm.metrics import camera_errors, procrustes_distances
    lifter = Lifter("human", layout="coco17")
    chosen = [lifter.model.layout.index(name) for name in names]  # names of your truth's points
    shapes = lifter(points).shapes[:, chosen]
    print(camera_errors(shapes, truth))  # truth (n, points, 3) in the camera's axes, in any unit
    print(procrustes_distances(shapes, truth).mean(1))  # of each frame

`rigid` is a baseline: one shape for all frames. Other methods are in `nrsfm/factorisation/`.""",
}
"""Text at the beginning of a section of the Python API."""
_MODULES = (
    *("network", "geometry", "normalisation", "losses", "metrics", "handedness", "neighbours"),
    *("bones", "recipe"),
)
"""Modules of `deep_nrsfm_ros.nrsfm` that the page lists."""
_OF_PARAMETERS = {
    "LiftingOptions": "lifting",
    "HistoryOptions": "lifting-over-time",
    "Recipe": "training-recipe",
}
"""Dataclasses whose fields are parameters too, and the section of those."""


class _Plain:
    """A text that is shown without quotes: an annotation, or a default that is a function."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __repr__(self) -> str:
        return self._text


def python_page() -> str:
    """Return the page of the Python API, in Markdown: signatures and what each entry returns."""
    readme = (_PACKAGE.parent / "README.md").read_text("utf-8")
    example, _, text = readme.split("## Python\n")[1].split("\n## ")[0].partition("\n\n")
    text = text.partition("More: [")[0].strip()
    parts = [
        "# Python API",
        "You get: lifting and training as a library. Lifting needs neither ROS nor torch. Made by "
        "`make reference`; do not edit.",
        example,
        text,
        "`from deep_nrsfm_ros import NAME` gives each of the names below but those of `nrsfm` at "
        "the end. `help(NAME)` and [the API in full](python_full.md) have results and errors too.",
    ]
    for title, entries in _API:
        introduction = [_INTRODUCTIONS[title]] if title in _INTRODUCTIONS else []
        parts += [f"## {title}", *introduction, *map(_entry, entries)]
    rows = ["| module | content |", "|---|---|"]
    for name in _MODULES:
        module = importlib.import_module(f"deep_nrsfm_ros.nrsfm.{name}")
        link = f"[`nrsfm.{name}`](../../deep_nrsfm_ros/nrsfm/{name}.py)"
        rows.append(f"| {link} | {_cell(_first_paragraph(module))} |")
    parts += ["## The method", "\n".join(rows)]
    return "\n\n".join(parts) + "\n"


def _entry(place: str) -> str:
    """Return signature, first paragraph and arguments of a function or a class.

    A dataclass and a named tuple have their attributes instead.
    """
    module, _, path = place.partition(":")
    value: Any = importlib.import_module(f"deep_nrsfm_ros.{module}")
    for name in path.split("."):
        value = getattr(value, name)
    is_record = isinstance(value, type) and (
        dataclasses.is_dataclass(value) or hasattr(value, "_fields")
    )
    signature = "" if is_record else _signature(value)
    title = f"**`{path}{signature}`**"
    if section := _OF_PARAMETERS.get(path):
        return (
            f"{title}: its fields are those of [these parameters](parameters.md#{section}), "
            "without what stands before a dot; `help` has them too. A wrong value is refused."
        )
    described = vars(value)["__init__"] if isinstance(value, type) and not is_record else value
    items = _items(described, "Attributes" if is_record else "Args")
    rows = "\n".join(f"- `{name}`: {text}" for name, text in items.items())
    return f"{title}\n\n{_first_paragraph(value)}\n\n{rows}"


def _signature(value: Any) -> str:
    """Return the signature of a function, a method or a class, without `self`."""
    signature = inspect.signature(value)
    parameters = [
        p.replace(
            annotation=_Plain(p.annotation),
            default=_Plain("...") if inspect.isfunction(p.default) else p.default,
        )
        for name, p in signature.parameters.items()
        if name != "self"
    ]
    returned = signature.return_annotation
    returned = inspect.Signature.empty if returned in (None, "None") else _Plain(returned)
    return str(signature.replace(parameters=parameters, return_annotation=returned))


def _first_paragraph(value: Any) -> str:
    """Return the first paragraph of a docstring, on one line."""
    return " ".join((inspect.getdoc(value) or "").partition("\n\n")[0].split())


def _items(value: Any, section: str) -> dict[str, str]:
    """Return names and texts of a section of a docstring, "Attributes" or "Args"."""
    text = (inspect.getdoc(value) or "").partition(f"{section}:\n")[2].partition("\n\n")[0]
    return {
        name: " ".join(words.split())
        for name, words in re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", text, re.MULTILINE)
    }


PAGES = {
    "python.md": python_page,
    "parameters.md": parameters_page,
    "layouts.md": layouts_page,
    "command_line.md": command_line_page,
    "object_file.md": object_file_page,
    "object.schema.json": schema_of_objects,
    "mapping.schema.json": schema_of_mappings,
    "../operations/troubleshooting.md": troubleshooting_page,
}


def _default(value: Any) -> str:
    return "none" if value == () else "empty" if value == "" else str(value)


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name, page in PAGES.items():
        (FOLDER / name).write_text(page(), encoding="utf-8")

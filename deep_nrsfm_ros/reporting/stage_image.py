# SPDX-License-Identifier: Apache-2.0
"""Images of a stage, drawn with Pillow: the demo's picture and the README's animation."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.reporting.drawing import edge_colours
from deep_nrsfm_ros.reporting.stage import GRID, Stage, StageView

Floats = NDArray[Any]
Colour = tuple[int, int, int]

_SMOOTH = 3  # everything is drawn so many times larger, then made smaller
_TRUTH = (180, 188, 196)
_FLOOR, _LINE = (243, 245, 246), (207, 213, 217)
_SHADOW = (213, 217, 221)
_DARK, _WORD, _ACCENT = (32, 38, 43), (70, 78, 84), (242, 142, 43)
_DISTANCE = 4.2  # metres from the viewer to the middle of the room
_PITCH = 0.22  # radians above the floor
_EDGE = 8  # pixels beside a person


class Room:
    """A view of the person's room from one side, as large as it can be."""

    def __init__(self, stage: Stage, size: tuple[int, int], yaw: float) -> None:
        """Look at a stage.

        Args:
            stage: to show.
            size: width and height in pixels.
            yaw: direction of the viewer in radians; 0 = from -y.
        """
        parts = [part for view in stage.views for part in (view.shapes, view.truth)]
        cloud = np.concatenate([part.reshape(-1, 3) for part in parts])
        cloud = cloud[np.isfinite(cloud).all(1)]
        self.stage, self.size, self.yaw = stage, size, yaw
        self.middle = np.median(cloud[:, :2], 0)
        self.height = float(np.quantile(cloud[:, 2], 0.995))
        away = np.linalg.norm(cloud[:, :2] - self.middle, axis=1)
        self.radius = float(np.quantile(away, 0.97))
        wide = 2 * (self.radius + 0.15)
        tall = self.height * math.cos(_PITCH) + 2 * self.radius * math.sin(_PITCH)
        self.zoom = 0.9 * min(size[0] / wide, size[1] / tall)

    def project(self, points: Floats) -> Floats:
        """Return pixels and nearness (..., 3) of world points (..., 3)."""
        x, y, z = np.moveaxis(points - [*self.middle, self.height / 2], -1, 0)
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        across, depth = c * x + s * y, s * x - c * y
        nearness = math.cos(_PITCH) * depth + math.sin(_PITCH) * z
        up = math.cos(_PITCH) * z - math.sin(_PITCH) * depth
        zoom = self.zoom / np.maximum(0.1, 1 - nearness / _DISTANCE)
        width, height = self.size
        return np.stack([width / 2 + zoom * across, height / 2 - zoom * up, nearness], -1)

    def hold(self, points: Floats) -> None:
        """Make all smaller where world points (..., 3) are not in the picture; NaN is ignored."""
        half = np.array(self.size) / 2
        beyond = np.abs(self.project(points)[..., :2] - half) / (half - _EDGE)
        self.zoom /= max(1.0, float(np.nanmax(beyond, initial=1.0)))

    def draw(self, view: StageView, frame: int) -> Image.Image:
        """Return the floor, the ground truth in grey and the lifted person of one frame."""
        image = Image.new("RGB", _larger(self.size), "white")
        pen = ImageDraw.Draw(image)
        reach = math.ceil((self.radius + 0.2) / GRID) * GRID
        centre = np.round(self.middle / GRID) * GRID
        corners = centre + reach * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        outline = [self._at(self._floor(corner)) for corner in corners]
        pen.polygon([(_SMOOTH * x, _SMOOTH * y) for x, y in outline], fill=_FLOOR)
        for d in np.arange(-reach, reach + 1e-9, GRID):
            for ends in (((d, -reach), (d, reach)), ((-reach, d), (reach, d))):
                start, stop = (self._at(self._floor(centre + end)) for end in ends)
                _line(pen, start, stop, _LINE, 1)
        shape, truth = view.shapes[frame], view.truth[frame]
        flat = shape * [1, 1, 0]
        for a, b, _ in _bones(self.stage.target, flat):
            _line(pen, self._at(flat[a]), self._at(flat[b]), _SHADOW, 7)
        lines = [
            (points, a, b, colour, width)
            for layout, points, own, width in (
                (self.stage.truth, truth, _TRUTH, 8.0),
                (self.stage.target, shape, None, 5.0),
            )
            for a, b, side in _bones(layout, points)
            for colour in [own or side]
        ]
        lines.sort(key=lambda line: float(self.project(line[0][[line[1], line[2]]])[:, 2].sum()))
        for points, a, b, colour, width in lines:
            _line(pen, self._at(points[a]), self._at(points[b]), colour, width)
        for point in shape[np.isfinite(shape).all(1)]:
            _dot(pen, self._at(point), 3, _DARK)
        return image.resize(self.size, Image.Resampling.LANCZOS)

    def _floor(self, point: Floats) -> Floats:
        """Return a point of the floor (2,) as (3,)."""
        return np.append(point, 0.0)

    def _at(self, point: Floats) -> tuple[float, float]:
        """Return where a world point is drawn."""
        x, y, _ = self.project(point).tolist()
        return x, y


def seen(stage: Stage, view: StageView, frame: int, height: int) -> Image.Image:
    """Return the image of a camera with the detections on it."""
    width = round(height * view.images.size[0] / view.images.size[1])
    photo = Image.open(io.BytesIO(view.images.files[frame // stage.step])).convert("RGB")
    image = photo.resize(_larger((width, height)), Image.Resampling.BICUBIC)
    pen = ImageDraw.Draw(image)
    points = view.points[frame] * (height / view.images.size[1])
    points = np.where(view.confidence[frame, :, None] > 0, points, np.nan)
    for white in (True, False):
        for a, b, colour in _bones(stage.source, points):
            shown, width_of_line = ((255, 255, 255), 5) if white else (colour, 3)
            _line(pen, points[a].tolist(), points[b].tolist(), shown, width_of_line)
    for point in points[np.isfinite(points).all(1)]:
        _dot(pen, tuple(point.tolist()), 3, (255, 255, 255))
        _dot(pen, tuple(point.tolist()), 2, _DARK)
    return image.resize((width, height), Image.Resampling.LANCZOS)


def draw_picture(stage: Stage, path: Path, fraction: float = 0.5) -> None:
    """Write a PNG with a column for each camera: what it saw, and the person from two sides.

    Args:
        stage: to show.
        path: of the PNG.
        fraction: of the clip, where the frame is taken from.
    """
    width, top, low, edge = 336, 420, 400, 12
    count = len(stage.views)
    total = (count * (width + edge) + edge, 72 + top + 2 * (low + 26) + 44)
    image = Image.new("RGB", total, "white")
    pen = ImageDraw.Draw(image)
    pen.text((edge, 12), "2D keypoints in, 3D out: each camera by itself", _DARK, _font(22))
    for column, view in enumerate(stage.views):
        frame = _lifted_frame(stage, view, fraction)
        left = edge + column * (width + edge)
        pen.text((left, 48), f"{view.name}, frame {frame}", _WORD, _font(15))
        image.paste(seen(stage, view, frame, top), (left, 70))
        for row, (angle, words) in enumerate(
            ((0.0, "as the camera sees it"), (math.pi / 2, "from its right"))
        ):
            room = Room(stage, (width, low), _yaw_of(stage, view) + angle)
            room.hold(np.concatenate([view.shapes[frame], view.truth[frame]]))
            y = 76 + top + row * (low + 26)
            pen.text((left, y), words, _WORD, _font(15))
            image.paste(room.draw(view, frame), (left, y + 20))
    x, y = edge, total[1] - 28
    for words, colour in (
        ("left", (31, 119, 180)),
        ("right", (214, 39, 40)),
        (f"ground truth from all cameras; one square of the floor is {GRID} m", _TRUTH),
    ):
        pen.rectangle((x, y + 6, x + 22, y + 12), fill=colour)
        pen.text((x + 28, y), words, _WORD, _font(15))
        x += 48 + int(pen.textlength(words, _font(15)))
    image.save(path)


def animation_frames(
    stage: Stage, view: StageView, height: int, turn: float
) -> Iterator[Image.Image]:
    """Yield images of a camera's view beside the person, around whom the viewer goes.

    The ground truth has the middle of the lifted person, so that the eye compares the shapes: from
    another side an error of the distance from the camera would be all that it sees.

    Args:
        stage: to show.
        view: of the camera.
        height: of the images in pixels.
        turn: radians by which the viewer goes to and fro while the clip plays.
    """
    limbs = [stage.target.index(joint) for joint in stage.truth.keypoints]
    away = np.mean(view.shapes[:, limbs] - view.truth, axis=1, keepdims=True)
    view = replace(view, truth=view.truth + away)
    start, count = _yaw_of(stage, view), len(stage.frames)
    words = _font(round(height / 26))
    for k, frame in enumerate(stage.frames):
        photo = seen(stage, view, frame, height)
        angle = start - turn * math.sin(2 * math.pi * k / count)
        room = Room(stage, (round(height * 1.05), height), angle).draw(view, frame)
        both = Image.new("RGB", (photo.width + room.width, height), "white")
        both.paste(photo, (0, 0))
        both.paste(room, (photo.width, 0))
        pen, margin = ImageDraw.Draw(both), round(height / 50)
        for left, text in (
            (0, "2D keypoints of a detector"),
            (photo.width, "3D from this camera alone (grey: truth, moved to it)"),
        ):
            at = (left + 2 * margin, height - round(height / 26) - 3 * margin)
            x1, y1, x2, y2 = pen.textbbox(at, text, font=words)
            pen.rectangle((x1 - margin, y1 - margin, x2 + margin, y2 + margin), "white")
            pen.text(at, text, _DARK, words)
        yield both


def save_animation(images: Sequence[Image.Image], path: Path, seconds: float) -> None:
    """Write images as an animated WebP or GIF, by the suffix of the path.

    Args:
        images: in order.
        path: ends in .webp or .gif.
        seconds: that each image is shown.
    """
    options: dict[str, Any] = {"save_all": True, "duration": round(1000 * seconds), "loop": 0}
    if path.suffix == ".webp":
        options |= {"quality": 60, "method": 4}
    images[0].save(path, append_images=images[1:], **options)


def _lifted_frame(stage: Stage, view: StageView, fraction: float) -> int:
    """Return the lifted frame with an image that is nearest to a fraction of the clip."""
    lifted = [f for f in stage.frames if np.isfinite(view.shapes[f]).all()] or [0]
    return min(lifted, key=lambda f: abs(f - fraction * len(view.points)))


def _yaw_of(stage: Stage, view: StageView) -> float:
    """Return the yaw of a viewer who stands where the camera does."""
    middle = Room(stage, (1, 1), 0.0).middle
    x, y = (view.position[:2] - middle).tolist()
    return math.atan2(x, -y)


def _bones(layout: KeypointLayout, points: Floats) -> Iterator[tuple[int, int, Colour]]:
    """Yield the edges between known points (p, d) with their colour."""
    for (a, b), text in zip(layout.edge_indices(), edge_colours(layout), strict=True):
        if np.isfinite(points[[a, b]]).all():
            yield a, b, (int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16))


def _larger(size: tuple[int, int]) -> tuple[int, int]:
    return size[0] * _SMOOTH, size[1] * _SMOOTH


def _line(pen: Any, a: Any, b: Any, colour: Colour, width: float) -> None:
    """Draw a line with round ends."""
    (x1, y1), (x2, y2) = a, b
    ends = [(_SMOOTH * x1, _SMOOTH * y1), (_SMOOTH * x2, _SMOOTH * y2)]
    pen.line(ends, fill=colour, width=round(_SMOOTH * width))
    if width > 1:
        for end in (a, b):
            _dot(pen, end, width / 2 - 0.2, colour)


def _dot(pen: Any, point: Any, radius: float, colour: Colour) -> None:
    x, y, r = _SMOOTH * point[0], _SMOOTH * point[1], _SMOOTH * radius
    pen.ellipse((x - r, y - r, x + r, y + r), fill=colour)


def _font(size: int) -> Any:
    return ImageFont.load_default(size)

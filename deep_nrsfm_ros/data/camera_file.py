# SPDX-License-Identifier: Apache-2.0
"""Camera files: CameraInfo in YAML, as `ros2 topic echo` and camera_calibration write it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.messages.camera_info import read_camera_info
from deep_nrsfm_ros.messages.field_mapping import Size
from deep_nrsfm_ros.yaml_file import brief_repr, read_fields

# Names of the matrices in files of camera_calibration (ost.yaml) and camera_info_manager.
_CALIBRATION = {
    "camera_matrix": "k",
    "distortion_coefficients": "d",
    "projection_matrix": "p",
}
_NO_BINNING = {"binning_x": 0, "binning_y": 0}
_FULL_IMAGE = {"x_offset": 0, "y_offset": 0}


class CameraFileError(ValueError):
    """A camera file is missing or invalid; the message names the file and the remedy."""


def read_camera_file(path: Path, *, rectified: bool = False) -> Intrinsics:
    """Return the intrinsics of a camera file.

    Args:
        path: YAML with the fields of CameraInfo, or with the names of camera_calibration.
        rectified: the keypoints are those of the rectified image; see `read_camera_info`.

    Raises:
        CameraFileError: the file is missing or invalid.
    """
    try:
        return read_camera_info(
            _message(read_fields(path, "k: [600, 0, 320, ...]")), rectified=rectified
        )
    except ValueError as error:
        raise CameraFileError(f"camera file {path}: {error}") from error


def read_image_size(path: Path) -> Size | None:
    """Return width and height in pixels of the image of a camera file; None if it lacks them."""
    fields = read_fields(path, "k: [600, 0, 320, ...]")
    width, height = (fields.get(f"image_{side}", fields.get(side)) for side in ("width", "height"))
    if isinstance(width, int) and isinstance(height, int) and min(width, height) > 0:
        return width, height
    return None


def _message(content: dict[Any, Any]) -> SimpleNamespace:
    """Return the content of a file with the fields of CameraInfo; raise ValueError if invalid."""
    fields = {_CALIBRATION.get(name, name): value for name, value in content.items()}
    matrices = {}
    for name in _CALIBRATION.values():
        value = fields.get(name, [])
        matrices[name] = value.get("data") if isinstance(value, dict) else value
        if not isinstance(matrices[name], list):
            raise ValueError(
                f"{name} is {brief_repr(matrices[name])}; it must be a list of numbers"
            )
    if not matrices["k"] and not matrices["p"]:
        raise ValueError(
            "has neither k nor camera_matrix; write one with `ros2 topic echo --once CAMERA_INFO`, "
            "or calibrate the camera"
        )
    roi = fields.get("roi") or {}
    if not isinstance(roi, dict):
        raise ValueError(f"roi is {brief_repr(roi)}; it must hold fields like 'x_offset: 0'")
    return SimpleNamespace(
        **matrices,
        distortion_model=fields.get("distortion_model", ""),
        **{name: fields.get(name, value) for name, value in _NO_BINNING.items()},
        roi=SimpleNamespace(
            **_FULL_IMAGE | {name: roi[name] for name in _FULL_IMAGE if name in roi}
        ),
    )

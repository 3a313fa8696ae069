"""Camera files: a CameraInfo in YAML, as `ros2 topic echo` and camera calibration write it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.messages.camera_info import read_camera_info
from deep_nrsfm_ros.yaml_file import brief_repr, read_fields

# The names that camera_calibration (ost.yaml) and camera_info_manager give to the matrices.
_CALIBRATION = {
    "camera_matrix": "k",
    "distortion_coefficients": "d",
    "projection_matrix": "p",
}
_UNUSED = {"binning_x": 0, "binning_y": 0}
_WHOLE = {"x_offset": 0, "y_offset": 0}


class CameraFileError(ValueError):
    """A camera file that is missing or says what no camera has: names the file and the mend."""


def read_camera_file(path: Path, *, rectified: bool = False) -> Intrinsics:
    """Return the intrinsics in a file; `rectified` as in `read_camera_info`.

    The file is a CameraInfo field by field, or has the matrices by the names of
    camera_calibration. Raises CameraFileError.
    """
    try:
        return read_camera_info(
            _message(read_fields(path, "k: [600, 0, 320, ...]")), rectified=rectified
        )
    except ValueError as error:
        raise CameraFileError(f"camera file {path}: {error}") from error


def _message(given: dict[Any, Any]) -> SimpleNamespace:
    """Return the fields of a file as CameraInfo has them; raise ValueError for a bad one."""
    fields = {_CALIBRATION.get(name, name): value for name, value in given.items()}
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
        **{name: fields.get(name, value) for name, value in _UNUSED.items()},
        roi=SimpleNamespace(**_WHOLE | {name: roi[name] for name in _WHOLE if name in roi}),
    )

# SPDX-License-Identifier: Apache-2.0
"""Kinds of files that hold no readable keypoints: why, and the way to a kind that is read."""

from __future__ import annotations

_ARRAY = "np.savez(NEW, points=array (objects, q, 2), frame=array (objects,))"
_IS_3D = (
    "it is motion capture, which is 3D already: `lift` needs the 2D keypoints that a detector "
    "finds in images"
)
_REMEDIES = {
    (".pkl", ".pickle", ".pt", ".pth", ".joblib"): (
        "it is a pickle, which could run code when it is read: load it yourself if you trust it, "
        f"and save {_ARRAY}"
    ),
    (".mat",): (
        "files of MATLAB are not read: load it in Python (scipy.io.loadmat; h5py from version 7.3 "
        f"on), and save {_ARRAY}"
    ),
    (".parquet", ".feather"): (
        "it is a table of a kind that is not read: pandas.read_parquet(FILE).to_csv(NEW) makes a "
        ".csv of it (read_feather)"
    ),
    (".xlsx", ".xls", ".ods"): (
        "spreadsheets are not read: save it as .csv, or by pandas.read_excel(FILE).to_csv(NEW, "
        "index=False)"
    ),
    (".nwb",): f"files of NWB are not read: load it in Python (pynwb), and save {_ARRAY}",
    (".bvh", ".c3d", ".fbx", ".asf"): _IS_3D,
    (".amc",): f"{_IS_3D}; `train --cmu` takes CMU's motion capture",
    (".txt", ".dat"): (
        "plain text does not say what its numbers are: write .csv with columns such as nose_x, "
        "nose_y, or np.save(NEW, np.loadtxt(FILE).reshape(-1, q, 2)); of YOLO use results.to_json()"
    ),
    (".yaml", ".yml"): (
        "YAML is not read: json.dump(yaml.safe_load(open(FILE)), open(NEW, 'w')) makes a .json of "
        "it"
    ),
    (".xml",): "XML is not read: export COCO keypoints (.json) from the tool that wrote it",
    (".zip", ".tar", ".tgz", ".7z", ".rar"): "it is an archive: unpack it, and name what is in it",
    (".mp4", ".avi", ".mov", ".mkv", ".webm", ".png", ".jpg", ".jpeg"): (
        "it is images, without keypoints: run a detector first, such as MediaPipe, MMPose or "
        "Ultralytics, and name the file of keypoints that it writes"
    ),
    (".safetensors",): "it is a model, and no keypoints: name it with --model",
    (".gz", ".bz2", ".xz", ".zst"): "it is compressed: unpack it, and name what is in it",
}
"""Ends of names of files -> what is said of them."""


def remedy_of(name: str) -> str:
    """Return how to get from a file to one that is read, by its name; "" for an unknown kind."""
    return next((text for ends, text in _REMEDIES.items() if name.lower().endswith(ends)), "")

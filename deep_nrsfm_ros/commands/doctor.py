# SPDX-License-Identifier: Apache-2.0
"""Check an installation from the imports to an answer over DDS, and name the remedy of each fault.

Exit code 0: all that lifting needs works; 1: something does not.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from deep_nrsfm_ros.commands.program import Parser, program, program_name
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.extras import how_to_install, is_installed
from deep_nrsfm_ros.training.limits import Limits

CORE = ("numpy", "safetensors", "yaml", "rosbags", "jinja2", "tqdm")
TO_TRAIN = ("torch",)
FOR_ROS = ("rclpy", "sensor_msgs", "diagnostic_msgs")
RANGES = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")
SHIPPED = "human"
HIGHEST_DOMAIN = 101  # above it, DDS takes ports that Linux gives to others
LEAST_SHM = 8e6  # bytes: each participant of Fast DDS takes a segment of about half a MB


class Result(NamedTuple):
    """The result of a check.

    Attributes:
        seen: what was found, in words.
        remedy: what to do about it; "" if all is well.
        fatal: whether lifting needs it.
    """

    seen: str
    remedy: str = ""
    fatal: bool = True

    @property
    def word(self) -> str:
        """Return "ok", "FAIL" or, for a result that is not fatal, "warn"."""
        return "ok" if not self.remedy else "FAIL" if self.fatal else "warn"


def check_imports() -> Result:
    """Return the versions of the packages that the programs import."""
    versions = [f"Python {sys.version.split()[0]}"]
    missing: list[str] = []
    distributions = importlib.metadata.packages_distributions()
    for name in (*CORE, *FOR_ROS, *TO_TRAIN):
        if not is_installed(name):
            missing.append(name)
            continue
        if name != "torch":  # takes seconds to import
            try:
                importlib.import_module(name)
            except Exception as error:  # a library of the wrong kind fails in many ways
                remedy = "install it anew; are two ROS installations mixed?"
                return Result(f"{name} does not import: {error}", remedy)
        versions.extend(
            f"{distribution} {importlib.metadata.version(distribution)}"
            for distribution in distributions.get(name, ())[:1]  # none where apt has installed it
        )
    seen = ", ".join(dict.fromkeys(versions))
    if not missing:
        return Result(seen)
    seen = f"{', '.join(missing)} not found ({seen})"
    remedies = [f"pip install {name}" for name in missing if name in CORE]
    remedies += [how_to_install("ros")] if set(missing) & set(FOR_ROS) else []
    if not remedies:
        return Result(seen, f"{how_to_install('train')}, if you want to train", fatal=False)
    return Result(seen, "; ".join(remedies))


def check_environment() -> Result:
    """Return the variables that decide which ROS nodes find each other."""
    said = os.environ.get
    domain, reach = said("ROS_DOMAIN_ID", "0"), said("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    seen = f"ROS_DOMAIN_ID {domain}, discovery range {reach}"
    if not domain.isdecimal() or int(domain) > HIGHEST_DOMAIN:
        return Result(seen, f"set ROS_DOMAIN_ID to a number from 0 to {HIGHEST_DOMAIN}")
    if reach not in RANGES:
        return Result(seen, f"set ROS_AUTOMATIC_DISCOVERY_RANGE to one of {', '.join(RANGES)}")
    if reach == "OFF" and not said("ROS_STATIC_PEERS"):
        return Result(seen, "with discovery OFF nothing is found: set it to LOCALHOST or SUBNET")
    if said("ROS_LOCALHOST_ONLY", "0") == "1":
        remedy = "unset ROS_LOCALHOST_ONLY, which overrides it; LOCALHOST as range does the same"
        return Result(f"{seen}, ROS_LOCALHOST_ONLY 1", remedy, fatal=False)
    if said("ROS_SECURITY_ENABLE", "").lower() == "true":
        keystore = said("ROS_SECURITY_KEYSTORE", "")
        seen += f", security on with keystore {keystore or 'none'}"
        if not (Path(keystore) / "enclaves").is_dir():
            return Result(seen, "set ROS_SECURITY_KEYSTORE to a keystore; see docs/security.md")
    return Result(seen)


def check_disk_and_shared_memory(models_dir: Path) -> Result:
    """Return whether models can be written, and whether DDS has shared memory."""
    place = models_dir
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    seen = f"{models_dir}: {free / 1e9:.1f} GB free"
    if not os.access(place, os.W_OK):
        return Result(seen, f"make {place} writable, or set models_dir, to train", fatal=False)
    if free < 1e6 * Limits().free_disk:
        return Result(seen, "make room on its disk, to train", fatal=False)
    shared = Path("/dev/shm")
    if not os.access(shared, os.W_OK) or shutil.disk_usage(shared).free < LEAST_SHM:
        remedy = "give /dev/shm room (docker run --shm-size or --ipc host), or DDS is slow or deaf"
        return Result(f"{seen}; no shared memory", remedy)
    return Result(seen)


def check_model(name: str, models_dir: Path) -> Result:
    """Load a model and lift with it."""
    import numpy as np

    from deep_nrsfm_ros import kernel
    from deep_nrsfm_ros.lifting.lifter import Lifter
    from deep_nrsfm_ros.model_files.folders import model_folders
    from deep_nrsfm_ros.model_files.model_file import find_model, load_model

    remedy = "install the package anew; its models belong in share/deep_nrsfm_ros/models"
    if name != SHIPPED:
        remedy = f"name another with --model; {SHIPPED} comes with the package"
    try:
        path = find_model(name, model_folders(models_dir))
        if path.parent == models_dir:
            remedy = f"remove or replace {path}, or name another with --model"
        model = load_model(path)
    except ValueError as error:
        return Result(str(error), remedy)
    p = len(model.layout)
    points = np.random.default_rng(0).uniform(50, 600, (1, p, 2)).astype(np.float32)
    lifted = Lifter(model)(points, np.ones((1, p), np.float32))
    if not np.isfinite(lifted.shapes).all():
        return Result(f"{path} lifts to what is no number", remedy)
    seen = f"{path} of {p} keypoints lifts"
    if not kernel.AVAILABLE:
        remedy = "install a C compiler (apt-get install gcc python3-dev), then the package anew"
        return Result(f"{seen}, but in NumPy: ten times slower", remedy, fatal=False)
    return Result(f"{seen}, compiled")


def check_bags() -> Result:
    """Write and read a bag in both storages."""
    import numpy as np

    from deep_nrsfm_ros.data.bags import STORAGES, frames, read_bags, write_bag
    from deep_nrsfm_ros.layouts.presets import HUMAN17

    points = np.random.default_rng(0).uniform(50, 600, (10, 17, 2))
    for storage in STORAGES:
        with tempfile.TemporaryDirectory() as folder:
            bag = Path(folder) / "bag"
            write_bag(bag, "/keypoints", frames(points, np.ones((10, 17))), storage)
            read = read_bags([bag], HUMAN17, HUMAN17, ReadOptions("/keypoints")).dataset
            if not np.allclose(read.points, points, rtol=1e-4):
                remedy = "pip install --force-reinstall rosbags"
                return Result(f"{storage}: what was read is not what was written", remedy)
    return Result(f"written and read: {', '.join(STORAGES)}")


def check_dds(name: str, models_dir: Path, seconds: float) -> Result:
    """Start a lifter in another process and wait for its answer over DDS."""
    import numpy as np

    from deep_nrsfm_ros.model_files.folders import model_folders
    from deep_nrsfm_ros.model_files.model_file import find_model, load_model
    from deep_nrsfm_ros.node.self_test import SelfTestError, time_to_first_points

    path = find_model(name, model_folders(models_dir))
    points = np.random.default_rng(0).uniform(50, 600, (len(load_model(path).layout), 2))
    try:
        took = time_to_first_points(str(path), points, seconds)
    except SelfTestError as error:
        if error.ended:
            return Result(str(error), "repair what its output names")
        remedy = "let the firewall pass UDP 7400-7500 and multicast on this machine"
        if os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") != "LOCALHOST":
            remedy += ", or set ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST"
        return Result(str(error), f"{remedy}; on a busy machine raise --timeout")
    return Result(f"a lifter in another process answered {took:.1f} s after its start")


def examine(args: argparse.Namespace) -> bool:
    """Run every check and print what it found; return whether lifting works."""
    checks: dict[str, Callable[[], Result]] = {
        "imports": check_imports,
        "environment": check_environment,
        "disk and shared memory": lambda: check_disk_and_shared_memory(args.models_dir),
        "model": lambda: check_model(args.model, args.models_dir),
        "bags": check_bags,
        "DDS": lambda: check_dds(args.model, args.models_dir, args.timeout),
    }
    well = True
    for name, check in checks.items():
        try:
            result = check()
        except Exception as error:  # whatever is broken, the other checks tell more
            remedy = "report it with this line" if well else "repair the faults above first"
            result = Result(f"{type(error).__name__}: {error}", remedy)
        well &= result.word != "FAIL"
        print(f"{result.word:4}  {name}: {result.seen}", flush=True)
        if result.remedy:
            print(f"      -> {result.remedy}", flush=True)
    return well


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    from deep_nrsfm_ros.model_files.folders import default_models_dir

    parser = Parser(prog=program_name("doctor"), description=__doc__)
    parser.add_argument("--model", default=SHIPPED, help="model to lift with (default: human)")
    parser.add_argument(
        "--models-dir", type=Path, default=default_models_dir(), help="folder of your own models"
    )
    parser.add_argument(
        "--timeout", type=float, default=30.0, help="seconds for an answer (default: 30)"
    )
    return parser


@program
def main(argv: Sequence[str] | None = None) -> None:
    """Examine this installation."""
    args = arguments().parse_args(argv)
    args.models_dir = args.models_dir.expanduser().absolute()
    if not examine(args):
        print("lifting does not work yet; repair the faults from the top", file=sys.stderr)
        sys.exit(1)
    print("all that lifting needs works")


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: Apache-2.0
"""Install the package, its executables and what ROS 2 looks up in share/deep_nrsfm_ros."""

import os
from glob import glob
from pathlib import Path

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext
from setuptools.errors import CompileError

NAME = "deep_nrsfm_ros"
SHARE = f"share/{NAME}"
REQUIRE_KERNEL = "DEEP_NRSFM_REQUIRE_KERNEL"  # environment variable, as in deep_nrsfm_ros.kernel
REQUIRED = os.environ.get(REQUIRE_KERNEL) == "1"


class BuildKernel(build_ext):
    """Compiles the kernel; says how to mend it where it is required and cannot be compiled."""

    def run(self) -> None:
        """Remove in-place builds for one version alone: Python prefers them to `.abi3.so`."""
        for path in Path(NAME, "kernel").glob("_kernel.cpython-*.so") if self.inplace else ():
            path.unlink()
        super().run()

    def build_extension(self, extension: Extension) -> None:
        """Compile and link one extension."""
        try:
            super().build_extension(extension)
        except Exception as error:
            if not REQUIRED:
                raise
            raise CompileError(
                f"{REQUIRE_KERNEL}=1, but the kernel cannot be compiled ({error}): install a C "
                f"compiler (apt-get install gcc python3-dev), or unset {REQUIRE_KERNEL} to "
                "install without the kernel, which is ten times slower"
            ) from error


setup(
    name=NAME,
    version="0.2.0",
    description="3D shape and camera from 2D keypoints, learned from 2D alone, for ROS 2",
    long_description=Path("README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    author="deep_nrsfm_ros maintainers",
    author_email="maintainers@example.org",
    url="https://arxiv.org/abs/1902.10840",  # of the method, until the repository has a public one
    license="Apache-2.0",
    license_files=["LICENSE", f"{NAME}/data/clip_licence.txt"],
    keywords="ROS 2, human pose estimation, 3D, keypoints, non-rigid structure from motion",
    classifiers=[
        "Development Status :: 4 - Beta",
        "Intended Audience :: Developers",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: C",
        *(f"Programming Language :: Python :: 3.{minor}" for minor in (11, 12, 13)),
        "Topic :: Scientific/Engineering :: Image Recognition",
        "Typing :: Typed",
    ],
    python_requires=">=3.11",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={
        NAME: [
            *("py.typed", "kernel/*.pyi", "layouts/presets/*.yaml", "layouts/trees/*.yaml"),
            *("data/clip.npz", "data/clip_standing.npz", "data/clip_licence.txt"),
            *("reporting/*.j2", "reporting/*.css", "reporting/*.js"),
        ]
    },
    cmdclass={"build_ext": BuildKernel},
    # Without a C compiler NumPy and torch compute the same, some ten and three times slower.
    ext_modules=[
        Extension(
            f"{NAME}.kernel._kernel",
            glob(f"{NAME}/kernel/*.c"),
            depends=glob(f"{NAME}/kernel/*.h"),
            extra_compile_args=[
                "-O3",
                "-fno-math-errno",
                "-fno-trapping-math",
                "-fvisibility=hidden",
                "-pthread",
            ],
            extra_link_args=["-pthread"],
            optional=not REQUIRED,
            # The stable ABI of CPython 3.11, the first with Py_buffer: one wheel for all versions.
            define_macros=[("Py_LIMITED_API", "0x030B0000")],
            py_limited_api=True,
        )
    ],
    entry_points={"console_scripts": [f"deep-nrsfm={NAME}.commands.cli:main"]},
    # `ros2 run` looks for executables in lib/deep_nrsfm_ros, where no installer puts scripts.
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (SHARE, ["package.xml"]),
        (f"{SHARE}/launch", glob("launch/*.launch.py")),
        (f"{SHARE}/config", glob("config/*.*")),
        (f"{SHARE}/config/layouts", glob("config/layouts/*.yaml")),
        (f"{SHARE}/config/security", glob("config/security/*.xml")),
        (f"{SHARE}/config/mappings", glob("config/mappings/*.yaml")),
        (f"{SHARE}/models", glob("models/*.safetensors") + glob("models/*.md")),
        (f"lib/{NAME}", glob("scripts/*")),
    ],
    zip_safe=False,
    options={"bdist_wheel": {"py_limited_api": "cp311"}},  # what define_macros promises
    # The one place that declares what is needed; requirements.lock pins it for the Makefile.
    install_requires=[
        "numpy",  # the lifter's arithmetic
        "safetensors",  # model files: weights and metadata, never pickle
        "rosbags",  # reads and writes rosbag2 without a ROS installation
        "pyyaml",  # layout files, parameter files and bag metadata
        "jinja2",  # reports and recordings as pages: templates that escape whatever comes from data
        "lap",  # optimal assignment for identities: 2 MB and NumPy alone, where SciPy has 100 MB
        "tqdm",  # progress of training, evaluation and lifting
    ],
    extras_require={
        "train": [
            "torch>=2.2",  # training; lifting needs none
        ],
        "demo": [
            "pillow",  # the picture of `deep-nrsfm demo`; its page needs nothing
        ],
        "hdf5": [
            "h5py",  # reads the .h5 of DeepLabCut without pandas and PyTables (200 MB)
        ],
        "ros": [
            "ros-jazzy-rclpy",  # the node, where no ROS installation is sourced
            "ros-jazzy-common-interfaces",  # the messages it receives and sends
            "ros-jazzy-rmw-fastrtps-cpp",  # the DDS under it
        ],
        "ros-kilted": [  # instead of "ros"
            "ros-kilted-rclpy",
            "ros-kilted-common-interfaces",
            "ros-kilted-rmw-fastrtps-cpp",
        ],
        "test": [
            "pytest",  # runs the tests; colcon test needs its name here to run any
            "pytest-xdist",  # several test files at a time
            "pytest-timeout",  # a process that never answers fails its test instead of hanging all
            "h5py",  # writes files as DeepLabCut does
            "kinpy",  # reads the URDF of a person; its forward kinematics must be ours
            "jsonschema",  # object files against their schema
            "check-jsonschema>=0.30",  # the schemas of workflows, issue forms, CITATION.cff
            "pillow",  # the demo's picture
            "hypothesis",  # properties over generated input
            "ruff",  # lint and format
            "mypy",  # types
            "types-PyYAML",  # types of pyyaml
            "types-tqdm",  # types of tqdm
            "colcon-common-extensions",  # the test that builds as a ROS workspace does
            "setuptools<80",  # colcon calls setup.py in ways that setuptools 80 dropped
        ],
        "docs": [
            "sphinx",  # the documentation site
            "myst-parser",  # its pages are Markdown
            "furo",  # its theme
            "sphinx-copybutton",  # commands are copied with one click
        ],
        "benchmarks": [
            "matplotlib",  # the benchmarks' plots
            "scipy",  # ground truth of real scenes: triangulation from calibrated cameras
        ],
        # Not in requirements.lock: only benchmarks.speed.forward_pass has a row for it.
        "speed": [
            "onnxruntime",  # what the forward pass is measured against
            "onnx",  # the format, for torch's exporter
            "onnxscript",  # torch's exporter is written in it
        ],
        "examples": [
            "mediapipe==0.10.14",  # the detector; this wheel carries the weights of its pose model
        ],
    },
)

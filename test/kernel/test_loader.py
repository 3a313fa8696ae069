# SPDX-License-Identifier: Apache-2.0
"""The kernel as an optional part: what happens where there is no C compiler."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from deep_nrsfm_ros import kernel
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise

ROOT = Path(__file__).resolve().parents[2]
WITHOUT_KERNEL = """
import sys
sys.modules["deep_nrsfm_ros.kernel._kernel"] = None
from deep_nrsfm_ros import kernel
print(kernel.AVAILABLE)
"""


def python(*arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run Python in the root of the repository."""
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env={k: v for k, v in os.environ.items() if k != kernel.REQUIRED} | variables,
        capture_output=True,
        text=True,
        timeout=60,
    )


def build(folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Build the extension with a C compiler that always fails."""
    folders = ("--build-temp", str(folder / "temp"), "--build-lib", str(folder / "lib"))
    return python("setup.py", "-q", "build_ext", *folders, CC="false", **variables)


def test_a_missing_kernel_is_an_error_only_where_it_is_required() -> None:
    optional = python("-c", WITHOUT_KERNEL)
    assert (optional.returncode, optional.stdout) == (0, "False\n"), optional.stderr
    required = python("-c", WITHOUT_KERNEL, **{kernel.REQUIRED: "1"})
    assert required.returncode == 1
    assert f"ImportError: {kernel.REQUIRED}=1" in required.stderr
    assert "install a C compiler" in required.stderr


def test_a_failing_compiler_is_an_error_only_where_the_kernel_is_required(tmp_path: Path) -> None:
    optional = build(tmp_path)
    assert optional.returncode == 0, optional.stderr
    required = build(tmp_path, **{kernel.REQUIRED: "1"})
    assert required.returncode == 1
    assert f"{kernel.REQUIRED}=1, but the kernel cannot be compiled" in required.stderr
    assert not list(tmp_path.rglob("*.so"))


@pytest.mark.skipif(not kernel.AVAILABLE, reason="no C compiler")
def test_networks_that_the_kernel_computes(monkeypatch: pytest.MonkeyPatch) -> None:
    default = initialise(Architecture((12, 6)), 17, np.random.default_rng(0))
    other = initialise(Architecture((12, 6), "block"), 17, np.random.default_rng(0))
    assert kernel.supports(default) and not kernel.supports(other)
    monkeypatch.setattr(kernel, "AVAILABLE", False)
    assert not kernel.supports(default)

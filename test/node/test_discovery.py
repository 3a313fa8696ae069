# SPDX-License-Identifier: Apache-2.0
"""The profile by which a node that was there before is found at once, as all tests have it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
NODE = "import rclpy; rclpy.init(); rclpy.create_node('anybody'); rclpy.shutdown()"


@pytest.mark.usefixtures("domain")
@pytest.mark.parametrize("name", ["leaseAnnouncement", "leaseProclamation"])
def test_fast_dds_understands_it(name: str, tmp_path: Path) -> None:
    profile = tmp_path / "profile.xml"
    profile.write_text(Path(os.environ[PROFILES]).read_text().replace("leaseAnnouncement", name))
    done = subprocess.run(
        [sys.executable, "-c", NODE],
        env=os.environ | {PROFILES: str(profile)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert ("XMLPARSER" in done.stdout + done.stderr) == (name != "leaseAnnouncement")

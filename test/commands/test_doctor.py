# SPDX-License-Identifier: Apache-2.0
"""What the doctor says of installations that lack something."""

from __future__ import annotations

from pathlib import Path

import pytest

from deep_nrsfm_ros import kernel
from deep_nrsfm_ros.commands import doctor


def test_a_sound_installation_has_nothing_to_mend(tmp_path: Path) -> None:
    for found in (
        doctor.check_imports(),
        doctor.check_model("human", tmp_path),
        doctor.check_bags(),
        doctor.check_disk_and_shared_memory(tmp_path / "not" / "there"),
    ):
        assert found.word == "ok", found


@pytest.mark.parametrize(
    ("variables", "remedy"),
    [
        ({}, ""),
        ({"ROS_DOMAIN_ID": "200"}, "number from 0 to 101"),
        ({"ROS_DOMAIN_ID": "mine"}, "number from 0 to 101"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "HERE"}, "one of SUBNET"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}, "LOCALHOST or SUBNET"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF", "ROS_STATIC_PEERS": "10.0.0.2"}, ""),
        ({"ROS_LOCALHOST_ONLY": "1"}, "unset ROS_LOCALHOST_ONLY"),
        ({"ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_KEYSTORE": "/nowhere"}, "to a keystore"),
    ],
)
def test_the_environment_is_judged(
    monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], remedy: str
) -> None:
    for name in ("DOMAIN_ID", "AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST_ONLY", "SECURITY_ENABLE"):
        monkeypatch.delenv(f"ROS_{name}", raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    found = doctor.check_environment()
    assert remedy in found.remedy and bool(remedy) == (found.word != "ok")


def test_what_is_missing_is_named_with_the_mend(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(doctor, "TO_TRAIN", ("no_torch_here",))
    assert doctor.check_imports().word == "warn"
    assert "if you want to train" in doctor.check_imports().remedy
    monkeypatch.setattr(kernel, "AVAILABLE", False)
    found = doctor.check_model("human", tmp_path)
    assert found.word == "warn" and "C compiler" in found.remedy
    monkeypatch.setattr(doctor, "FOR_ROS", ("no_rclpy_here",))
    found = doctor.check_imports()
    assert found.word == "FAIL" and "no_rclpy_here" in found.seen
    assert "pip install 'deep_nrsfm_ros[ros]' (or source" in found.remedy
    (tmp_path / "mine.safetensors").write_bytes(b"x" * 100)
    for name in ("mine", "nobody"):
        found = doctor.check_model(name, tmp_path)
        assert found.word == "FAIL" and name in found.seen and "--model" in found.remedy
    assert "remove or replace" in doctor.check_model("mine", tmp_path).remedy
    assert "human comes with the package" in doctor.check_model("nobody", tmp_path).remedy


def test_one_failure_makes_the_exit_code_1_and_the_others_are_still_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    asked: list[str] = []

    def answer(name: str, *_: object) -> doctor.Result:
        asked.append(name)
        return doctor.Result("answered")

    def break_down() -> doctor.Result:
        raise RuntimeError("the bag is on fire")

    monkeypatch.setattr(doctor, "check_dds", answer)
    doctor.main(["--models-dir", str(tmp_path)])
    assert "all that lifting needs works" in capsys.readouterr().out
    monkeypatch.setattr(doctor, "check_bags", break_down)
    with pytest.raises(SystemExit) as end:
        doctor.main(["--models-dir", str(tmp_path)])
    printed = capsys.readouterr().out
    assert end.value.code == 1 and len(asked) == 2
    assert "FAIL  bags: RuntimeError: the bag is on fire" in printed
    assert "ok    DDS: answered" in printed

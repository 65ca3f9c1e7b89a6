"""What `servoid doctor` finds wrong, and that it says what to do."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from servoid.tools.commands import doctor


@pytest.mark.slow
def test_doctor_reports_this_machine() -> None:
    result = subprocess.run([sys.executable, "-m", "servoid", "doctor", "--json"], capture_output=True, text=True)
    report = json.loads(result.stdout)
    checks = {check["name"]: check for check in report["checks"]}
    assert {"python", "numpy", "torch", "mujoco", "cores", "disk", "checkpoint", "rendering"} <= set(checks)
    assert report["ready"] == (result.returncode == 0) == all(c["status"] != "fail" for c in report["checks"])
    assert all(check["remedy"] for check in report["checks"] if check["status"] != "ok")
    assert checks["torch"]["status"] == "ok"


def ports(tmp_path: Path, latency: str | None) -> list[doctor.Check]:
    dev = tmp_path / "dev"
    dev.mkdir()
    (dev / "ttyUSB0").touch()
    if latency is not None:
        device = tmp_path / "sys" / "bus" / "usb-serial" / "devices" / "ttyUSB0"
        device.mkdir(parents=True)
        (device / "latency_timer").write_text(latency + "\n")
    return list(doctor.check_serial(dev, tmp_path / "sys"))


@pytest.mark.parametrize(("latency", "status"), [("16", "warn"), ("1", "ok"), (None, "ok")])
def test_latency_timer_of_an_adapter(tmp_path: Path, latency: str | None, status: str) -> None:
    (check,) = ports(tmp_path, latency)
    assert check.status == status
    assert ("tee" in check.remedy) == (status == "warn")


def test_port_without_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)  # permissions do not bind root, who may run the tests
    (check,) = ports(tmp_path, "1")
    assert check.status == "fail"
    assert "dialout" in check.remedy


def test_checkpoints_are_read_to_their_end(tmp_path: Path) -> None:
    (check,) = doctor.check_checkpoints(tmp_path)
    assert check.status == "warn"
    path = tmp_path / "net.safetensors"
    save_file({"weight": np.zeros(1000, dtype=np.float32)}, path)
    (check,) = doctor.check_checkpoints(tmp_path)
    assert check.status == "ok"
    path.write_bytes(path.read_bytes()[:-100])
    (check,) = doctor.check_checkpoints(tmp_path)
    assert check.status == "fail"
    assert str(path) in check.found


@pytest.mark.parametrize(
    ("version", "wanted", "expected"),
    [
        ("2.13.0+cpu", "==2.13.0", True),
        ("2.13.1", "==2.13.0", False),
        ("2.0", ">=2.0.0", True),
        ("5.10", ">=5.5,<6", True),
        ("6.0", ">=5.5,<6", False),
        ("1.9", ">=1.13", False),
        ("3.0", "", True),
    ],
)
def test_versions_are_compared_as_numbers(version: str, wanted: str, expected: bool) -> None:
    assert doctor.satisfies(version, wanted) is expected


def test_missing_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    requires = ["numpy>=999", "nonesuch>=1", "nonesuch-video>=1; extra == 'video'", "pytest; extra == 'test'"]
    monkeypatch.setattr(doctor.metadata, "requires", lambda _: requires)
    checks = {check.name: check for check in doctor.check_packages()}
    assert set(checks) == {"numpy", "nonesuch", "nonesuch-video"}
    assert checks["numpy"].status == "fail"
    assert ">=999 is needed" in checks["numpy"].found
    assert checks["nonesuch"].remedy == "pip install 'nonesuch>=1'"
    assert checks["nonesuch-video"].status == "warn"
    assert checks["nonesuch-video"].remedy == "pip install 'servoid[video]'"


def test_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = doctor.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _: usage._replace(free=50 * 2**20))
    (check,) = doctor.check_disk(tmp_path)
    assert check.status == "fail"


def test_rendering_that_fails_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    (check,) = doctor.check_rendering()
    assert check.status == "warn"
    assert "MUJOCO_GL=nonsense" in check.found

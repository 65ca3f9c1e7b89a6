"""The wheel holds everything that a run needs, and finds it where it was installed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("stack", "sim", "hw", "policy", "tools", "configs")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel of this tree, built from a copy so that an old build/ folder cannot slip files into it."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for path in ROOT.iterdir():
        if path.name in ("pyproject.toml", "LICENSE", "README.md"):
            shutil.copy(path, source)
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*command, "--wheel-dir", str(out), str(source)], check=True, capture_output=True)
    (built,) = out.glob("*.whl")
    return built


def test_wheel_holds_code_and_data(wheel: Path) -> None:
    held = set(zipfile.ZipFile(wheel).namelist())
    kinds = (".py", ".yaml", ".xml", ".safetensors")
    files = [path for name in PACKAGES for path in (ROOT / name).rglob("*") if path.suffix in kinds]
    wanted = {path.relative_to(ROOT).as_posix() for path in files}
    assert wanted - held == set()
    assert {"hw/hal.py", "configs/robots/op3.yaml", "configs/robots/op3.xml", "configs/tasks/goal.yaml"} <= held
    assert not any(name.startswith("tests/") for name in held)
    assert any(name.endswith("licenses/LICENSE") for name in held)


def test_wheel_runs_away_from_its_source(wheel: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    zipfile.ZipFile(wheel).extractall(site)
    entry = next(site.glob("servoid-*.dist-info")) / "entry_points.txt"
    assert "servoid = tools.cli:main" in entry.read_text()
    code = (
        "import sys, tools.cli, hw.config; from hw.robot import load_robot; "
        "print(hw.config.CONFIGS, load_robot('op3').mjcf, file=sys.stderr); "
        "sys.exit(tools.cli.main(['tasks', '--json']))"
    )
    environment = {**os.environ, "PYTHONPATH": str(site)}
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    configs, mjcf = result.stderr.splitlines()[0].split()
    assert configs == str(site / "configs")
    assert mjcf == str(site / "configs" / "robots" / "op3.xml")
    configured = {path.stem for path in (ROOT / "configs" / "tasks").glob("*.yaml")}
    assert {task["name"] for task in json.loads(result.stdout)["tasks"]} == configured


def test_torch_is_pinned_to_the_release_with_a_cpu_build() -> None:
    """A looser requirement brings several GB of GPU libraries to a robot's PC."""
    assert '"torch==2.13.0"' in (ROOT / "pyproject.toml").read_text()

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

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("stack", "sim", "hw", "policy", "tools", "configs")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel of this tree, built from a copy so that an old build/ folder cannot slip files into it."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "src", source / "src", symlinks=True, ignore=shutil.ignore_patterns("*.egg-info"))
    for path in ROOT.iterdir():
        if path.name in ("pyproject.toml", "LICENSE", "README.md"):
            shutil.copy(path, source)
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*command, "--wheel-dir", str(out), str(source)], check=True, capture_output=True)
    (built,) = out.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def site(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the wheel was installed, beside another project's packages that have the names of the folders here."""
    site = tmp_path_factory.mktemp("site")
    zipfile.ZipFile(wheel).extractall(site)
    for name in (*PACKAGES, "tests"):
        (site / name).mkdir()
        (site / name / "__init__.py").write_text("raise ImportError('somebody else's package')")
    return site


def test_wheel_holds_code_and_data(wheel: Path) -> None:
    held = set(zipfile.ZipFile(wheel).namelist())
    kinds = (".py", ".yaml", ".xml", ".safetensors")
    files = [path for name in PACKAGES for path in (ROOT / name).rglob("*") if path.suffix in kinds]
    wanted = {f"servoid/{path.relative_to(ROOT).as_posix()}" for path in files}
    assert wanted - held == set()
    assert {"servoid/__init__.py", "servoid/configs/robots/op3.xml", "servoid/configs/tasks/goal.yaml"} <= held
    assert {name.split("/")[0] for name in held if ".dist-info/" not in name} == {"servoid"}, "one package, not six"
    assert any(name.endswith("licenses/LICENSE") for name in held)


def test_wheel_runs_away_from_its_source(site: Path, tmp_path: Path) -> None:
    entry = next(site.glob("servoid-*.dist-info")) / "entry_points.txt"
    assert "servoid = servoid.tools.start:main" in entry.read_text()
    code = (
        "import sys; from servoid.hw.config import CONFIGS; from servoid.hw.robot.description import load_robot; "
        "from servoid.tools.cli import main; "
        "print(CONFIGS, load_robot('op3').mjcf, file=sys.stderr); "
        "sys.exit(main(['tasks', '--json']))"
    )
    environment = {**os.environ, "PYTHONPATH": str(site)}
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    configs, mjcf = result.stderr.splitlines()[0].split()
    assert configs == str(site / "servoid" / "configs")
    assert mjcf == str(site / "servoid" / "configs" / "robots" / "op3.xml")
    configured = {path.stem for path in (ROOT / "configs" / "tasks").glob("*.yaml")}
    assert {task["name"] for task in json.loads(result.stdout)["tasks"]} == configured


@pytest.mark.parametrize("backend", ["sim", "virtual"])
def test_wheel_runs_beside_packages_of_the_same_names_from_any_folder(site: Path, backend: str) -> None:
    """The rig, the planner and the guardian are processes of their own: none may import `hw` or `sim` from there."""
    command = [sys.executable, "-m", "servoid", "run", "stand", "--policy", "gait", "--seconds", "0.5"]
    result = subprocess.run(
        [*command, "--backend", backend, "--record", str(site / f"{backend}.mcap"), "--json"],
        cwd=site,  # which Python puts first
        env={**os.environ, "PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["outcome"] == "succeeded"


def test_torch_is_pinned_to_the_release_with_a_cpu_build() -> None:
    """A looser requirement brings several GB of GPU libraries to a robot's PC."""
    assert '"torch==2.13.0"' in (ROOT / "pyproject.toml").read_text()

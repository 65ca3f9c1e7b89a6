"""Check that this machine is ready: packages, rendering, disk, serial ports, checkpoints."""

from __future__ import annotations

import argparse
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

from servoid.hw.config import CONFIGS
from servoid.tools.common import exit_codes
from servoid.tools.common.output import add_json_argument, reporting

CHECKPOINTS = CONFIGS.parent / "policy" / "checkpoints"
MEGABYTE = 2**20

_RENDER = """
import mujoco
model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><light pos="0 0 2"/><geom size=".1"/></worldbody></mujoco>')
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 48, 64) as renderer:
    renderer.update_scene(data)
    assert renderer.render().any(), "the picture is black"
"""


@dataclass(frozen=True)
class Check:
    """One line of the report. A warning keeps something from working well, a failure keeps the robot from running."""

    name: str
    status: Literal["ok", "warn", "fail"]
    found: str
    remedy: str = ""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    checks: list[Check] = []
    groups: tuple[Callable[[], Iterator[Check]], ...] = (
        check_python,
        check_packages,
        check_cores,
        check_disk,
        check_checkpoints,
        check_serial,
        check_rendering,
    )
    with reporting(args.json) as report:
        for group in groups:
            for check in group():
                checks.append(check)
                report.line(f"{check.status:<4}  {check.name}: {check.found}")
                if check.remedy:
                    report.line(f"      -> {check.remedy}")
        failed = any(check.status == "fail" for check in checks)
        report.result({"ready": not failed, "checks": [asdict(check) for check in checks]})
    return exit_codes.FAILED if failed else exit_codes.DONE


def check_python() -> Iterator[Check]:
    """Which Python this is: an older one than the package needs could not have installed it."""
    yield Check("python", "ok", f"{platform.python_version()} on {platform.machine()}, {sys.executable}")


def check_packages(distribution: str = "servoid") -> Iterator[Check]:
    """Every requirement of the package: absent or of another version than asked."""
    try:
        requirements = metadata.requires(distribution) or []
    except metadata.PackageNotFoundError:
        yield Check(distribution, "fail", "not installed", "pip install . in its folder")
        return
    seen: set[str] = set()
    for requirement in requirements:
        match = re.match(r"([\w.-]+)(?:\[.*?\])?\s*([^;]*)(?:;.*extra == ['\"](\w+)['\"])?", requirement)
        if match is None or match[3] == "test" or match[1] in (distribution, *seen):
            continue
        seen.add(match[1])
        name, wanted, extra = match[1], match[2].strip(), match[3]
        status: Literal["warn", "fail"] = "warn" if extra else "fail"
        remedy = f"pip install 'servoid[{extra}]'" if extra else f"pip install '{name}{wanted}'"
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            yield Check(name, status, f"not installed{f' (extra {extra})' if extra else ''}", remedy)
            continue
        if satisfies(version, wanted):
            yield Check(name, "ok", version)
        else:
            yield Check(name, status, f"{version}, but {wanted} is needed", f"pip install '{name}{wanted}'")


def satisfies(version: str, wanted: str) -> bool:
    """Whether a version meets bounds such as `>=1.2,<2` or `==2.13.0`, by its numbers; a local suffix is ignored."""
    have = _numbers(version)
    for bound in filter(None, wanted.split(",")):
        match = re.match(r"\s*(==|>=|<=|!=|<|>|~=)\s*(.+)", bound)
        if match is None:
            continue
        want = _numbers(match[2])
        width = max(len(have), len(want))
        left, right = have + (0,) * (width - len(have)), want + (0,) * (width - len(want))
        meets = {
            "==": left == right,
            "!=": left != right,
            ">=": left >= right,
            "<=": left <= right,
            ">": left > right,
            "<": left < right,
            "~=": left >= right and left[: len(want) - 1] == right[: len(want) - 1],
        }
        if not meets[match[1]]:
            return False
    return True


def _numbers(version: str) -> tuple[int, ...]:
    match = re.match(r"\d+(\.\d+)*", version.strip())
    return tuple(int(part) for part in match[0].split(".")) if match else ()


def check_cores() -> Iterator[Check]:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if cores < 2:
        yield Check("cores", "warn", str(cores), "use at least 2: the control loop and the planner run side by side")
    else:
        yield Check("cores", "ok", str(cores))


def check_disk(folder: Path = Path()) -> Iterator[Check]:
    """Room for flight logs in the working folder."""
    free = shutil.disk_usage(folder).free / MEGABYTE
    found = f"{free / 1024:.1f} GB free in {folder.resolve()}"
    if not os.access(folder, os.W_OK):
        yield Check("disk", "warn", "not writable: " + found, "start from a folder of yours: logs go there")
    elif free < 100:
        yield Check("disk", "fail", found, "make room: flight logs and videos of runs go there")
    elif free < 1024:
        yield Check("disk", "warn", found, "make room: flight logs and videos of runs go there")
    else:
        yield Check("disk", "ok", found)


def check_checkpoints(folder: Path = CHECKPOINTS) -> Iterator[Check]:
    """Every checkpoint that ships with the package can be read to its end."""
    paths = sorted(folder.glob("*.safetensors"))
    if not paths:
        yield Check("checkpoint", "warn", f"none in {folder}", "reinstall the package, or train one: servoid train")
    for path in paths:
        try:
            _read_checkpoint(path)
        except Exception as error:  # whatever a damaged file raises is what to report
            yield Check("checkpoint", "fail", f"{path}: {error}", "restore the file: reinstall the package")
        else:
            yield Check("checkpoint", "ok", f"{path.name}, {path.stat().st_size / MEGABYTE:.1f} MB")


def _read_checkpoint(path: Path) -> None:
    from safetensors import safe_open

    with safe_open(path, framework="numpy") as tensors:
        for name in list(tensors.keys()):
            tensors.get_tensor(name)


def check_serial(dev: Path = Path("/dev"), sys_root: Path = Path("/sys")) -> Iterator[Check]:
    """Permission and latency of each USB serial port."""
    ports = sorted([*dev.glob("ttyUSB*"), *dev.glob("ttyACM*")])
    if not ports:
        yield Check("serial", "ok", "no ttyUSB or ttyACM port (needed for hardware only)")
    for port in ports:
        if not os.access(port, os.R_OK | os.W_OK):
            remedy = "sudo usermod -aG dialout $USER, then log in again"
            yield Check(str(port), "fail", "no permission to read and write", remedy)
            continue
        timer = sys_root / "bus" / "usb-serial" / "devices" / port.name / "latency_timer"
        if not timer.exists():  # only FTDI adapters have one
            yield Check(str(port), "ok", "readable and writable")
            continue
        latency = timer.read_text().strip()
        if latency == "1":
            yield Check(str(port), "ok", "readable and writable, latency timer 1 ms")
        else:
            found = f"latency timer {latency} ms: every read of the bus waits that long"
            yield Check(str(port), "warn", found, f"echo 1 | sudo tee {timer}")


def check_rendering() -> Iterator[Check]:
    """MuJoCo can draw without a display. Tried in a process of its own, because a broken driver may crash it."""
    environment = dict(os.environ)
    if "MUJOCO_GL" not in environment and not environment.get("DISPLAY"):
        environment["MUJOCO_GL"] = "egl"
    backend = environment.get("MUJOCO_GL", "default")
    remedy = "set MUJOCO_GL to egl or osmesa and install its library (libegl1 or libosmesa6); only videos need it"
    command = [sys.executable, "-c", _RENDER]
    try:
        result = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    except subprocess.TimeoutExpired:
        yield Check("rendering", "warn", f"no picture within 60 s (MUJOCO_GL={backend})", remedy)
        return
    if result.returncode == 0:
        yield Check("rendering", "ok", f"MUJOCO_GL={backend}")
    else:
        lines = result.stderr.strip().splitlines() or [f"exit code {result.returncode}"]
        yield Check("rendering", "warn", f"fails with MUJOCO_GL={backend}: {lines[-1]}", remedy)

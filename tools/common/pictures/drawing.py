"""What a film needs, checked before anything moves: a file, a size, packages, and a way to draw."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

from servoid.hw.config import ConfigError

SIZE = (1280, 720)
_DRAW = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).render()"


def prepare(path: Path, size: str) -> tuple[int, int]:
    """Width and height of a film to be written to `path`, `size` being text such as 1280x720.

    Raises ConfigError naming what is in the way, or what is missing.
    """
    _check_new(path)
    chosen = film_size(size, "--video-size")
    choose_filming("--video")
    return chosen


def _check_new(path: Path) -> None:
    """Raise ConfigError where a film cannot be written; an existing file is never overwritten."""
    if path.suffix != ".mp4":
        raise ConfigError(f"--video {path}: give a name that ends in .mp4")
    if path.exists():
        raise ConfigError(f"--video {path}: already exists: choose another name")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        path.unlink()
    except OSError as error:
        raise ConfigError(f"--video {path}: cannot be written ({error.strerror}): give another name") from None


def film_size(text: str, option: str) -> tuple[int, int]:
    """Width and height of `1280x720`. Raises ConfigError naming the option."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise ConfigError(f"{option} {text}: give width and height, such as 1280x720")
    size = int(width), int(height)
    if min(size) < 120 or max(size) > 4096 or any(side % 2 for side in size):
        raise ConfigError(f"{option} {text}: give even numbers from 120 to 4096")
    return size


def choose_filming(what: str) -> None:
    """Find packages and a way to draw a film. Raises ConfigError naming what is missing for `what`."""
    if any(find_spec(name) is None for name in ("av", "matplotlib", "PIL")):
        raise ConfigError(f"{what}: this needs the 'video' extra: pip install 'servoid[video]'")
    import av

    try:
        av.Codec("libx264", "w")
    except av.error.FFmpegError:
        raise ConfigError(f"{what}: the installed 'av' cannot write H.264: pip install --force-reinstall av") from None
    choose_drawing(what)


def choose_drawing(what: str) -> None:
    """Find a way to draw, for MuJoCo to take when it is loaded. Raises ConfigError where there is none for `what`.

    It is tried in a process of its own: some ways that do not work end the process, and none is to be left open while
    a robot runs.
    """
    asked = os.environ.get("MUJOCO_GL")
    ways = (asked,) if asked else ("glfw", "egl", "osmesa") if os.environ.get("DISPLAY") else ("egl", "osmesa")
    for way in ways:
        tried = [sys.executable, "-c", _DRAW]
        try:
            done = subprocess.run(tried, env=os.environ | {"MUJOCO_GL": way}, capture_output=True, timeout=60)
        except subprocess.TimeoutExpired:
            continue
        if done.returncode == 0:
            os.environ["MUJOCO_GL"] = way
            return
    others = " or ".join(f"MUJOCO_GL={way}" for way in ("egl", "osmesa") if way != asked)
    hint = f"try {others}" if asked else "install libegl1 (or libosmesa6)"
    raise ConfigError(f"{what}: cannot draw on this machine with {', '.join(ways)}: {hint}")

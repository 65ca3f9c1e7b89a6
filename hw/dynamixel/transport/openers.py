"""Who else has a serial port open. Linux lets two programs read one port, and each then misses what the other takes."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path

_PROC, _TTYS = Path("/proc"), Path("/sys/class/tty")
_PTMX = ("/dev/ptmx", "/dev/pts/ptmx")  # the other end of every pseudo-terminal


def openers(port: str) -> list[str]:
    """Programs that have the port open, this one apart, as `name (process 1234)`.

    Those of other users are not seen. Whoever serves a pseudo-terminal from its other end is no opener.
    """
    try:
        there = os.stat(port)
    except OSError:
        return []
    path = Path(os.path.realpath(port))
    pseudo = path.parent == Path("/dev/pts")
    if not pseudo and not (_TTYS / path.name).exists():
        return []  # no serial port
    index = os.minor(there.st_rdev) if pseudo else None
    me = os.getpid()
    found = []
    for process in _PROC.iterdir():
        if not process.name.isdigit() or int(process.name) == me:
            continue
        with suppress(OSError):  # it ended, or is another user's
            if _has(process, there.st_rdev, index):
                found.append(f"{_command(process)} (process {process.name})")
    return sorted(found)


def _has(process: Path, device: int, index: int | None) -> bool:
    """Whether a process has the character device `device` open, without serving the pseudo-terminal `index` itself."""
    has = False
    for link in (process / "fd").iterdir():
        with suppress(OSError):  # it was closed meanwhile
            target = os.readlink(link)
            if not target.startswith("/dev/"):
                continue
            if index is not None and target in _PTMX and _serves(process, link.name, index):
                return False
            there = os.stat(link)
            has |= stat.S_ISCHR(there.st_mode) and there.st_rdev == device
    return has


def _serves(process: Path, number: str, index: int) -> bool:
    lines = (process / "fdinfo" / number).read_text().splitlines()
    return any(line.split() == ["tty-index:", str(index)] for line in lines)


def _command(process: Path) -> str:
    """The program as a person started it: an interpreter's script rather than the interpreter."""
    words = (process / "cmdline").read_bytes().decode(errors="replace").split("\0")
    scripts = [word for word in words[1:] if word and not word.startswith("-")]
    name = Path(words[0]).name
    if name.startswith("python") and "-m" in words[1:-1]:
        return f"{name} -m {words[words.index('-m') + 1]}"
    if name.startswith("python") and scripts and "-c" not in words:
        return Path(scripts[0]).name
    return name or (process / "comm").read_text().strip()

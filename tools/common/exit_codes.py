"""Exit codes of the `servoid` command, in one place."""

from __future__ import annotations

import os

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import BackendError

DONE = 0  # and, for `run`, the task's goal met
FAILED = 1  # the task failed: fell or ran out of time
USAGE = 2  # usage or configuration
HARDWARE = 3  # hardware or bus
STOPPED = 4  # the guard stopped the run
INTERNAL = 70  # an error of the program itself
INTERRUPTED = 130  # Ctrl-C

# Modules that come with an extra of the package, by their import names.
_EXTRAS = {
    "av": "video",
    "matplotlib": "video",
    "rsl_rl": "train",
    "tensordict": "train",
    "tensorboard": "train",
    "pyarrow": "train",
    "viser": "page",
    "trimesh": "page",
    "websockets": "page",
}


def exit_code(error: BaseException) -> int:
    """The exit code that an exception ends the program with."""
    if isinstance(error, ConfigError):
        return USAGE
    if _missing_extra(error) or _of_a_file(error):
        return USAGE
    if isinstance(error, BackendError):
        return HARDWARE
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED
    return INTERNAL


def explain(error: BaseException) -> str:
    """One line about an exception, for the person who typed the command."""
    if isinstance(error, KeyboardInterrupt):
        return str(error) or "interrupted"
    text = " ".join(str(error).split())
    if isinstance(error, ConfigError | BackendError):
        return text
    extra = _missing_extra(error)
    if extra:
        return f"this needs the '{extra}' extra ({text}): pip install 'servoid[{extra}]'"
    if isinstance(error, OSError) and _of_a_file(error):
        return f"{str(error.filename)[:200]}: {error.strerror}: choose another file or folder"
    return f"internal error: {type(error).__name__}: {text} (SERVOID_DEBUG=1 shows where)"


def _of_a_file(error: BaseException) -> bool:
    """Whether the system refused a file that it names: a name that is too long, say, or a disk that is full."""
    return isinstance(error, OSError) and isinstance(error.filename, str | os.PathLike) and error.strerror is not None


def _missing_extra(error: BaseException) -> str | None:
    """The extra that would bring the module whose import failed."""
    if not isinstance(error, ModuleNotFoundError) or not error.name:
        return None
    return _EXTRAS.get(error.name.partition(".")[0])

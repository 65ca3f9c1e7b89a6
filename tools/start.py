"""Where the `servoid` command starts: Ctrl-C is handled before anything else is imported."""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # the module `signal` itself takes a while to import
import os
import sys
from importlib.util import find_spec

INTERRUPTED = 130  # as in tools.common.exit_codes, which is not imported yet
_SIGINT = 2


def main() -> int:
    """Run the command line and return its exit code."""
    if _signal.getsignal(_SIGINT) is _signal.default_int_handler:  # else somebody wants Ctrl-C to be ignored
        _signal.signal(_SIGINT, _leave)
    try:
        from servoid.hw.signals import ignore_interrupts, raise_interrupts

        _name_glfw()
        from servoid.tools.cli import main as command

        if _signal.getsignal(_SIGINT) is _leave:
            raise_interrupts()
        code = command()
        ignore_interrupts()
    except KeyboardInterrupt:
        ignore_interrupts()
        print("servoid: interrupted", file=sys.stderr)
        return INTERRUPTED
    return code


def _name_glfw() -> None:
    """Say where the library glfw is, which MuJoCo imports: else a second Python is started to try each that is found,
    and that one answers Ctrl-C with a traceback."""
    package = find_spec("glfw")
    variant = "wayland" if os.environ.get("XDG_SESSION_TYPE") == "wayland" else "x11"
    for folder in (package and package.submodule_search_locations) or ():
        library = os.path.join(folder, variant, "libglfw.so")
        if os.path.exists(library):
            os.environ.setdefault("PYGLFW_LIBRARY", library)


def _leave(number: int, frame: object) -> None:
    """Nothing has begun yet, so there is nothing to close."""
    os.write(2, b"servoid: interrupted\n")
    os._exit(INTERRUPTED)

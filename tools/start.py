"""Where the `servoid` command starts: Ctrl-C is handled before anything else is imported."""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # the module `signal` itself takes a while to import
import os
import sys

INTERRUPTED = 130  # as in tools.common.exit_codes, which is not imported yet
_SIGINT = 2


def main() -> int:
    """Run the command line and return its exit code."""
    if _signal.getsignal(_SIGINT) is _signal.default_int_handler:  # else somebody wants Ctrl-C to be ignored
        _signal.signal(_SIGINT, _leave)
    try:
        from servoid.hw.signals import ignore_interrupts, raise_interrupts
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


def _leave(number: int, frame: object) -> None:
    """Nothing has begun yet, so there is nothing to close."""
    os.write(2, b"servoid: interrupted\n")
    os._exit(INTERRUPTED)

"""Where the `servoid` command begins: Ctrl-C is in good hands before anything else is imported."""

from __future__ import annotations

import sys

from servoid.hw.signals import ignore_interrupts, raise_interrupts

INTERRUPTED = 130  # as in tools.common.exit_codes, which is not imported yet


def main() -> int:
    """Run the command line and return its exit code."""
    try:
        raise_interrupts()
        from servoid.tools.cli import main as command

        code = command()
        ignore_interrupts()
    except KeyboardInterrupt:
        ignore_interrupts()
        print("servoid: interrupted", file=sys.stderr)
        return INTERRUPTED
    return code

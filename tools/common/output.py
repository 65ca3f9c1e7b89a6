"""What a command prints. With `--json`, standard output is one line, one JSON object; the rest goes to standard error.

with reporting(args.json) as report:
    report.line("walking ...")               # standard error with --json
    report.result({"success_rate": 0.97})    # one line with --json, nothing otherwise
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import io
import json
import math
import os
import select
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TextIO

from servoid.hw.config import ConfigError
from servoid.tools.common.exit_codes import exit_code, explain


class Report:
    """Where a command's lines and its result go."""

    def __init__(self, as_json: bool, stdout: TextIO) -> None:
        self.as_json = as_json
        self.has_result = False
        self._stdout = stdout

    def line(self, text: str = "") -> None:
        """A line for a person."""
        say(text, sys.stderr if self.as_json else self._stdout)

    @property
    def columns(self) -> int | None:
        """Width of the terminal that lines go to, as it is now; None where they go elsewhere."""
        return columns(sys.stderr if self.as_json else self._stdout)

    def table(self, head: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
        """A table for a person, columns aligned."""
        text = [[str(cell) for cell in row] for row in (head, *rows)]
        widths = [max(len(row[i]) for row in text) for i in range(len(head))]
        for row in text:
            self.line("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())

    def result(self, values: dict[str, Any]) -> None:
        """The result: the one line of `--json`. Call it once. Without `--json` it prints nothing."""
        if self.has_result:
            raise RuntimeError("a command has one result")
        self.has_result = True
        if self.as_json:
            say(to_json(values), self._stdout)


def say(text: str, stream: TextIO) -> None:
    """Print a line. Once a terminal was closed, or went with an ssh connection, nothing is printed: what remains to be
    done is done all the same."""
    encoding = stream.encoding or "utf-8"
    text = text.encode(encoding, "backslashreplace").decode(encoding)  # names of files may be no text
    try:
        print(text, file=stream, flush=True)
    except OSError as error:
        if error.errno != errno.EIO:
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())  # Python writes once more at exit


def columns(stream: TextIO) -> int | None:
    """Width of the terminal behind a stream, as it is now; None where there is none, or it does not say."""
    if not stream.isatty():
        return None
    try:
        return os.get_terminal_size(stream.fileno()).columns or None
    except OSError:  # a terminal in memory
        return None


class Screen:
    """A stream that nobody waits for, for the line that is rewritten while a control loop runs.

    What it does not take at once is left out: a terminal that Ctrl-S stopped, or an ssh connection that hangs. When a
    write fails, because the reader is gone, nothing is written any more. `rewrites`: whether a line can be written
    over, which it cannot in a file, a pipe or a terminal that is dumb.
    """

    def __init__(self, stream: TextIO, term: str | None = None) -> None:
        """`term` is the kind of terminal, that of the environment unless given."""
        dumb = (os.environ.get("TERM") if term is None else term) in ("dumb", "unknown")
        self.tty = stream.isatty()
        self.rewrites = self.tty and not dumb
        self._stream: TextIO | None = stream
        self._shown = 0  # columns of the line that can be written over

    def rewrite(self, text: str) -> None:
        """Write over the line that stands there; what does not fit the terminal as it is now is cut off."""
        room = self.columns
        text = text[:room]
        if self.write("\r" + text.ljust(min(self._shown, room))):
            self._shown = len(text)

    @property
    def columns(self) -> int:
        """What a line that is rewritten may take: a full one would go on in the next."""
        return max((columns(self._stream) if self._stream is not None else None) or 80, 2) - 1

    def clear(self) -> None:
        """Take away the line that was rewritten."""
        if self._shown:
            self.write("\r" + " " * self._shown + "\r")
        self._shown = 0

    def end(self) -> None:
        """Leave the line that was rewritten standing."""
        if self._shown:
            self.write("\n")
        self._shown = 0

    def write(self, text: str) -> bool:
        """Write a line at most, to be seen at once; whether it was."""
        if self._stream is None or not _takes(self._stream):
            return False
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError:  # the robot goes on without it
            self._stream = None
        return self._stream is not None


class Progress:
    """How far something is that takes a while: call it with how much of how much is done.

    A terminal's line is rewritten; elsewhere a line comes at first, and every ten seconds.
    """

    def __init__(self, what: str, stream: TextIO | None = None, term: str | None = None) -> None:
        """`what` is being done, such as "filming"; `stream` is standard error unless given."""
        self._what, self._screen = what, Screen(stream or sys.stderr, term)
        self._began, self._shown = time.monotonic(), -math.inf

    def __call__(self, done: int, total: int) -> None:
        now = time.monotonic()
        if now - self._shown < (0.2 if self._screen.rewrites else 10.0):
            return
        self._shown = now
        left = f", {(now - self._began) / done * (total - done):.0f} s left" if done else ""
        text = f"{self._what}: {100 * done // max(total, 1)} % of {total}{left}"
        if self._screen.rewrites:
            self._screen.rewrite(text)
        else:
            self._screen.write(text + "\n")

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self._screen.clear()


def _takes(stream: TextIO) -> bool:
    """Whether a stream takes a line without waiting. A terminal or a pipe that takes anything has room for one."""
    try:
        descriptor = stream.fileno()
    except (AttributeError, OSError):  # in memory
        return True
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    return any(events & select.POLLOUT for _, events in poll.poll(0))


@contextlib.contextmanager
def reporting(as_json: bool) -> Iterator[Report]:
    """A report. With `as_json`, whatever else prints to standard output meanwhile goes to standard error.

    That holds for other languages and child processes too, where standard output is a real file. A command that
    raises still answers, with `{"error": ..., "exit_code": ...}`, and the exception goes on.
    """
    if not as_json:
        yield Report(False, sys.stdout)
        return
    with contextlib.ExitStack() as stack:
        report = Report(True, stack.enter_context(_claim_stdout()))
        stack.enter_context(contextlib.redirect_stdout(sys.stderr))
        try:
            yield report
        except BaseException as error:
            if not report.has_result and not isinstance(error, SystemExit | GeneratorExit):
                report.result({"error": explain(error), "exit_code": exit_code(error)})
            raise


@contextlib.contextmanager
def _claim_stdout() -> Iterator[TextIO]:
    """Standard output as it was, with file descriptor 1 pointing to standard error meanwhile."""
    try:
        descriptor, other = sys.stdout.fileno(), sys.stderr.fileno()
    except (AttributeError, io.UnsupportedOperation):  # a capture in memory: there is no descriptor to move
        yield sys.stdout
        return
    sys.stdout.flush()
    saved = os.dup(descriptor)
    os.dup2(other, descriptor)
    try:
        with os.fdopen(os.dup(saved), "w", encoding="utf-8") as stream:
            yield stream
    finally:
        sys.stdout.flush()
        os.dup2(saved, descriptor)
        os.close(saved)


def to_json(values: Any) -> str:
    """One line of standard JSON; numpy values become plain, and what is not finite becomes null."""
    return json.dumps(_plain(values), allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):  # numpy arrays and numbers
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    return value


def add_json_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")


def check_writable(path: Path) -> None:
    """Raise ConfigError where a file cannot be written, before the work begins whose outcome it is for. What is there
    stays as it is."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        new = not path.exists()
        path.open("ab").close()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror}): choose another place with --out") from None
    if new:
        path.unlink()

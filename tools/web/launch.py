"""Starts the page in a process of its own, and the options that commands have for it."""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import select
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from servoid.hw.config import ConfigError
from servoid.tools.common.output import Report
from servoid.tools.web.browser.access import Access
from servoid.tools.web.line.link import PageLink

START_SECONDS = 120.0  # for the page to come up on a busy machine
END_SECONDS = 10.0  # for it to go away when its program is done
PORT, FOXGLOVE_PORT = 8080, 8765
STOPS = "its stop button is never the only one: keep a hand on the robot's own, or on Ctrl-C"


@dataclass(frozen=True)
class View:
    """Where the page shall be. Raises ConfigError for a host that is none."""

    host: str = "127.0.0.1"
    port: int = PORT
    foxglove: int | None = None  # port at which the run is served to Foxglove's own application, too

    def __post_init__(self) -> None:
        Access.at(self.host)
        if not 0 <= self.port < 65536:
            raise ConfigError(f"--view-port {self.port}: give a number from 0 (any that is free) to 65535")
        if self.foxglove is not None:
            if not 0 <= self.foxglove < 65536:
                raise ConfigError(f"--foxglove {self.foxglove}: give a number from 0 (any that is free) to 65535")
            if importlib.util.find_spec("foxglove") is None:
                raise ConfigError("--foxglove needs the 'foxglove' extra: pip install 'servoid[foxglove]'")


def add_view_arguments(parser: argparse.ArgumentParser, *, switch: bool = True) -> None:
    """`--view`, unless the command always has the page, and where it is."""
    if switch:
        parser.add_argument("--view", action="store_true", help="show the robot in a browser, at the address printed")
    parser.add_argument(
        "--view-host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="address of the page; where other machines reach it, a token is printed (default: %(default)s)",
    )
    parser.add_argument(
        "--view-port", type=int, default=PORT, metavar="N", help="port of the page; 0: any that is free (default: 8080)"
    )


def add_foxglove_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--foxglove",
        type=int,
        nargs="?",
        const=FOXGLOVE_PORT,
        metavar="PORT",
        help=f"serve the run to Foxglove's own application on this machine, too (default: {FOXGLOVE_PORT})",
    )


def view_of(args: argparse.Namespace) -> View:
    return View(args.view_host, args.view_port, vars(args).get("foxglove"))


def tell_page(report: Report, page: OpenPage) -> None:
    """Where the page is, and that it is not the only stop."""
    report.line(f"page: {page.url}  ({STOPS})")
    if page.foxglove is not None:
        report.line(f"Foxglove: open a connection to {page.foxglove}")


def check_installed() -> None:
    """Raise ConfigError where the page's packages are missing."""
    if importlib.util.find_spec("viser") is None:
        raise ConfigError("the page needs the 'page' extra: pip install 'servoid[page]'")


@dataclass(frozen=True)
class OpenPage:
    """A page that is open: its line to the loop, and its address."""

    link: PageLink
    url: str
    foxglove: str | None = None  # where Foxglove connects to


@contextlib.contextmanager
def open_page(view: View, robot: str, tasks: Sequence[dict[str, str]] = ()) -> Iterator[OpenPage]:
    """A page for a robot, by name or file, until it is left. `tasks` (name, description) can be started from it.

    Raises ConfigError where it cannot be opened: no packages, no port, a robot that cannot be drawn.
    """
    check_installed()
    access = Access.at(view.host)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    settings = {
        "fd": theirs.fileno(),
        "robot": robot,
        "host": view.host,
        "port": view.port,
        "token": access.token,
        "tasks": list(tasks),
        "foxglove": view.foxglove,
    }
    with theirs:
        process = subprocess.Popen(
            [sys.executable, "-m", "servoid.tools.web.browser.process", json.dumps(settings)],
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
        )
    link = PageLink(ours)
    try:
        yield OpenPage(link, *_addresses(process))
    finally:
        link.close()
        _end(process)


def _addresses(process: subprocess.Popen[bytes]) -> tuple[str, str | None]:
    """What the process says first."""
    assert process.stdout is not None
    with process.stdout as stream:
        ready, _, _ = select.select([stream], [], [], START_SECONDS)
        line = stream.readline() if ready else b""
    try:
        answer = json.loads(line)
    except ValueError:
        raise ConfigError("the page did not start: its error is above") from None
    if "error" in answer:
        raise ConfigError(answer["error"])
    return str(answer["url"]), answer["foxglove"]


def _end(process: subprocess.Popen[bytes]) -> None:
    try:
        process.wait(END_SECONDS)
    except subprocess.TimeoutExpired:  # it holds nothing that matters
        process.kill()
        process.wait()

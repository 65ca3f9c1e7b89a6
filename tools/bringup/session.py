"""A verb of bring-up at its desk: the terminal, or with `--view` the page, where the other verbs are a button away."""

from __future__ import annotations

import argparse
import copy
import importlib
import select
from collections.abc import Callable
from typing import TYPE_CHECKING

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import BackendError
from servoid.hw.robot.description import Robot, load_robot
from servoid.tools.bringup.desk.terminal import Desk
from servoid.tools.bringup.line import is_virtual
from servoid.tools.common import exit_codes
from servoid.tools.common.output import reporting
from servoid.tools.common.prompt import Cancelled
from servoid.tools.web.launch import open_page, tell_page, view_of

if TYPE_CHECKING:
    from servoid.tools.web.line.link import PageLink
    from servoid.tools.web.line.panel import Item

Work = Callable[[argparse.Namespace, Desk], int]
LOOK = 1.0  # s between two looks whether the page is still there
ENDED = "The program was ended."


def at_desk(args: argparse.Namespace, verb: str, work: Work) -> int:
    """Do a verb's work where its person is; its exit code."""
    with reporting(args.json) as report:
        if not args.view:
            return work(args, Desk(report))
        is_virtual(args)  # refuses a port that is missing
        robot = load_robot(args.robot)
        with open_page(view_of(args), args.robot) as page:
            tell_page(report, page)
            session = Session(page.link, args, robot, verb)
            try:
                session.run()
            except KeyboardInterrupt:
                report.line("ended by Ctrl-C")
            report.result({"verbs": session.done})
    return exit_codes.DONE


class Session:
    """Verbs one after another, as the person at the page asks. `done` are those that were begun, and how each ended."""

    def __init__(self, link: PageLink, args: argparse.Namespace, robot: Robot, verb: str) -> None:
        from servoid.tools.bringup.desk.page import PageDesk

        self._link, self._args, self._robot, self._verb = link, args, robot, verb
        self._running: str | None = None
        self._desk = PageDesk(link, robot, self._controls)
        joint = args.joint if verb == "jog" else robot.names[0]
        self._desk.settings = {"joint": joint, "pose": args.pose if verb == "calibrate" else "zero"}
        self.done: list[tuple[str, str]] = []

    def run(self) -> None:
        """Until there is no page any more. Raises KeyboardInterrupt for a Ctrl-C that was not the page's."""
        self._desk.title = f"bring-up of {self._robot.name} at {self._args.port}"
        wanted: str | None = self._verb
        while self._link.alive:
            if wanted in VERBS:
                self._work(wanted)
            wanted = self._next()

    def _next(self) -> str | None:
        """The verb that is asked for next; None where there is no page any more."""
        desk = self._desk
        self._link.take_halt()  # nothing goes on that it could be for
        desk.show()
        while self._link.alive:
            desk.gather()
            if desk.wanted is not None:
                wanted, desk.wanted = desk.wanted, None
                return wanted
            if self._link.alive:
                select.select([self._link], [], [], LOOK)
        return None

    def _work(self, verb: str) -> None:
        from servoid.tools.web.line.snapshot import RunInfo

        desk, link = self._desk, self._link
        desk.report.clear()
        self._running = verb
        link.begin(RunInfo(self._args.robot, verb, str(self._args.port), "", simulated=False))
        desk.show()
        outcome, text = "error", ENDED
        try:
            module = importlib.import_module(f"servoid.tools.bringup.{VERBS[verb]}")
            code = int(module.work(self._arguments(verb), desk))
            outcome, text = ("done", "") if code == exit_codes.DONE else ("failed", "")
        except Cancelled as error:
            outcome, text = "ended", str(error).capitalize() + "."
        except KeyboardInterrupt:
            if not link.read().halt:
                raise
            outcome, text = "ended", "Stopped at the page."
        except (ConfigError, BackendError) as error:
            text = exit_codes.explain(error)
        finally:
            self._running = None
            self.done.append((verb, outcome))
            link.end(outcome, text)

    def _arguments(self, verb: str) -> argparse.Namespace:
        """What the verb would have been told at the terminal."""
        if VERBS[verb] == self._verb:
            args = copy.copy(self._args)
        else:
            parser = argparse.ArgumentParser()
            module = importlib.import_module(f"servoid.tools.bringup.{VERBS[verb]}")
            module.add_arguments(parser)
            joint = [self._desk.settings["joint"]] if verb == "jog" else []
            args = parser.parse_args([*joint, "--port", str(self._args.port), "--robot", str(self._args.robot)])
        chosen = self._desk.settings
        if VERBS[verb] == "check":
            args.fix = verb == "fix" or (not self.done and args.fix)  # the first time, as the command line says
        elif verb == "jog":
            args.joint = chosen["joint"]
        elif verb == "calibrate":
            args.pose = chosen["pose"]
        return args

    def _controls(self) -> tuple[Item, ...]:
        from servoid.tools.bringup.desk.page import verbs

        settings = self._desk.settings
        return verbs(self._running, self._robot.names, settings["joint"], settings["pose"])


VERBS = {  # and the module of each
    "scan": "scan",
    "check": "check",
    "fix": "check",
    "calibrate": "calibrate",
    "jog": "jog",
    "watch": "watch",
}

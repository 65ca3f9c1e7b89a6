"""Control a robot from a page in the browser: start and stop tasks, steer, and see what it does.

Prints the page's address and runs until Ctrl-C. Whoever is in control there starts tasks; the robot comes to rest when
nobody is heard for 0.3 s and is lowered after 2 s. Each run writes a flight log, unless the page says otherwise. The
page is never the only stop: keep a hand on the robot's own, or on Ctrl-C here.
"""

from __future__ import annotations

import argparse
import select
from pathlib import Path
from typing import TYPE_CHECKING

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import BackendError
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report, add_json_argument, reporting
from servoid.tools.common.parser import add_gain_argument, add_recover_argument, check_seed
from servoid.tools.common.prompt import confirm
from servoid.tools.web.launch import add_foxglove_argument, add_view_arguments, open_page, tell_page, view_of

if TYPE_CHECKING:
    from servoid.tools.web.line.link import PageLink
    from servoid.tools.web.line.messages import PageRequest

LOOK = 1.0  # s between two looks whether the page is still there


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--backend", default="sim", metavar="NAME", help="sim, virtual or dynamixel (default: sim)")
    parser.add_argument("--port", metavar="PATH", help="serial port of the robot (--backend dynamixel)")
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    parser.add_argument("--policy", default="diffusion", metavar="NAME|FILE", help="controller (default: diffusion)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed of the first run (default: 0)")
    add_gain_argument(parser)
    add_recover_argument(parser)
    parser.add_argument("--start", action="store_true", help="let a real robot move without asking here first")
    parser.add_argument("--logs", type=Path, default=Path("runs"), metavar="FOLDER", help="flight logs (default: runs)")
    add_view_arguments(parser, switch=False)
    add_foxglove_argument(parser)
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        check_seed(args.seed)
        from servoid.hw.robot.description import load_robot
        from servoid.stack.runtime.backends import backend_kind
        from servoid.stack.tasks import find, names

        robot = load_robot(args.robot)
        tasks = [{"name": name, "description": find(name).description} for name in names()]
        if not backend_kind(args.backend).simulated and not args.start:
            confirm(f"{robot.name} will move when somebody at the page starts a task", "give --start to let it move")
        with open_page(view_of(args), args.robot, tasks) as page:
            tell_page(report, page)
            runs = 0
            try:
                while (request := _wait(page.link)) is not None:
                    if any(request.task == task["name"] for task in tasks):  # never a file: it could be anybody's code
                        run_task(report, args, page.link, request, args.seed + runs)
                        runs += 1
            except KeyboardInterrupt:
                report.line("ended by Ctrl-C")
                report.result({"runs": runs})
                return exit_codes.DONE
        report.line("the page has ended: without it nobody can control the robot")
        report.result({"runs": runs})
    return exit_codes.FAILED


def _wait(link: PageLink) -> PageRequest | None:
    """The next wish to start a task; None when there is no page any more."""
    while link.alive:
        request = link.take("start")
        if request is not None:
            return request
        if link.alive:
            select.select([link], [], [], LOOK)
    return None


def run_task(report: Report, args: argparse.Namespace, link: PageLink, request: PageRequest, seed: int) -> None:
    """A run of the task that was asked for. Raises KeyboardInterrupt for a Ctrl-C that was not the page's."""
    from servoid.stack.log.recorder import free_name
    from servoid.stack.runtime.run import RunSettings
    from servoid.tools.web.watched import watched_run

    try:
        settings = RunSettings(
            task=request.task,
            backend=args.backend,
            robot=args.robot,
            policy=args.policy,
            seed=seed,
            gain=args.gain * request.gain,
            set=request.set,
            start=True,  # somebody at the page has just said so
            record=free_name(request.task, args.logs) if request.on else None,
            realtime=True,
            port=args.port,
            recover=args.recover,
        )
        result = watched_run(link, settings, held=True)
    except (ConfigError, BackendError) as error:
        report.line(f"{request.task}: {error}")
        return
    except KeyboardInterrupt:
        if not link.read().halt:
            raise
        report.line(f"{request.task}: stopped before it began")
        return
    kept = "not recorded" if result.log is None else f"log {result.log}"
    report.line(f"{request.task}: {result.outcome} after {result.seconds:.1f} s, {kept}")
    if result.interrupted and not link.read().halt:
        raise KeyboardInterrupt

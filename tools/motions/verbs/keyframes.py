"""Make a motion at the operator's page: pose the robot, set times, play it in physics, and save it as a clip.

Prints the page's address and runs until Ctrl-C. The robot is posed by sliders, by dragging a hand or a foot in the
picture, or by hand: with --port, the joints of a limp robot are read, and nothing is written to them. What is saved is
a clip, and its keyframes as a file that `servoid motions author` and this command read.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from servoid.hw.config import ConfigError, nearest
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot, load_robot
from servoid.tools.common.exit_codes import DONE
from servoid.tools.common.output import Report, add_json_argument, reporting
from servoid.tools.motions.verbs.options import add_out_arguments
from servoid.tools.web.launch import add_view_arguments, open_page, view_of

if TYPE_CHECKING:
    from servoid.tools.motions.editor.editor import Editor


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recipe", nargs="?", metavar="NAME|FILE", help="keyframes to begin with (default: home)")
    parser.add_argument("--clip", metavar="NAME", help="which of its clips (default: the first)")
    parser.add_argument("--port", metavar="PATH|virtual", help="port of a limp robot to be posed by hand")
    add_out_arguments(parser)
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    add_view_arguments(parser, switch=False)
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Raises ConfigError."""
    with reporting(args.json) as report:
        from servoid.tools.motions.editor.editor import Editor
        from servoid.tools.motions.editor.page import KeyframePage

        robot = load_robot(args.robot)
        editor = Editor(robot, args.out, replaces=args.replace)
        begin(editor, args.recipe, args.clip)
        with limp(args, robot, report) as read, open_page(view_of(args), args.robot) as page:
            report.line(f"page: {page.url}")
            try:
                KeyframePage(page.link, editor, args.robot, read).run()
            except KeyboardInterrupt:
                report.line("ended by Ctrl-C")
        report.result({"keyframes": len(editor.frames), "saved": editor.saved})
    return DONE


def begin(editor: Editor, recipe: str | None, clip: str | None) -> None:
    """Begin with keyframes that there are. Raises ConfigError where there are none of that name."""
    from servoid.tools.motions.keyframes import load_authored

    if recipe is None:
        if clip is not None:
            raise ConfigError("--clip: name the file that it is in, too")
        return
    authored = load_authored(recipe)
    found = {one.name: one for one in authored.clips}
    name = clip or authored.clips[0].name
    if name not in found:
        raise ConfigError(f"--clip {name}: {nearest(name, found)}")
    if found[name].after is not None:
        raise ConfigError(f"--clip {name}: it begins where '{found[name].after}' ends: here, motions begin at home")
    editor.load(found[name], authored.licence)


@contextmanager
def limp(args: argparse.Namespace, robot: Robot, report: Report) -> Iterator[Callable[[], Array] | None]:
    """What reads the joints of a limp robot; None without a port. Raises BackendError where it is not limp."""
    if args.port is None:
        yield None
        return
    import numpy as np

    from servoid.hw.dynamixel.servos.bus_scan import BAUDS
    from servoid.hw.dynamixel.servos.register_check import find_servos
    from servoid.hw.dynamixel.transport.bus import LONGEST_RETURN_DELAY
    from servoid.tools.bringup.calibrate import refuse
    from servoid.tools.bringup.calibration.encoders import Encoders
    from servoid.tools.bringup.line import assembled, open_line
    from servoid.tools.bringup.scan import powered

    robot = assembled(args, report)
    direction = np.array([joint.direction for joint in robot.joints])
    zero = np.array([joint.zero for joint in robot.joints])
    with open_line(args, robot) as line:
        powered(line.bus, robot, BAUDS)
        line.bus.return_delay = LONGEST_RETURN_DELAY  # until the servos' own is known
        found = find_servos(line.bus, robot)
        refuse(found)
        encoders = Encoders(line.bus, line.clock, robot, found)
        yield lambda: direction * encoders.read() + zero

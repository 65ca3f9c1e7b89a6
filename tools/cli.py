"""The `servoid` command. A verb's module is imported only when the verb is called, so that `--help` is quick."""

from __future__ import annotations

import argparse
import importlib
import os
import select
import signal
import sys
import traceback
from dataclasses import dataclass, field
from importlib import metadata
from textwrap import fill

from servoid.hw.signals import ignore_interrupts
from servoid.tools.common import exit_codes
from servoid.tools.common.output import say
from servoid.tools.common.parser import Parser, suggestion


@dataclass(frozen=True)
class Verb:
    """A verb: the module that has `add_arguments(parser)` and `main(args) -> int`, or verbs of its own."""

    help: str
    module: str = ""
    verbs: dict[str, Verb] = field(default_factory=dict)


VERBS: dict[str, Verb] = {
    "tasks": Verb("list tasks and their settings", "servoid.tools.commands.tasks"),
    "doctor": Verb("check that this machine is ready", "servoid.tools.commands.doctor"),
    "run": Verb("run a task on a robot", "servoid.tools.commands.run"),
    "operate": Verb("control a robot from a page in the browser", "servoid.tools.web.operate"),
    "rollout": Verb("run a task many times in simulation and measure it", "servoid.tools.commands.rollout"),
    "virtual": Verb("serve a virtual rig on a serial port", "servoid.tools.commands.virtual"),
    "bringup": Verb(
        "bring up hardware, step by step",
        verbs={
            "find-port": Verb("find the robot's serial port", "servoid.tools.bringup.find_port"),
            "scan": Verb("list the servos and boards on the bus", "servoid.tools.bringup.scan"),
            "setup": Verb("set a servo's ID and baud", "servoid.tools.bringup.setup"),
            "check": Verb("compare every servo with the robot's file", "servoid.tools.bringup.check"),
            "off": Verb("switch torque off", "servoid.tools.bringup.off"),
            "calibrate": Verb("measure zeros and directions, by hand", "servoid.tools.bringup.calibrate"),
            "jog": Verb("move one joint slowly, a little", "servoid.tools.bringup.jog"),
            "watch": Verb("show temperatures, voltages, loads and the bus", "servoid.tools.bringup.watch"),
        },
    ),
    "motions": Verb(
        "make, list, play, film, check, mirror and blend clips",
        verbs={
            "import": Verb("make clips from a file", "servoid.tools.motions.verbs.import_clip"),
            "author": Verb("make clips from keyframes", "servoid.tools.motions.verbs.author"),
            "keyframes": Verb("make a clip at the page, by hand", "servoid.tools.motions.verbs.keyframes"),
            "retarget": Verb("put a person's motion on the robot", "servoid.tools.motions.verbs.retarget"),
            "list": Verb("list the clips of a library", "servoid.tools.motions.verbs.list_clips"),
            "play": Verb("play a clip open loop in physics", "servoid.tools.motions.verbs.play"),
            "film": Verb("film clips, or draw strips of them", "servoid.tools.motions.verbs.film"),
            "check": Verb("check joint ranges, speeds and feet of clips", "servoid.tools.motions.verbs.check"),
            "mirror": Verb("swap left and right", "servoid.tools.motions.verbs.mirror"),
            "blend": Verb("join two clips", "servoid.tools.motions.verbs.blend"),
        },
    ),
    "dataset": Verb(
        "look at a dataset, or make one of recorded runs",
        verbs={
            "show": Verb("show what a dataset holds", "servoid.tools.learn.dataset.show"),
            "add": Verb("make a dataset of recorded runs, or add to one", "servoid.tools.learn.dataset.add"),
        },
    ),
    "skills": Verb("list skills, or explain one", "servoid.tools.commands.skills"),
    "robot": Verb(
        "describe a robot of your own",
        verbs={
            "import": Verb("draft a robot's file from an MJCF or URDF", "servoid.tools.robots.import_robot"),
            "check": Verb("compare a robot's file with its model", "servoid.tools.robots.check"),
        },
    ),
    "tune": Verb(
        "search for what suits a robot best",
        verbs={
            "gait": Verb("search for the steps that a robot walks best by", "servoid.tools.robots.tune_gait"),
            "kick": Verb("search for a harder kick that stays on its feet", "servoid.tools.robots.tune_kick"),
        },
    ),
    "identify": Verb("measure what a robot's servos are like, on a gantry", "servoid.tools.identify"),
    "collect": Verb("record demonstrations as a dataset", "servoid.tools.learn.collect"),
    "train": Verb(
        "train a network",
        verbs={
            "tracker": Verb("train the tracker of gait and clips with PPO", "servoid.tools.learn.trainers.tracker"),
            "odometry": Verb("train the correction of leg odometry", "servoid.tools.learn.trainers.odometry"),
            "latent": Verb(
                "train latent actions for a diffusion model to plan in", "servoid.tools.learn.trainers.latent"
            ),
            "diffusion": Verb("train the diffusion model", "servoid.tools.learn.trainers.diffusion"),
            "prior": Verb("train a motion prior", "servoid.tools.learn.trainers.prior"),
            "policy": Verb("train a policy for a task under a motion prior", "servoid.tools.learn.trainers.policy"),
            "planner": Verb("train the planner of whole-body motion", "servoid.tools.learn.trainers.planner"),
        },
    ),
    "evaluate": Verb("measure a policy as papers do, or as you define", "servoid.tools.commands.evaluate"),
    "bench": Verb(
        "measure speed, and how faults are handled",
        verbs={
            "text-to-motion": Verb(
                "measure how well a planner's motions go with sentences", "servoid.tools.bench.text_to_motion"
            ),
            "sim": Verb("compare the training world with raw MuJoCo", "servoid.tools.bench.sim"),
            "policy": Verb("time the diffusion policy's plans", "servoid.tools.bench.policy"),
            "guidance": Verb("compare ways to guide a planner", "servoid.tools.bench.planning.guidance"),
            "ideal": Verb("bound the returns of learned tasks by the robot's limits", "servoid.tools.learn.envs.ideal"),
            "loop": Verb("measure how late the control loop is", "servoid.tools.bench.loop"),
            "kill": Verb("kill the controller and check the servo state after", "servoid.tools.faults.kill"),
            "interrupt": Verb(
                "press Ctrl-C at any instant and check that torque is off", "servoid.tools.faults.interrupt"
            ),
            "operator": Verb("press stop, or lose who steers: when the robot rests", "servoid.tools.faults.operator"),
            "bus": Verb("time a control cycle on the servo bus", "servoid.tools.bench.bus"),
            "clients": Verb("check other people's clients against the virtual rig", "servoid.tools.bench.clients"),
            "identify": Verb("identify virtual rigs with hidden servos", "servoid.tools.bench.identify"),
            "faults": Verb("inject every fault while the robot walks", "servoid.tools.faults.campaign"),
            "soak": Verb("walk for minutes over a line that loses packets", "servoid.tools.faults.soak"),
            "fuzz": Verb("feed random bytes to everything that reads bytes", "servoid.tools.faults.fuzz"),
        },
    ),
    "view": Verb("look at a recorded run in the browser", "servoid.tools.web.view"),
    "replay": Verb("repeat a recorded run and compare", "servoid.tools.commands.replay"),
    "export": Verb("write a recorded run as CSV or Parquet", "servoid.tools.commands.export"),
    "onnx": Verb("write a diffusion policy for ONNX Runtime alone", "servoid.tools.commands.onnx_policy"),
    "plot": Verb("draw a recorded run", "servoid.tools.commands.plot"),
    "completion": Verb("print what completes commands in a shell", "servoid.tools.completion"),
}


def main(argv: list[str] | None = None) -> int:
    """Run the command line `argv` and return its exit code."""
    debug = os.environ.get("SERVOID_DEBUG") == "1"
    try:
        code = _dispatch("servoid", VERBS, sys.argv[1:] if argv is None else argv)
        sys.stdout.flush()
        return code
    except SystemExit as stop:  # argparse: help or a usage error
        return stop.code if isinstance(stop.code, int) else exit_codes.DONE
    except BaseException as error:
        ignore_interrupts()
        if isinstance(error, BrokenPipeError) and _reader_left():
            return 128 + signal.SIGPIPE
        if debug:
            traceback.print_exc()
        for note in vars(error).get("__notes__", ()):  # a table, say: what the message is about
            say(note, sys.stderr)
        say(f"servoid: {exit_codes.explain(error)}", sys.stderr)
        return exit_codes.exit_code(error)


def _reader_left() -> bool:
    """Whether standard output's reader is gone (`servoid ... | head`), rather than some other pipe's."""
    try:
        descriptor = sys.stdout.fileno()
    except (AttributeError, OSError):  # captured in memory
        return False
    poll = select.poll()
    poll.register(descriptor, 0)  # errors are reported unasked: a pipe without a reader is one
    if not any(events & (select.POLLERR | select.POLLHUP) for _, events in poll.poll(0)):
        return False
    # Python flushes once more at exit and would complain: let that go nowhere.
    os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)
    return True


def _dispatch(prog: str, verbs: dict[str, Verb], argv: list[str]) -> int:
    if not argv or argv[0].startswith("-"):
        _overview(prog, verbs).parse_args(argv)
        _overview(prog, verbs).error(f"command missing; known: {', '.join(verbs)}")
    name, rest = argv[0], argv[1:]
    if name not in verbs:
        near = suggestion(name, verbs) or f"; known: {', '.join(verbs)}"
        _overview(prog, verbs).error(f"unknown command '{name}'{near}")
    verb = verbs[name]
    if verb.verbs:
        return _dispatch(f"{prog} {name}", verb.verbs, rest)
    args = parser_of(f"{prog} {name}", verb).parse_args(rest)
    return int(importlib.import_module(verb.module).main(args))


def parser_of(prog: str, verb: Verb) -> Parser:
    """The parser of a verb that has a module."""
    module = importlib.import_module(verb.module)
    parser = Parser(prog=prog, description=(module.__doc__ or "").strip(), formatter_class=_Formatter)
    module.add_arguments(parser)
    return parser


class _Formatter(argparse.RawDescriptionHelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=32)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        """Paragraphs wrapped to the terminal; those with an indented line stay as they are."""
        paragraphs = (part if "\n " in part else fill(part, width) for part in text.split("\n\n"))
        return "\n\n".join(paragraphs)


def _overview(prog: str, verbs: dict[str, Verb]) -> Parser:
    """The parser of a command that only has verbs: it answers `--help` and, at the top, `--version`."""
    width = max(map(len, verbs))
    lines = "\n".join(f"  {name:<{width}}  {verb.help}" for name, verb in verbs.items())
    parser = Parser(
        prog=prog,
        usage=f"{prog} COMMAND ...",
        description=f"commands:\n{lines}",
        epilog=f"{prog} COMMAND --help explains a command.",
        formatter_class=_Formatter,
    )
    if prog == "servoid":
        parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    return parser


class _Version(argparse.Action):
    """Looks the version up only when asked."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        print(f"servoid {metadata.version('servoid')}")
        parser.exit()


if __name__ == "__main__":
    sys.exit(main())

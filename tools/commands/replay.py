"""Repeat a recorded simulated run and say whether it comes out identical.

Runs the log's configuration and seed again, without its observations, and compares every observation, state, command,
plan and event bit by bit. A planner gets its settings from the log, not from the file that they came from.
Exit code 0: identical; 1: it differs, and the first difference is named.
"""

from __future__ import annotations

import argparse
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError, from_values
from servoid.stack.log.flightlog import FlightLog, read_log
from servoid.stack.log.format import MACHINE_DEPENDENT, event_message, messages, plain, read_intent
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.backends import BACKENDS
from servoid.stack.runtime.phases import DONE
from servoid.stack.runtime.run import RunSettings, Script, run
from servoid.stack.safety.event import Event
from servoid.tools.common import exit_codes
from servoid.tools.common.output import add_json_argument, reporting
from servoid.tools.common.pictures.flightpath import got_up

if TYPE_CHECKING:
    from servoid.stack.control.policies import PlannerSettings

Tick = dict[str, list[dict[str, Any]]]  # channel -> its messages of one tick


@dataclass(frozen=True)
class Divergence:
    tick: int
    channel: str
    field: str

    def __str__(self) -> str:
        return f"tick {self.tick}: {self.channel} {self.field}"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, metavar="LOG", help="flight log of a simulated run (.mcap)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    from tqdm import tqdm

    with reporting(args.json) as report:
        log = read_log(args.log)
        changed = changes(log)
        for text in changed:
            report.line(f"not as it was recorded: {text}")
        with tqdm(total=_ticks(log), unit="tick", disable=None) as bar:
            ticks, difference = replay(log, bar.update)
        if difference is None:
            report.line(f"identical over {ticks} ticks" + ("" if log.complete else ", as far as the log goes"))
        else:
            report.line(f"differs, first at {difference}")
        report.result(
            {
                "identical": difference is None,
                "ticks": ticks,
                "complete": log.complete,
                "changed": changed,
                "first_difference": None if difference is None else vars(difference),
            }
        )
    return exit_codes.DONE if difference is None else exit_codes.FAILED


def replay(log: FlightLog, done: Callable[[], object] = lambda: None) -> tuple[int, Divergence | None]:
    """Repeat a log's run: how many ticks were compared, and the first difference. `done` hears of each tick.

    Raises ConfigError.
    """
    settings = _settings(log)
    body = log.header["backend"]
    if body not in BACKENDS or not BACKENDS[body].simulated:
        raise ConfigError(f"{log.path}: recorded on '{body}': only simulated runs can be repeated")
    if body != settings.backend:
        raise ConfigError(f"{log.path}: recorded with a program's own backend: only that program can repeat it")
    if log.header["policy"]["name"] != log.header["settings"]["policy"]:
        raise ConfigError(f"{log.path}: recorded with a program's own policy: only that program can repeat it")
    stops = [Event(**event) for event in log.messages["/event"] if event["kind"] in ("interrupt", "record")]
    plans = _plans(log)
    recorded = _by_tick(log)
    repeated: dict[int, Tick] = defaultdict(lambda: defaultdict(list))

    def compare(record: TickRecord) -> None:
        done()
        for channel, message in messages(record):
            if channel != "/event":
                repeated[record.tick][channel].append(plain(message))

    velocities = log.column("/instruction", "velocity").reshape(-1, 3)
    ended = any(event["kind"] == "task" and event["text"] == DONE for event in log.messages["/event"])
    intents = [read_intent(message) for message in log.messages["/intent"]] or None
    held = bool((log.header.get("operator") or {}).get("held"))
    script = Script(tuple(stops), plans, velocities, ended, intents, held, _planner(log))
    result = run(settings, on_tick=compare, script=script)
    for event in result.events:  # of their own ticks, as in the log: what befalls other robots comes between two
        repeated[event.tick]["/event"].append(plain(event_message(event)))
    for number in sorted(recorded.keys() | (repeated.keys() if log.complete else set())):
        difference = _difference(number, recorded.get(number), repeated.get(number))
        if difference is not None:
            return len(recorded), difference
    return len(recorded), None


def _plans(log: FlightLog) -> list[dict[int, int]]:
    """Requests and adoptions of plans, of each time that the policy began: at first, and when the robot had got up."""
    again = got_up(log)
    plans: list[dict[int, int]] = [{} for _ in range(len(again) + 1)]
    for message in log.messages["/plan"]:
        plans[bisect_right(again, message["tick"])][int(message["requested"])] = int(message["adopted"])
    return plans


def changes(log: FlightLog) -> list[str]:
    """What is not as it was when the log was written: robot, policy, task, packages, source; as far as the log says."""
    from servoid.hw.robot.description import load_robot
    from servoid.policy.checkpoint import git_commit, resolve
    from servoid.stack.control.closed_loop import ClosedLoopSettings
    from servoid.stack.control.get_up import fingerprints
    from servoid.stack.control.policies import policy_fingerprint
    from servoid.stack.log.format import plain
    from servoid.stack.log.provenance import fingerprint, sha256, versions
    from servoid.stack.skills.skill import fingerprints as skill_fingerprints

    settings = _settings(log)
    robot = load_robot(settings.robot)
    planner, header = _planner(log), {**log.header, **_part("policy", log.header["policy"])}
    try:
        policy = policy_fingerprint(settings.policy, robot)
    except ConfigError:
        if planner is None:
            raise
        looped = header.get("policy.closed_loop") is not None
        policy = policy_fingerprint("closd" if looped else "diffusion", robot)  # the file is gone
        policy |= {"planner": None} if not looped else {"closed_loop": None}
    if planner is not None:  # whatever the file says today
        policy["checkpoint_sha256"] = sha256(resolve(planner.checkpoint, robot))
        if isinstance(planner, ClosedLoopSettings):
            policy["tracker_sha256"] = sha256(resolve(planner.tracker, robot)) if planner.tracker else None
    policy["name"] = log.header["settings"]["policy"]  # as it was typed
    now = fingerprint(robot) | _part("policy", policy)
    now["recovery"] = fingerprints(robot) if settings.recover else None
    if "skills" in header:
        now["skills"] = plain(skill_fingerprints(robot))
    now |= _task(settings) | {"versions": versions(), "git_commit": git_commit()}
    names = {
        "robot": "the robot's file",
        "servos": "a servo's file",
        "mjcf_sha256": "the robot's model",
        "policy.name": "the policy",
        "policy.checkpoint_sha256": "the policy's checkpoint",
        "policy.odometry_sha256": "the odometry's checkpoint",
        "policy.planner": "the file of the planner's settings (those of the log are used)",
        "policy.closed_loop": "the file of the closed loop's settings (those of the log are used)",
        "policy.tracker_sha256": "the checkpoint of its tracker",
        "policy.gait": "the gait's settings",
        "task": "the task's settings",
        "task_files": "a file that the task's settings name",
        "task_source": "the task's file",
        "recovery": "what it gets up by",
        "skills": "a skill or its clip",
        "policy.source": "the policy's file",
        "versions": "installed packages",
        "git_commit": "the source",
    }
    return [text for key, text in names.items() if key in header and header[key] != now[key]]


def _planner(log: FlightLog) -> PlannerSettings | None:
    """What the run's planner was set to; None for another policy, and in old logs, which do not say. Raises
    ConfigError."""
    from servoid.policy.diffusion.settings import DiffusionSettings
    from servoid.stack.control.closed_loop import ClosedLoopSettings

    recorded = log.header["policy"]
    if (planner := recorded.get("planner")) is not None:
        return from_values(planner, DiffusionSettings, log.path)
    loop = recorded.get("closed_loop")
    return None if loop is None else from_values(loop, ClosedLoopSettings, log.path)


def _part(name: str, values: dict[str, Any]) -> dict[str, Any]:
    return {f"{name}.{key}": value for key, value in values.items()}


def _task(settings: RunSettings) -> dict[str, Any]:
    """The task as a log's header has it, by the files of today."""
    from servoid.hw.robot.description import load_robot
    from servoid.stack.log.provenance import described, files
    from servoid.stack.tasks import find, load_settings, source

    chosen = dict(settings.set)
    if settings.seconds is not None:
        chosen["seconds"] = repr(settings.seconds)
    task = load_settings(settings.task, chosen, load_robot(settings.robot))
    named = {"name": find(settings.task).name} | described(task)
    return {"task": named, "task_files": files(task), "task_source": source(settings.task)}


def _settings(log: FlightLog) -> RunSettings:
    known = {f.name for f in fields(RunSettings)}
    values = {name: value for name, value in log.header["settings"].items() if name in known}
    own = {"task": log.header.get("task_source"), "policy": log.header["policy"].get("source")}
    for name, source in own.items():  # a file's name may have been typed in another folder
        if source is not None and source["package"] is None:
            values[name] = f"{source['file']}:{source['class']}"
    return RunSettings(**(values | {"record": None, "realtime": False}))


def _ticks(log: FlightLog) -> int:
    return len(log.messages["/timing"])


def _by_tick(log: FlightLog) -> dict[int, Tick]:
    ticks: dict[int, Tick] = defaultdict(lambda: defaultdict(list))
    for channel, channel_messages in log.messages.items():
        if channel in MACHINE_DEPENDENT and MACHINE_DEPENDENT[channel] is None:
            continue
        for message in channel_messages:
            ticks[message["tick"]][channel].append(message)
    return ticks


def _difference(number: int, recorded: Tick | None, repeated: Tick | None) -> Divergence | None:
    if recorded is None or repeated is None:
        return Divergence(number, "/run", "length: " + ("the repetition is longer" if repeated else "it ended earlier"))
    compared = [name for name in recorded.keys() | repeated.keys() if MACHINE_DEPENDENT.get(name, ()) is not None]
    for channel in sorted(compared):
        before, after = recorded.get(channel, []), repeated.get(channel, [])
        if len(before) != len(after):
            return Divergence(number, channel, f"{len(before)} messages, now {len(after)}")
        ignored = MACHINE_DEPENDENT.get(channel) or ()
        for old, new in zip(before, after, strict=True):
            for field in sorted(old.keys() | new.keys()):
                if field not in ignored and old.get(field) != new.get(field):
                    return Divergence(number, channel, field)
    return None

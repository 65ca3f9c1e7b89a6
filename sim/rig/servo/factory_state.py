"""How a virtual rig is delivered: set up for its robot, or as a person finds it who has just screwed it together."""

from __future__ import annotations

import argparse
import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Literal, get_args

from servoid.hw.config import ConfigError, nearest
from servoid.hw.dynamixel.protocol.tables import ControlTable, table
from servoid.hw.robot.description import Robot
from servoid.hw.seeds import Stream, generator
from servoid.sim.rig.servo.firmware import EXTENDED

Assembly = Literal["file", "random"]
ASSEMBLIES: tuple[str, ...] = get_args(Assembly)
_OFF = 0.2  # rad that a horn may sit off the file's zero: under one tooth and a half of an XM430's spline
_REVERSED = 0.3  # share of servos mounted the other way round


@dataclass(frozen=True)
class FactoryState:
    """`fresh` servos are as the factory sends them (ID 1, 57600 bit/s); those not in `only`, if given, are unplugged.

    With `assembly` "random" zeros and directions are not those of the robot's file: calibration has to find them.
    Without a `board` the servos are on an adapter such as a U2D2 and always have power; with one they have it when the
    board is told to give it, or are `powered` already. `baud` [bit/s] is another than the file's.
    """

    fresh: tuple[str, ...] = ()
    only: tuple[str, ...] = ()
    assembly: Assembly = "file"
    board: bool = True
    powered: bool = False
    baud: int | None = None

    def bus_baud(self, robot: Robot) -> int:
        """What servos that were set up, and the board, listen at [bit/s]."""
        return robot.bus.baud if self.baud is None else self.baud

    def arguments(self) -> list[str]:
        """The same on a command line."""
        named = [(option, name) for option, names in (("--fresh", self.fresh), ("--only", self.only)) for name in names]
        words = [word for pair in named for word in pair] + ["--assembly", self.assembly]
        words += [] if self.board else ["--no-board"]
        words += ["--powered"] if self.powered else []
        return words if self.baud is None else [*words, "--baud", str(self.baud)]

    def check(self, robot: Robot) -> None:
        """Raise ConfigError for a joint that the robot has not, and for a baud or ticks that its servos have not."""
        for name in (*self.fresh, *self.only):
            if name not in robot.names:
                raise ConfigError(f"{robot.name} has no joint '{name}'; {nearest(name, robot.names)}")
        for servo in robot.servos:
            items = table(servo.model_number)
            for what, baud in ((f"{robot.name}: bus.baud", robot.bus.baud), ("--baud", self.bus_baud(robot))):
                if baud not in items.bauds:
                    known = ", ".join(map(str, items.bauds))
                    raise ConfigError(f"{what}: servos have no {baud} bit/s; they have {known}")
            turn = ticks_per_turn(items)
            if (servo.ticks_per_turn, servo.center_tick) != (turn, turn // 2):
                raise ConfigError(
                    f"servo {servo.name}: a virtual {items.name} has ticks_per_turn {turn} and center_tick "
                    f"{turn // 2}, not {servo.ticks_per_turn} and {servo.center_tick}"
                )

    def assembled(self, robot: Robot, seed: int) -> Robot:
        """The robot with the zeros and directions of this rig."""
        if self.assembly == "file":
            return robot
        rng = generator(seed, Stream.DELIVERY)
        off = rng.uniform(-_OFF, _OFF, len(robot.joints)).tolist()
        turned = (rng.random(len(robot.joints)) < _REVERSED).tolist()
        joints = []
        for joint, zero, reverse in zip(robot.joints, off, turned, strict=True):
            room = max(math.pi - max(abs(joint.range[0] - joint.zero), abs(joint.range[1] - joint.zero)), 0.0)
            zero = max(-room, min(room, zero))  # the range stays on one side of the servo's seam
            joints.append(
                replace(joint, zero=joint.zero + zero, direction=-joint.direction if reverse else joint.direction)
            )
        return replace(robot, joints=tuple(joints))

    def eeprom(self, robot: Robot) -> list[dict[str, int]]:
        """What each servo's EEPROM holds that differs from the factory's."""
        values: list[dict[str, int]] = []
        for joint, servo in zip(robot.joints, robot.servos, strict=True):
            if joint.name in self.fresh:
                values.append({})
                continue
            set_up = {
                "id": joint.id,
                "baud_rate": table(servo.model_number).bauds.index(self.bus_baud(robot)),
                "return_delay_time": 0,
            }
            if self.assembly == "file":
                tick = 2 * math.pi / servo.ticks_per_turn / joint.gear
                ends = [servo.center_tick + joint.direction * (end - joint.zero) / tick for end in joint.range]
                if robot.extended[len(values)]:
                    set_up["operating_mode"] = EXTENDED
                else:
                    set_up["min_position_limit"] = max(math.floor(min(ends)), 0)
                    set_up["max_position_limit"] = min(math.ceil(max(ends)), servo.ticks_per_turn - 1)
            values.append(set_up)
        return values

    def unplugged(self, names: Collection[str]) -> set[str]:
        """Joints whose servos are not on the bus."""
        return set(names) - set(self.only) if self.only else set()


def ticks_per_turn(items: ControlTable) -> int:
    """How many ticks the servos of a control table count in a turn; the tick of angle 0 is half as many."""
    return round(2 * math.pi / items.item("present_position").scale)


def add_factory_state_arguments(parser: argparse.ArgumentParser) -> None:
    for option, text in (
        ("--fresh", "joint whose servo is factory-new: ID 1, 57600 bit/s"),
        ("--only", "only joint whose servo is plugged in"),
    ):
        parser.add_argument(option, action="append", default=[], metavar="JOINT", help=f"{text}; may be repeated")
    parser.add_argument(
        "--assembly",
        choices=ASSEMBLIES,
        default="file",
        help="zeros and directions: those of the robot's file (default), or others that calibration has to find",
    )
    parser.add_argument(
        "--no-board",
        action="store_false",
        dest="board",
        help="servos only, always powered, as on a U2D2 with their own supply",
    )
    parser.add_argument("--powered", action="store_true", help="board with the servos' power on from the start")
    parser.add_argument("--baud", type=int, metavar="BPS", help="baud of servos and board (default: the robot's)")


def factory_state_of(args: argparse.Namespace) -> FactoryState:
    """What those arguments say."""
    return FactoryState(tuple(args.fresh), tuple(args.only), args.assembly, args.board, args.powered, args.baud)

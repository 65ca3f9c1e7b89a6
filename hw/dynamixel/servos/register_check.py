"""Who is on the bus, and whether each servo is what the robot's file says. Nothing here moves a motor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import BackendError
from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import MAX_ID
from servoid.hw.dynamixel.protocol.tables import ControlTable, table
from servoid.hw.dynamixel.protocol.units import Units
from servoid.hw.dynamixel.transport.bus import Bus
from servoid.hw.dynamixel.transport.openers import openers
from servoid.hw.robot.description import Joint, Robot, Servo

POSITION_MODE, EXTENDED_MODE = 3, 4
# EEPROM that is not compared.
UNCOMPARED = {
    "id": "the servo would not have answered",
    "baud_rate": "the servo would not have answered",
    "external_port_mode_1": "a pin of the servo's expansion port",
    "external_port_mode_2": "a pin of the servo's expansion port",
    "external_port_mode_3": "a pin of the servo's expansion port",
}
# What turns a joint the wrong way, moves it without being asked, or moves it when another is meant.
GRAVE = (
    *("secondary_id", "protocol_type", "startup_configuration", "status_return_level"),
    *("operating_mode", "drive_mode", "homing_offset"),
)
EEPROM_BYTES, RAM_BYTES = 64, 83  # in two reads: all that is compared, and what is measured
SERVO_BLOCKS = ((0, EEPROM_BYTES), (EEPROM_BYTES, RAM_BYTES))
POWER_SECONDS = 2.0  # that servos may take to answer after power-on
RETRY_SECONDS = 0.05


@dataclass(frozen=True, slots=True)
class Difference:
    """A register that is not as the robot's file wants it. A robot with one that is `grave` is not driven."""

    joint: str
    id: int
    register: str
    found: int
    wanted: int
    grave: bool


@dataclass(frozen=True)
class Found:
    """A servo that answered: its table, and its registers as read."""

    joint: Joint
    table: ControlTable
    firmware: int
    memory: bytes

    def get(self, register: str) -> int:
        item = self.table.item(register)
        return item.decode(self.memory[item.address : item.end])


def model_name(servo: Servo) -> str:
    """Name of a robot's servo in the control tables. Raises BackendError where there is none."""
    try:
        return table(servo.model_number).name
    except ConfigError as error:
        raise BackendError(f"servo '{servo.name}' is not a Dynamixel that is known here: {error}") from error


def find_board(bus: Bus, robot: Robot) -> None:
    """Find the board, where there is one, and switch the servos' power on. Raises BackendError with the remedy."""
    if robot.bus.board == "none":
        return
    id, board = robot.bus.board_id, table("opencr")
    ping = bus.ping(id, tries=3)
    if ping is None:
        raise BackendError(
            f"{bus.port.name}: the board (ID {id}) does not answer at {bus.port.baud} bit/s: check the cable, the "
            f"battery's switch and bus.baud in the robot's file{_garbled(bus)}"
        )
    if ping.model != board.number:
        raise BackendError(f"ID {id} is not the board but {_model(ping.model)}: check bus.board_id in the robot's file")
    if not bus.write_item(id, board.item("dynamixel_power"), 1):
        raise BackendError(f"the board (ID {id}) does not switch the servos' power on: restart it")


def find_servos(bus: Bus, robot: Robot) -> list[Found]:
    """Find every servo of the robot and read it. Raises BackendError that names the ones missing or wrong."""
    deadline = bus.clock.now_ns() + round(POWER_SECONDS * 1e9)
    waiting = list(range(len(robot.joints)))
    pings = {}
    while waiting:
        for i in list(waiting):
            ping = bus.ping(robot.joints[i].id, tries=1)
            if ping is not None:
                pings[i] = ping
                waiting.remove(i)
        if not waiting or bus.clock.now_ns() >= deadline:
            break
        bus.clock.sleep_until(bus.clock.now_ns() + round(RETRY_SECONDS * 1e9))
    if waiting:
        names = ", ".join(f"{robot.joints[i].name} (ID {robot.joints[i].id})" for i in waiting)
        raise BackendError(
            f"{bus.port.name}: no answer from {names}: check their cables, IDs and baud rate{_garbled(bus)}"
        )
    found = []
    for i, (joint, servo) in enumerate(zip(robot.joints, robot.servos, strict=True)):
        if pings[i].model != servo.model_number:
            raise BackendError(
                f"{joint.name} (ID {joint.id}) is {_model(pings[i].model)}, but the robot's file says "
                f"{model_name(servo)}: change the servo, or the file"
            )
        found.append(_read(bus, joint, pings[i].firmware))
    _check_voltage(found, robot.servos)
    return found


def compare(robot: Robot, found: Sequence[Found]) -> list[Difference]:
    """Every register that matters and differs from what the robot's file asks for, grave ones first."""
    units = Units(robot, [servo.table for servo in found])
    if seam := units.across_the_seam():
        last = robot.servos[robot.names.index(seam[0])].ticks_per_turn - 1
        raise BackendError(
            f"{', '.join(seam)}: the range crosses the servo's 0/{last} seam, beyond "
            "which it cannot go in position mode: mount the horn half a turn round and set 'zero' in the robot's file"
        )
    lows, highs = units.limits()
    margins = (robot.limits.margin / robot.tick_angles).astype(int)  # ticks that the guard keeps off
    differences: list[Difference] = []
    for servo, model, low, high, margin, extended in zip(
        found, robot.servos, lows.tolist(), highs.tolist(), margins.tolist(), units.extended.tolist(), strict=True
    ):
        wanted = _factory(servo.table) | {
            "operating_mode": EXTENDED_MODE if extended else POSITION_MODE,
            "return_delay_time": 0,
            "temperature_limit": round(model.max_temperature),
            "status_return_level": 2,
        }
        narrow = {}
        if not extended:  # in that mode the servo heeds no limits of its own
            wanted |= {"min_position_limit": low, "max_position_limit": high}
            narrow = {
                "min_position_limit": servo.get("min_position_limit") > low + margin,
                "max_position_limit": servo.get("max_position_limit") < high - margin,
            }
        for register, value in wanted.items():
            found_there = servo.get(register)
            if found_there == value or (register == "secondary_id" and found_there > MAX_ID):
                continue
            grave = narrow.get(register, register in GRAVE)
            differences.append(Difference(servo.joint.name, servo.joint.id, register, found_there, value, grave))
    return sorted(differences, key=lambda difference: not difference.grave)


def _factory(items: ControlTable) -> dict[str, int]:
    """The factory's value of every register that is kept without power."""
    kept = (item for item in items.items.values() if item.eeprom and item.writable and item.name not in UNCOMPARED)
    return {item.name: item.default or 0 for item in kept}


def as_table(differences: Sequence[Difference]) -> str:
    """Differences as a person reads them."""
    rows = [("joint", "ID", "register", "found", "wanted", "")]
    rows += [
        (d.joint, str(d.id), d.register, str(d.found), str(d.wanted), "must be changed" if d.grave else "")
        for d in differences
    ]
    widths = [max(len(row[i]) for row in rows) for i in range(6)]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows)


def correct(bus: Bus, found: Sequence[Found], differences: Sequence[Difference]) -> None:
    """Write what is wanted, and read it back. Raises BackendError naming the joint that did not take it, or that has
    torque on: its EEPROM is locked then, and only a person may let a robot go limp."""
    servos = {servo.joint.id: servo for servo in found}
    if stiff := [servo.joint.name for servo in found if servo.get("torque_enable")]:
        raise BackendError(
            f"{', '.join(stiff)} has torque on, which locks its registers: hold the robot, then servoid bringup off"
        )
    # First of all every servo obeys nobody's ID but its own, and then says what it did.
    first = ("secondary_id", "status_return_level")
    for d in sorted(differences, key=lambda d: d.register not in first):
        item = servos[d.id].table.item(d.register)
        if not bus.write_item(d.id, item, d.wanted) or bus.read_item(d.id, item) != d.wanted:
            raise BackendError(f"{d.joint} (ID {d.id}) does not take {d.register} = {d.wanted}: restart it")


def read_memory(bus: Bus, id: int, blocks: Sequence[tuple[int, int]] = SERVO_BLOCKS) -> bytes:
    """What a servo holds from address 0 on; nothing where it cannot be read. One that another program told to answer
    nothing but a ping is told to answer: its status return level is in RAM, and moves nothing."""
    memory = b""
    level = table("xm430-w350").item("status_return_level")  # in the same place in every model
    for address, length in blocks:
        status = bus.read(id, address, length)
        if status is None and blocks is SERVO_BLOCKS and not address:
            bus.send(codec.sync_write(level.address, level.width, {id: level.encode(2)}))
            status = bus.read(id, address, length)
        if status is None or status.error:
            return b""
        memory += status.data
    return memory


def _read(bus: Bus, joint: Joint, firmware: int) -> Found:
    memory = read_memory(bus, joint.id)
    if not memory:
        raise BackendError(f"{joint.name} (ID {joint.id}) answers a ping, but cannot be read{_garbled(bus)}")
    number = int.from_bytes(memory[:2], "little")
    return Found(joint, table(number, firmware), firmware, memory)


def _check_voltage(found: Sequence[Found], servos: Sequence[Servo]) -> None:
    for servo, model in zip(found, servos, strict=True):
        volts = servo.get("present_input_voltage") * model.voltage_unit
        low, high = model.voltage_range
        if not low <= volts <= high:
            raise BackendError(
                f"{servo.joint.name} (ID {servo.joint.id}) has {volts:.1f} V, outside {low:g} to {high:g} V: "
                "check the battery and the supply"
            )


def _model(number: int) -> str:
    try:
        return f"a {table(number).name}"
    except ConfigError:
        return f"a device of model number {number}"


def _garbled(bus: Bus) -> str:
    counters = bus.counters
    if others := openers(bus.port.name):
        return f" ({', '.join(others)} uses the port as well: end it first)"
    if counters.bad_crc or counters.garbage:
        return " (something answers, but garbled: two servos may have the same ID, or another baud rate)"
    return ""

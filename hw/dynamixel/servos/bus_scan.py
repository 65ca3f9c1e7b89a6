"""Who answers on a bus of which nothing is known, and new IDs and bauds for them. Nothing here moves a motor or
gives one torque."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import BackendError
from servoid.hw.dynamixel.protocol.codec import MAX_ID, OVERHEAD
from servoid.hw.dynamixel.protocol.tables import ControlTable, Item, table
from servoid.hw.dynamixel.servos.register_check import EEPROM_BYTES, RAM_BYTES, SERVO_BLOCKS, read_memory
from servoid.hw.dynamixel.transport.bus import LONGEST_RETURN_DELAY, Bus, Ping
from servoid.hw.dynamixel.transport.openers import openers

BAUDS = table("xm430-w350").bauds  # bit/s; the same for every model
FACTORY_BAUD = 57600
PATIENCE = 0.03  # s of margin for a bus on which nothing is known: adapters come with a latency timer of 16 ms
LISTEN_SECONDS = 0.05  # to a line that should be silent
ASKED = 6  # times that an ID is asked before two servos are blamed
BOOT_SECONDS = 1.0  # after the servos' power was switched on
BRAKE_SECONDS = 0.4  # with torque and without gain, before torque goes off: as a run ends
OFF_TRIES = 4
_GAINS = ("position_p_gain", "position_i_gain", "position_d_gain")
PING_ANSWER = 14  # bytes
_ECHO = 14  # bytes at most of a request that some adapters hand back
_LONGEST_ANSWER = OVERHEAD + RAM_BYTES  # bytes of anything that is asked here
_BOARD_BYTES = 32  # up to its voltage


@dataclass(frozen=True)
class Device:
    """A servo or a board that answered a ping. `memory` is what it holds from address 0; empty if it cannot be read."""

    id: int
    baud: int
    model: int
    firmware: int
    memory: bytes

    @property
    def table(self) -> ControlTable | None:
        """Its control table; None for a model that is not known here."""
        try:
            return table(self.model, self.firmware)
        except ConfigError:
            return None

    @property
    def name(self) -> str:
        known = self.table
        return known.name if known is not None else f"model {self.model}"

    @property
    def is_board(self) -> bool:
        return self.model == table("opencr").number

    def get(self, register: str) -> int | None:
        """Raw value of a register; None where the device has none or could not be read."""
        known = self.table
        if known is None or register not in known:
            return None
        item = known.item(register)
        return item.decode(self.memory[item.address : item.end]) if item.end <= len(self.memory) else None

    def measured(self, register: str) -> float | None:
        """The same in its unit."""
        raw = self.get(register)
        return None if raw is None or self.table is None else raw * self.table.item(register).scale

    def __str__(self) -> str:
        return f"{self.name}, ID {self.id}, {self.baud} bit/s"


@dataclass
class Census:
    """Everybody who answered, and what a person should look at."""

    devices: list[Device] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    skipped: list[int] = field(default_factory=list)  # bauds that the adapter cannot be set to

    @property
    def servos(self) -> list[Device]:
        return [device for device in self.devices if not device.is_board]

    @property
    def boards(self) -> list[Device]:
        return [device for device in self.devices if device.is_board]


def power_on(bus: Bus, board_id: int, bauds: Sequence[int]) -> str | None:
    """Find the board and switch the servos' power on where it is off; a line about it, or None without a board."""
    board = table("opencr")
    switch = board.item("dynamixel_power")
    for baud in bauds:
        if not _tuned(bus, baud):
            continue
        ping = bus.ping(board_id, tries=2)
        if ping is None or ping.model != board.number:
            continue
        if bus.read_item(board_id, switch):
            return f"board at ID {board_id}, {baud} bit/s; the servos have power"
        if not bus.write_item(board_id, switch, 1):
            raise BackendError(f"the board (ID {board_id}) does not switch the servos' power on: restart it")
        bus.clock.sleep_until(bus.clock.now_ns() + round(BOOT_SECONDS * 1e9))
        return f"board at ID {board_id}, {baud} bit/s; it has switched the servos' power on"
    return None


def census(bus: Bus, bauds: Iterable[int], told: Callable[[str], None] = lambda text: None) -> Census:
    """Ask everybody at each baud. `told` hears what is being done. Raises BackendError when the port is gone."""
    found = Census()
    bus.return_delay = LONGEST_RETURN_DELAY
    for baud in bauds:
        if not _tuned(bus, baud):
            found.skipped.append(baud)
            continue
        told(f"asking at {baud} bit/s")
        _ask_all(bus, baud, found)
    return found


def assign(bus: Bus, device: Device, id: int, baud: int) -> Device:
    """Give a servo another ID and baud, ID first, each read back. The port is left at the new baud.

    Raises BackendError that says where the servo answers now.
    """
    items = device.table
    if items is None:
        raise BackendError(f"{device} is not known here: its registers cannot be written")
    at, speed = device.id, device.baud
    _tune(bus, speed)
    if at != id:
        # An acknowledgement may be lost though the servo did what it was told: what counts is where it answers.
        bus.write_item(at, items.item("id"), id)
        if _model(bus, id) != device.model:
            raise BackendError(f"{device} did not take ID {id}: switch its power off and on, then scan")
        at = id
    if speed != baud:
        bus.write_item(at, items.item("baud_rate"), items.bauds.index(baud), tries=1)
        _tune(bus, baud)
        if _model(bus, at) != device.model:
            raise BackendError(
                f"{device} did not take {baud} bit/s: it has ID {at} now; switch its power off and on, then scan"
            )
        speed = baud
    now = _read(bus, Ping(at, device.model, device.firmware, False), speed)
    code = items.bauds.index(baud)
    if (now.get("id"), now.get("baud_rate")) != (id, code):
        raise BackendError(f"{now} does not read back what was written: switch its power off and on, then scan")
    return now


def let_go(bus: Bus, devices: Sequence[Device]) -> list[Device]:
    """Torque off at servos, braked first so that a robot settles instead of dropping. Returns those that did not say
    that it is off. Their gains are as before afterwards."""
    gains = {}
    for device in devices:
        _tune(bus, device.baud)
        gains[device] = {name: device.get(name) for name in _GAINS}
        for name in _GAINS:
            bus.write_item(device.id, _item(device, name), 0)
    bus.clock.sleep_until(bus.clock.now_ns() + round(BRAKE_SECONDS * 1e9))
    left = []
    for device in devices:
        _tune(bus, device.baud)
        torque = _item(device, "torque_enable")
        for _ in range(OFF_TRIES):
            bus.write_item(device.id, torque, 0)
            if bus.read_item(device.id, torque) == 0:
                break
        else:
            left.append(device)
            continue
        for name, value in gains[device].items():
            bus.write_item(device.id, _item(device, name), value or 0)
    return left


def _item(device: Device, name: str) -> Item:
    assert device.table is not None, "only a known model says that it has torque"
    return device.table.item(name)


def _ask_all(bus: Bus, baud: int, found: Census) -> None:
    before = _broken(bus)
    pings = bus.broadcast_ping()
    heard = {ping.id: ping for ping in pings}
    garbled = {id for id, times in Counter(ping.id for ping in pings).items() if times > 1}
    if _broken(bus) - before > PING_ANSWER * len(pings) + _ECHO:
        # Somebody cannot be heard among all the others: one at a time says who.
        for id in range(MAX_ID + 1):
            before = _broken(bus)
            ping = bus.ping(id, tries=1)
            if ping is not None:
                heard[id] = ping
            elif _broken(bus) - before > _ECHO:
                garbled.add(id)
    noise = _noise(bus)
    for ping in sorted(heard.values()):
        before = _broken(bus)
        device = _read(bus, ping, baud)
        found.devices.append(device)
        if device.memory:
            continue
        if _broken(bus) - before > 3 * _ECHO:
            garbled.add(ping.id)
        elif device.table is not None:
            found.problems.append(
                f"ID {ping.id} at {baud} bit/s answers a ping and nothing else: switch its power off and on"
            )
    if not garbled:
        return
    shared = set() if noise else {id for id in garbled if _shared(bus, id)}
    if others := openers(bus.port.name):
        found.problems.append(
            f"{', '.join(others)} uses the port as well and takes answers from here: end it first, then scan again"
        )
        return
    found.problems += [
        f"ID {id} at {baud} bit/s answers garbled, however often it is asked: two servos have this ID; unplug all but "
        f"one of them and give it another: servoid bringup setup --id N --from {id}"
        for id in sorted(shared)
    ]
    if damaged := sorted(garbled - shared):
        heard_noise = f" (the line carries {noise} bytes that nobody asked for)" if noise else ""
        found.problems.append(
            f"answers of ID {', '.join(map(str, damaged))} at {baud} bit/s came damaged{heard_noise}: check cables, "
            "plugs, termination and the ground, and what else is on the line; then scan again"
        )


def _noise(bus: Bus) -> int:
    """Bytes that come while nobody was asked."""
    bus.clock.sleep_until(bus.clock.now_ns() + round(LISTEN_SECONDS * 1e9))
    bus.port.read()  # what was still due
    bus.clock.sleep_until(bus.clock.now_ns() + round(LISTEN_SECONDS * 1e9))
    return len(bus.port.read())


def _shared(bus: Bus, id: int) -> bool:
    """Whether what comes from an ID is never one whole answer: noise would let some through. What two servos measure
    differs, though all that they are set to may be the same."""
    for _ in range(ASKED):
        counters = bus.counters
        before = (counters.bad_crc, counters.garbage, counters.duplicates, counters.unexpected)
        answer = bus.read(id, EEPROM_BYTES, RAM_BYTES, tries=1)
        bus.clock.sleep_until(bus.clock.now_ns() + round(PATIENCE * 1e9))
        more = bus.port.read()
        after = (counters.bad_crc, counters.garbage, counters.duplicates, counters.unexpected)
        if answer is not None and not more and after == before:
            return False
    return True


def _read(bus: Bus, ping: Ping, baud: int) -> Device:
    board = ping.model == table("opencr").number
    memory = read_memory(bus, ping.id, ((0, _BOARD_BYTES),) if board else SERVO_BLOCKS)
    return Device(ping.id, baud, ping.model, ping.firmware, memory)


def _broken(bus: Bus) -> int:
    """Bytes that came in time, less those of whole packets that answered nothing: late ones are not garbled ones."""
    return bus.counters.bytes_in - _LONGEST_ANSWER * bus.counters.unexpected


def _model(bus: Bus, id: int) -> int | None:
    ping = bus.ping(id, tries=3)
    return None if ping is None else ping.model


def _tuned(bus: Bus, baud: int) -> bool:
    """Set the port's speed; False where the adapter has no such."""
    try:
        _tune(bus, baud)
    except BackendError:
        bus.port.read()  # raises where it is the port that is gone
        return False
    return True


def _tune(bus: Bus, baud: int) -> None:
    if bus.port.baud != baud:
        bus.set_baud(baud)

"""What published clients of Dynamixel servos do, verb by verb, in their order. Nothing of their code is here.

Each of them uses the official SDK: the examples that come with it, LeRobot's motor bus, ToddlerBot's and ROBEL's
clients, LEAP Hand's, and the ORCA hand's.
"""

from __future__ import annotations

from collections.abc import Callable

import dynamixel_sdk as sdk

from servoid.sim.rig.servo.factory_state import FactoryState
from servoid.tools.bench.sdk_host import Refused, SdkHost, expect, near

Verb = Callable[[SdkHost], None]
_MODE, _TORQUE, _LED, _CURRENT, _GOAL, _POSITION = 11, 64, 65, 102, 116, 132
_HOMING, _MAX, _MIN, _DRIVE = 20, 48, 52, 10
_MODEL = 1020
_STEP = 150  # ticks that a joint is moved by
_ARRIVED = 20  # ticks from the goal at which the examples stop waiting
_POWERED = FactoryState(board=False)  # as on a U2D2
ONE_NEW = FactoryState(fresh=("l_knee",), only=("l_knee",), board=False)


def _ping(host: SdkHost) -> None:
    for id in host.ids:
        model, result, error = host.packets.ping(host.port, id)
        host.check(f"ping {id}", result, error)
        expect(f"model of ID {id}", model, _MODEL)


def _broadcast_ping(host: SdkHost) -> None:
    for id, delay in zip(host.ids, (254, 0, 250), strict=False):  # as they come from the factory, beside one set up
        host.write(id, 9, 1, delay)
    found, result = host.packets.broadcastPing(host.port)
    host.check("broadcast ping", result)
    expect("IDs in the order of their answers", list(found), sorted(host.ids))


def _read_write(host: SdkHost) -> None:
    """Torque on, to a goal and back, waiting until it is there."""
    id = host.ids[0]
    start = host.read(id, _POSITION, 4, signed=True)
    host.write(id, _TORQUE, 1, 1)
    for goal in (start + _STEP, start):
        host.write(id, _GOAL, 4, goal)
        for _ in range(500):
            if abs(goal - host.read(id, _POSITION, 4, signed=True)) <= _ARRIVED:
                break
            host.wait(0.002)
        else:
            raise Refused(f"ID {id} never came to {goal}")
    host.write(id, _TORQUE, 1, 0)


def _sync_read_write(host: SdkHost, *, fast: bool = False) -> None:
    ids = host.ids
    start = host.sync_read(ids, _POSITION, 4, signed=True, fast=fast)
    for id in ids:
        host.write(id, _TORQUE, 1, 1)
    host.sync_write(_GOAL, 4, {id: tick + 20 for id, tick in start.items()})
    host.wait(0.5)
    for id, tick in host.sync_read(ids, _POSITION, 4, signed=True, fast=fast).items():
        near(f"position of ID {id}", tick, start[id] + 20, _ARRIVED)
    host.sync_write(_TORQUE, 1, dict.fromkeys(ids, 0))


def _bulk_read_write(host: SdkHost) -> None:
    """One servo's goal and another's LED in a packet, then both read in one."""
    first, second = host.ids[:2]
    for id in (first, second):
        host.write(id, _TORQUE, 1, 1)
    goal = host.read(first, _POSITION, 4) + 30
    for led in (1, 0):
        group = sdk.GroupBulkWrite(host.port, host.packets)
        group.addParam(first, _GOAL, 4, list(goal.to_bytes(4, "little")))
        group.addParam(second, _LED, 1, [led])
        host.check("bulk write", group.txPacket())
        host.wait(0.4)
        for fast in (False, True):
            read = host.bulk_read([(first, _POSITION, 4), (second, _LED, 1)], fast=fast)
            near("position", read[first], goal, _ARRIVED)
            expect("LED", read[second], led)
    host.sync_write(_TORQUE, 1, dict.fromkeys((first, second), 0))


def _indirect(host: SdkHost) -> None:
    """Goal and LED behind indirect addresses, position and moving behind others; one sync write, one sync read."""
    id = host.ids[0]
    host.write(id, _TORQUE, 1, 0)
    for i, address in enumerate((116, 117, 118, 119, 65, 132, 133, 134, 135, 122)):
        host.write(id, 168 + 2 * i, 2, address)
    start = host.read(id, _POSITION, 4)
    host.write(id, _TORQUE, 1, 1)
    host.sync_write(224, 5, {id: start + 25 | 1 << 32})
    host.wait(0.5)
    expect("LED by its own address", host.read(id, _LED, 1), 1)
    near("position by indirect data", host.sync_read([id], 229, 4)[id], start + 25, _ARRIVED)
    expect("moving by indirect data", host.sync_read([id], 233, 1)[id], 0)
    host.write(id, _TORQUE, 1, 0)


def _reboot(host: SdkHost) -> None:
    id = host.ids[0]
    host.write(id, _LED, 1, 1)
    host.check("reboot", *host.packets.reboot(host.port, id))
    expect("a ping while it starts", host.packets.ping(host.port, id)[1] == sdk.COMM_SUCCESS, False)
    host.wait(0.4)
    expect("LED", host.read(id, _LED, 1), 0)


def _factory_reset(host: SdkHost) -> None:
    """All but ID and baud, then all but the ID, at whose baud it is found again; the other way round it is set up."""
    id, baud = host.ids[0], host.port.getBaudRate()
    code = host.read(id, 8, 1)
    host.write(id, 31, 1, 60)
    for option in (2, 1):
        host.check(f"factory reset {option}", *host.packets.factoryReset(host.port, id, option))
        host.wait(0.4)
        if option == 1:
            host.port.setBaudRate(57600)
        expect("temperature limit", host.read(id, 31, 1), 80)
    host.write(id, 8, 1, code)
    host.port.setBaudRate(baud)
    expect("baud", host.read(id, 8, 1), code)
    host.check("broadcast", host.packets.factoryReset(host.port, sdk.BROADCAST_ID, 0xFF)[0])
    host.wait(0.4)
    _ping(host)


def _clear(host: SdkHost) -> None:
    """Turns are counted in extended mode until they are cleared."""
    id = host.ids[0]
    host.write(id, _MODE, 1, 4)
    host.rig.move({host.joint(id): 2 * 3.14159265 + 0.1})
    expect("beyond a turn", not 0 <= host.read(id, _POSITION, 4, signed=True) < 4096, True)
    host.check("clear", *host.packets.clearMultiTurn(host.port, id))
    expect("within a turn", 0 <= host.read(id, _POSITION, 4, signed=True) < 4096, True)
    host.write(id, _MODE, 1, 3)


def _registered(host: SdkHost) -> None:
    """Two registered writes that one action lets happen."""
    first, second = host.ids[:2]
    for id in (first, second):
        host.check("reg write", *host.packets.regWriteTxRx(host.port, id, _LED, 1, [1]))
        expect("registered", host.read(id, 69, 1), 1)
    host.packets.action(host.port, sdk.BROADCAST_ID)
    host.wait(0.001)
    expect("LEDs", [host.read(id, _LED, 1) for id in (first, second)], [1, 1])


def _lerobot_setup(host: SdkHost) -> None:
    """A servo from the factory alone on the bus: found by pings at each baud, given its ID and baud."""
    for baud in (9600, 57600, 115200, 1_000_000):
        host.port.setBaudRate(baud)
        found, _ = host.packets.broadcastPing(host.port)
        if found:
            break
    expect("found", {id: data[0] for id, data in found.items()}, {1: _MODEL})
    host.write(1, _TORQUE, 1, 0)
    host.write(1, 7, 1, 14)
    host.write(14, 8, 1, 3)
    host.port.setBaudRate(1_000_000)
    expect("ID", host.read(14, 7, 1), 14)


def _lerobot_configure(host: SdkHost) -> None:
    _ping(host)
    for id in host.ids:
        host.write(id, 9, 1, 0)
        host.write(id, _TORQUE, 1, 0)
        host.write(id, _MODE, 1, 4)
    host.write(host.ids[-1], _MODE, 1, 5)
    for id in host.ids:
        host.write(id, _MODE, 1, 3)


def _lerobot_calibrate(host: SdkHost) -> None:
    """Offsets that make here the middle, then ranges by hand, written and read back."""
    ids = host.ids[:3]
    for id in ids:
        for address, value in ((_HOMING, 0), (_MIN, 0), (_MAX, 4095)):
            host.write(id, address, 4, value)
    for id, tick in host.sync_read(ids, _POSITION, 4, signed=True).items():
        host.write(id, _HOMING, 4, max(-1024, min(1024, 2047 - tick)))
    middle = host.sync_read(ids, _POSITION, 4, signed=True)
    low, high = dict(middle), dict(middle)
    joints = dict(zip(host.rig.robot.names, host.rig.plant.joints.tolist(), strict=True))
    for offset in (-0.3, -0.1, 0.1, 0.3, 0.0):
        host.rig.move({host.joint(id): joints[host.joint(id)] + offset for id in ids})
        for id, tick in host.sync_read(ids, _POSITION, 4, signed=True).items():
            low[id], high[id] = min(low[id], tick), max(high[id], tick)
    for id in ids:
        near(f"range of ID {id}", high[id] - low[id], 0.6 / 0.001534, 4)
        host.write(id, _MIN, 4, max(low[id], 0))
        host.write(id, _MAX, 4, min(high[id], 4095))
    expect("minima", host.sync_read(ids, _MIN, 4), {id: max(low[id], 0) for id in ids})
    expect("drive modes", host.sync_read(ids, _DRIVE, 1), dict.fromkeys(ids, 0))
    host.sync_read(ids, _HOMING, 4, signed=True)


def _toddlerbot(host: SdkHost) -> None:
    """Restart, return delay, mode and gains for all in sync writes, torque, a loop, torque off."""
    ids = host.ids
    for id in ids:
        host.check(f"reboot {id}", *host.packets.reboot(host.port, id))
    host.wait(0.4)
    for address, length, value in ((9, 1, 0), (_MODE, 1, 4), (84, 2, 1500), (82, 2, 0), (80, 2, 300)):
        host.sync_write(address, length, dict.fromkeys(ids, value))
    expect("gains", host.sync_read(ids, 84, 2), dict.fromkeys(ids, 1500))
    host.sync_write(_TORQUE, 1, dict.fromkeys(ids, 1))
    start = {id: read[2] for id, read in host.present(ids).items()}
    for i in range(20):
        host.sync_write(_GOAL, 4, {id: tick + i for id, tick in start.items()})
        host.sync_read(ids, 126, 10, fast=True)
        host.wait(0.02)
    host.wait(0.3)
    for id, (_, _, tick) in host.present(ids).items():
        near(f"position of ID {id}", tick, start[id] + 19, _ARRIVED)
    host.sync_write(_TORQUE, 1, dict.fromkeys(ids, 0))
    host.sync_write(_MODE, 1, dict.fromkeys(ids, 3))


def _robel(host: SdkHost) -> None:
    """Torque one by one, goals in one write, ten bytes of each in a bulk read; without torque nothing moves."""
    ids = host.ids
    start = {id: read[2] for id, read in host.present(ids).items()}
    for id, (_, velocity, _) in host.present(ids).items():
        expect(f"velocity of ID {id} at rest", velocity, 0)
    for id in ids:
        host.check(f"torque {id}", *host.packets.write1ByteTxRx(host.port, id, _TORQUE, 1))
    for step in (10, 20, 0):
        host.sync_write(_GOAL, 4, {id: tick + step for id, tick in start.items()})
        host.wait(0.4)
        for id, (_, _, tick) in host.present(ids).items():
            near(f"position of ID {id}", tick, start[id] + step, _ARRIVED)
    for id in ids:
        host.check(f"torque {id}", *host.packets.write1ByteTxRx(host.port, id, _TORQUE, 0))


def _leap(host: SdkHost) -> None:
    """Current-based position with a limit of current, gains, and a pose."""
    ids = host.ids
    host.sync_write(_MODE, 1, dict.fromkeys(ids, 5))
    host.sync_write(_TORQUE, 1, dict.fromkeys(ids, 1))
    for address, value in ((84, 600), (82, 0), (80, 200), (_CURRENT, 350)):
        host.sync_write(address, 2, dict.fromkeys(ids, value))
    start = {id: read[2] for id, read in host.present(ids).items()}
    host.sync_write(_GOAL, 4, {id: tick + 40 for id, tick in start.items()})
    host.wait(0.8)
    for id, (current, _, tick) in host.present(ids).items():
        near(f"position of ID {id}", tick, start[id] + 40, 40)
        near(f"current of ID {id}", current, 0, 360)
    expect("goal currents", host.sync_read(ids, _CURRENT, 2), dict.fromkeys(ids, 350))
    host.sync_write(_TORQUE, 1, dict.fromkeys(ids, 0))
    host.sync_write(_MODE, 1, dict.fromkeys(ids, 3))


def _orca(host: SdkHost) -> None:
    """A joint driven until it no longer moves, by a current that cannot move it and by one that can; temperatures,
    status and voltage of all."""
    ids = host.ids
    for id in ids:
        host.write(id, _TORQUE, 1, 0)
    host.sync_write(_MODE, 1, dict.fromkeys(ids, 5))
    for id in ids:
        host.write(id, _TORQUE, 1, 1)
    host.sync_write(_CURRENT, 2, dict.fromkeys(ids, 100))
    id = ids[0]
    start = host.present([id])[id][2]
    for current, way in ((1, 0), (300, 200)):
        host.sync_write(_CURRENT, 2, {id: current})
        host.sync_write(_GOAL, 4, {id: start + 200})
        before = start - 100
        for _ in range(50):
            host.wait(0.1)
            now = host.present([id])[id][2]
            if abs(now - before) <= 1:
                break
            before = now
        else:
            raise Refused(f"ID {id} never came to rest")
        near(f"way of ID {id} at a current of {current}", now - start, way, _ARRIVED)
    for part, low, high in (((146, 1), 20, 60), ((123, 1), 0, 255), ((144, 2), 90, 160)):
        for each, value in host.bulk_read([(each, *part) for each in ids]).items():
            expect(f"ID {each}: {part[0]} is {value}, within {low} and {high}", low <= value <= high, True)
    host.sync_write(_TORQUE, 1, dict.fromkeys(ids, 0))
    host.sync_write(_MODE, 1, dict.fromkeys(ids, 3))


def _fast_sync(host: SdkHost) -> None:
    _sync_read_write(host, fast=True)


CLIENTS: dict[str, tuple[tuple[str, FactoryState, Verb], ...]] = {
    "sdk examples": (
        ("ping", _POWERED, _ping),
        ("broadcast ping", _POWERED, _broadcast_ping),
        ("read and write", _POWERED, _read_write),
        ("sync read and write", _POWERED, _sync_read_write),
        ("fast sync read", _POWERED, _fast_sync),
        ("bulk read and write", _POWERED, _bulk_read_write),
        ("indirect address", _POWERED, _indirect),
        ("registered write", _POWERED, _registered),
        ("reboot", _POWERED, _reboot),
        ("factory reset", _POWERED, _factory_reset),
        ("clear turns", _POWERED, _clear),
    ),
    "lerobot": (
        ("set up a new servo", ONE_NEW, _lerobot_setup),
        ("configure", _POWERED, _lerobot_configure),
        ("calibrate", _POWERED, _lerobot_calibrate),
        ("teleoperate", _POWERED, _sync_read_write),
    ),
    "toddlerbot": (("start, loop, stop", _POWERED, _toddlerbot),),
    "robel": (("start, loop, stop", _POWERED, _robel),),
    "leap hand": (("start, pose, stop", _POWERED, _leap),),
    "orca hand": (("drive until it stops", _POWERED, _orca),),
}

"""What a servo's RAM holds when torque comes on.

Another program may have left anything there: a goal PWM that halves the torque, a profile that slows every goal down,
a velocity feed-forward, a status level at which nothing is acknowledged. So every register of RAM that shapes what a
motor does is written before torque, and read back. The others are in IDLE, with the reason why they may stay.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.tables import ControlTable
from servoid.hw.dynamixel.servos.register_check import Found

# Writable RAM that shapes nothing here.
IDLE = {
    "led": "a light",
    "external_port_data_1": "a pin of the servo's expansion port",
    "external_port_data_2": "a pin of the servo's expansion port",
    "external_port_data_3": "a pin of the servo's expansion port",
    "indirect_address": "changes what a write to indirect data reaches, and nothing here writes there",
    "indirect_data": "is another name of the register that the address names",
}
# Torque itself comes last, with the watchdog.
SWITCHES = ("torque_enable", "bus_watchdog")

FIRST, LAST = "status_return_level", "goal_position"  # the span that holds all of them: one read shows it

Values = Mapping[str, int]


def motion(goal: int) -> Values:
    """Where to, and how fast: what has to be right before there is any gain. A watchdog that expired refuses goals."""
    return {
        "status_return_level": 2,
        "bus_watchdog": 0,
        "goal_velocity": 0,
        "profile_acceleration": 0,  # 0: goals are gone to at once
        "profile_velocity": 0,
        "goal_position": goal,
    }


def strength(servo: Found, gain: int) -> Values:
    """How hard: gains, with `gain` the position P gain, and limits, as far open as the servo's EEPROM allows."""
    items = servo.table.items
    names = ("velocity_i_gain", "velocity_p_gain", "position_d_gain", "position_i_gain")
    values = {name: items[name].default or 0 for name in names}
    values |= {"position_p_gain": gain, "feedforward_2nd_gain": 0, "feedforward_1st_gain": 0}
    values["goal_pwm"] = servo.get("pwm_limit")
    if "goal_current" in items:
        values["goal_current"] = servo.get("current_limit")
    return values


def span(table: ControlTable) -> tuple[int, int]:
    """Address and length of the read that shows all of them."""
    start = table.item(FIRST).address
    return start, table.item(LAST).end - start


def packets(found: Sequence[Found], values: Sequence[Values]) -> list[bytes]:
    """Sync writes of `values` to each servo, one for each run of registers that lie side by side, in order."""
    runs: dict[tuple[int, int], dict[int, bytes]] = {}
    for servo, wanted in zip(found, values, strict=True):
        for address, data in _runs(servo.table, wanted):
            runs.setdefault((address, len(data)), {})[servo.joint.id] = data
    return [codec.sync_write(address, length, data) for (address, length), data in runs.items()]


def differing(servo: Found, values: Values, memory: bytes | None, start: int) -> list[str]:
    """Registers that do not hold what is wanted; `memory` was read from address `start` on, None where nothing came."""
    if memory is None:
        return list(values)
    items = [(servo.table.item(name), value) for name, value in values.items()]
    return [item.name for item, value in items if item.decode(memory[item.address - start :]) != value]


def _runs(table: ControlTable, values: Values) -> list[tuple[int, bytes]]:
    """Address and bytes of each run of registers without a gap between them."""
    runs: list[tuple[int, bytes]] = []
    for item in sorted((table.item(name) for name in values), key=lambda item: item.address):
        data = item.encode(values[item.name])
        if runs and runs[-1][0] + len(runs[-1][1]) == item.address:
            runs[-1] = (runs[-1][0], runs[-1][1] + data)
        else:
            runs.append((item.address, data))
    return runs

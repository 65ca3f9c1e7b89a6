"""What the bits of `Observation.fault` mean: the servo's own hardware errors, and what the host found out about it."""

from __future__ import annotations

# Bits 0 to 7 are those of the servo's hardware error register.
TORQUE_LOST = 1 << 8
REBOOTED = 1 << 9
WATCHDOG = 1 << 10
STOP_BUTTON = 1 << 11

NAMES = {
    0: "input voltage",
    2: "overheating",
    3: "encoder",
    4: "electrical shock",
    5: "overload",
    8: "torque off, though it was switched on",
    9: "a restart",
    10: "an expired bus watchdog",
    11: "the stop button",
}


def describe(fault: int) -> list[str]:
    """The faults in words, one for each bit."""
    return [NAMES.get(bit, f"error {1 << bit:#04x}") for bit in range(fault.bit_length()) if fault >> bit & 1]

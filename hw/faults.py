"""What the bits of `Observation.fault` mean: the servo's own hardware errors, and what the host found out about it.

Those of ROBOT concern the whole robot and are set for every joint.
"""

from __future__ import annotations

# Bits 0 to 7 are those of the servo's hardware error register.
INPUT_VOLTAGE = 1 << 0
OVERHEATING = 1 << 2
ENCODER = 1 << 3
SHOCK = 1 << 4
OVERLOAD = 1 << 5
TORQUE_LOST = 1 << 8
REBOOTED = 1 << 9
WATCHDOG = 1 << 10
STOP_BUTTON = 1 << 11
STOP_BUTTON_AGAIN = 1 << 12  # let go and pressed once more
IMU_SILENT = 1 << 13
IMU_DEAD = 1 << 14
IMU_FROZEN = 1 << 15
LATE = 1 << 16

IMU = IMU_SILENT | IMU_DEAD | IMU_FROZEN  # why there is no valid sample of it now
ROBOT = STOP_BUTTON | STOP_BUTTON_AGAIN | IMU | LATE

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
    12: "the stop button, twice",
    13: "it sends nothing",
    14: "it measures nothing",
    15: "its values stand still",
    16: "answers that come late",
}

_REMEDIES = {
    OVERHEATING | OVERLOAD: "let it cool, then switch its power off and on",
    INPUT_VOLTAGE: "check the battery and the supply",
    REBOOTED | SHOCK: "check its cable and its supply, then switch its power off and on",
    ENCODER: "switch its power off and on; if it comes again, replace the servo",
    TORQUE_LOST: "check its cable and its errors",
    WATCHDOG: "the bus was silent for too long: check the adapter, and what else keeps this machine busy",
}


def describe(fault: int) -> list[str]:
    """The faults in words, one for each bit."""
    return [NAMES.get(bit, f"error {1 << bit:#04x}") for bit in range(fault.bit_length()) if fault >> bit & 1]


def remedy(fault: int) -> str:
    """What to do about a servo's faults: about the first that has a remedy of its own."""
    return next((text for bits, text in _REMEDIES.items() if fault & bits), "switch its power off and on")

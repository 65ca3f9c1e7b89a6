"""Serial ports of this machine that may be the robot's."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from serial.tools import list_ports

# USB vendor and product of what speaks to Dynamixel servos, and of the chips of cheap adapters.
_KNOWN = {
    (0x0403, 0x6014): "ROBOTIS U2D2 (FT232H)",
    (0x0403, 0x6001): "FTDI adapter (FT232R)",
    (0xFFF1, 0xFF48): "ROBOTIS OpenCR",
    (0x0483, 0x5740): "ROBOTIS OpenCM, or another STM32",
    (0x10C4, 0xEA60): "CP210x adapter",
    (0x1A86, 0x7523): "CH340 adapter",
    (0x1A86, 0x55D3): "CH343 adapter",
    (0x1A86, 0x55D4): "CH9102 adapter",
}
_BY_ID = Path("/dev/serial/by-id")


@dataclass(frozen=True)
class PortInfo:
    """A port. `name` stays the same wherever it is plugged in; `allowed` is whether this user may open it."""

    path: str
    name: str
    what: str
    allowed: bool


def usb_ports() -> dict[str, PortInfo]:
    """USB serial ports by their path."""
    found = {}
    for port in list_ports.comports():
        if port.vid is None or port.pid is None:
            continue  # a port of the mainboard: no robot's adapter
        what = _KNOWN.get((port.vid, port.pid)) or port.description or "unknown"
        allowed = os.access(port.device, os.R_OK | os.W_OK)
        found[port.device] = PortInfo(port.device, _lasting(port.device), what, allowed)
    return dict(sorted(found.items()))


def _lasting(path: str, by_id: Path = _BY_ID) -> str:
    """The link that udev makes for this very adapter, or the path itself."""
    for link in sorted(by_id.glob("*")) if by_id.is_dir() else ():
        if os.path.realpath(link) == os.path.realpath(path):
            return str(link)
    return path

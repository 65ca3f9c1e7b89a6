"""A rig in real time on a busy machine: how late it is, and what the host wrote while it was not looking."""

from __future__ import annotations

from collections.abc import Callable

from servoid.hw.dynamixel.protocol.codec import HEADER

NOTICED_NS = 500_000  # behind by more, nobody can say when the host wrote what is there now
NAMED_NS = 3_000_000  # behind by more, clients may have given an answer up
_TELL_NS = 5_000_000_000  # between two lines about it


class Lateness:
    """Counts how often, and by how much, a rig was late; `told` hears of it, at most every 5 s."""

    def __init__(self, told: Callable[[str], None]) -> None:
        self._told = told
        self.times, self.worst_ns = 0, 0
        self._untold_ns = 0  # the worst since a line was written
        self._told_ns: int | None = None

    def note(self, late_ns: int, wall_ns: int) -> None:
        """The rig looked at its port, `late_ns` after it had something to do."""
        if late_ns > NAMED_NS:
            self.times += 1
            self.worst_ns = max(self.worst_ns, late_ns)
            self._untold_ns = max(self._untold_ns, late_ns)
        if self._untold_ns and (self._told_ns is None or wall_ns - self._told_ns > _TELL_NS):
            self._told(sentence(1, self._untold_ns))
            self._untold_ns, self._told_ns = 0, wall_ns

    def take(self) -> tuple[int, int]:
        """How often, and by how much at worst [ns]; both begin anew."""
        taken = self.times, self.worst_ns
        self.times = self.worst_ns = 0
        return taken


def sentence(times: int, worst_ns: int) -> str:
    """What a person should know of it."""
    often = "was late" if times == 1 else f"was late {times} times"
    return (
        f"the virtual rig {often}, by up to {worst_ns * 1e-6:.0f} ms: this machine is busy, and answers that were lost "
        "or late meanwhile say nothing about cable, adapter or latency timer"
    )


def packets(data: bytes) -> list[bytes]:
    """Bytes of the host cut where a packet ends; what is no packet stays with what is behind it."""
    pieces, start = [], 0
    while data.startswith(HEADER, start) and len(data) >= start + 7:
        end = start + 7 + int.from_bytes(data[start + 5 : start + 7], "little")
        if end > len(data):
            break
        pieces.append(data[start:end])
        start = end
    return [*pieces, data[start:]] if start < len(data) else pieces

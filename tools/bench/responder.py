"""Servos for timing a client: answers on a pty when the last byte of an answer would have come over a wire.

    python -m servoid.tools.bench.responder

The first line of standard output is the port. It knows sync writes of goals, the plain and the fast sync read, and the
read of one device: as little as a control cycle needs, so that what is timed is the client. A goal that was written is
the position that is read next, so that a client can tell whether a cycle did what it should. It ends when standard
input closes.
"""

from __future__ import annotations

import gc
import os
import select
import struct
import sys
import time

from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import FRAME_BITS, InstructionCode
from servoid.sim.rig.process.pty import Pty
from servoid.stack.runtime.realtime import undisturbed

CURRENT, VELOCITY = 7, -11  # raw values that every servo reports
ALERT_SECONDS = 0.02  # after a packet, in which the next is watched for and not slept for
_HOPS = 300  # that are timed at the start
_SPIN_NS = 150_000  # before an answer is due, in which the responder no longer sleeps
_HEAD = struct.Struct("<4sBHB")


class Responder:
    """Keeps the wire's time: bytes take what they take at the port's speed, one packet after the other."""

    def __init__(self) -> None:
        self.pty = Pty()
        self._goals: dict[int, int] = {}
        self._free_ns = 0  # when the line is free again
        # What a pty takes to hand bytes over, either way, is no part of a wire. The least that it ever takes is taken
        # off, so that no answer is there before its last byte would be.
        self._to_here_ns, self._to_host_ns = (self._hop_ns(to_host) for to_host in (False, True))
        self._buffer = bytearray()

    def serve(self) -> None:
        """Until standard input closes."""
        poll = select.poll()
        poll.register(self.pty.master, select.POLLIN)
        stdin = sys.stdin.fileno()
        both = select.poll()
        both.register(self.pty.master, select.POLLIN)
        both.register(stdin, select.POLLIN | select.POLLHUP)
        gc.disable()
        with undisturbed(True, lambda text: None):  # servos are punctual, however busy the host is
            self._serve(both, poll, stdin)

    def _serve(self, both: select.poll, poll: select.poll, stdin: int) -> None:
        while True:
            if any(ready == stdin for ready, _ in both.poll()):
                return
            last = time.monotonic_ns()
            while time.monotonic_ns() - last < ALERT_SECONDS * 1e9:
                if poll.poll(0):
                    last = self._hear()

    def _hear(self) -> int:
        """Take what the host wrote; returns when it was seen."""
        seen = time.monotonic_ns()
        self._buffer += self.pty.read()
        while len(self._buffer) >= 7:
            size = 7 + int.from_bytes(self._buffer[5:7], "little")
            if len(self._buffer) < size:
                break
            packet = bytes(self._buffer[:size])
            del self._buffer[:size]
            self._execute(packet, seen - self._to_here_ns)
        return seen

    def _execute(self, packet: bytes, now: int) -> None:
        byte_ns = FRAME_BITS * 1e9 / self.pty.baud
        _, id, _, instruction = _HEAD.unpack_from(packet)
        params = packet[8:-2]
        self._free_ns = max(self._free_ns, now) + round(len(packet) * byte_ns)
        if instruction == InstructionCode.SYNC_WRITE:
            for at in range(4, len(params), 5):
                self._goals[params[at]] = int.from_bytes(params[at + 1 : at + 5], "little", signed=True)
            return
        if instruction == InstructionCode.READ:
            answer = codec.status(id, 0, bytes(int.from_bytes(params[2:4], "little")))
        elif instruction == InstructionCode.SYNC_READ:
            answer = b"".join(codec.status(id, 0, self._present(id)) for id in params[4:])
        else:
            answer = codec.fast_status([(id, 0, self._present(id)) for id in params[4:]])
        self._free_ns += round(len(answer) * byte_ns)
        self._send(answer)

    def _hop_ns(self, to_host: bool) -> int:
        """The least time from before a write to when the other end can read it [ns]."""
        pty = self.pty
        source, end = (pty.master, pty.slave) if to_host else (pty.slave, pty.master)
        least = _SPIN_NS
        for _ in range(_HOPS):
            began = time.monotonic_ns()
            os.write(source, b"\0")
            while not select.select([end], [], [], 0)[0]:
                pass
            least = min(least, time.monotonic_ns() - began)
            os.read(end, 1)
        return least

    def _present(self, id: int) -> bytes:
        return struct.pack("<hii", CURRENT, VELOCITY, self._goals.get(id, 0))

    def _send(self, answer: bytes) -> None:
        """Hand an answer over at the instant that its last byte has come."""
        due = self._free_ns - self._to_host_ns
        left = due - time.monotonic_ns() - _SPIN_NS
        if left > 0:
            time.sleep(left * 1e-9)
        while time.monotonic_ns() < due:
            pass
        os.write(self.pty.master, answer)
        select.select([self.pty.slave], [], [], 0)  # the kernel moves the bytes over at the latest when asked


def main() -> int:
    responder = Responder()
    print(responder.pty.port, flush=True)
    try:
        responder.serve()
    finally:
        responder.pty.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())

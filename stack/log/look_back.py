"""A flight log to look back into: opened quickly, since a tick is only read when somebody looks at it."""

from __future__ import annotations

import json
from bisect import bisect_right
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array, Command, Mode, Observation
from servoid.hw.contracts.control import Adopted, Instruction, Plan, State
from servoid.hw.contracts.world import Percept
from servoid.stack.log.flightlog import BROKEN, as_now, check_header, open_log, records
from servoid.stack.log.format import SCHEMAS, read_intent, unpack
from servoid.stack.log.tick import Proposal, TickRecord, Timing
from servoid.stack.safety.event import Event
from servoid.stack.safety.phase import Phase

Raw = dict[str, list[bytes]]  # channel -> its messages of one tick


class LoggedTicks:
    """The ticks of a run, by number. `times` `(ticks,)` s count from the first by the body's clock."""

    def __init__(self, path: Path) -> None:
        """Raises ConfigError for what is no flight log."""
        self.header: dict[str, Any] = {}
        self.result: dict[str, Any] | None = None
        self.events: list[Event] = []
        self.complete = False
        self._ticks: list[Raw] = []
        self._read(path)
        if not self.header:
            raise ConfigError(f"{path}: not a flight log, or cut short before its header was written")
        if not self._ticks:
            raise ConfigError(f"{path}: no tick of the run is in it")
        first, last = (json.loads(self._ticks[row]["/observation"][0])["time_ns"] for row in (0, -1))
        stamps = np.array([json.loads(raw["/timing"][0])["tick"] for raw in self._ticks], dtype=float)
        self.times: Array = (stamps - stamps[0]) / max(stamps[-1] - stamps[0], 1.0) * (last - first) * 1e-9

    def __len__(self) -> int:
        return len(self._ticks)

    def at(self, seconds: float) -> int:
        """The tick at a time, by number: the last that has begun, the first before all."""
        return max(0, bisect_right(self.times.tolist(), seconds) - 1)

    def record(self, row: int) -> TickRecord:
        """All that the log tells of a tick."""
        return read_record({channel: [json.loads(data) for data in part] for channel, part in self._ticks[row].items()})

    def _read(self, path: Path) -> None:
        raw: Raw = {}
        topics: dict[int, str] = {}
        with open_log(path) as file:
            try:
                for kind, record in records(file):
                    if kind == "Channel":
                        topics[record.id] = record.topic
                    elif kind == "Message" and (channel := topics.get(record.channel_id)) in SCHEMAS:
                        if channel == "/run":
                            header = json.loads(record.data)
                            check_header(path, header)
                            self.header = as_now(header)
                        elif channel == "/result":
                            self.result = json.loads(record.data)
                        elif channel == "/event":
                            self.events.append(Event(**json.loads(record.data)))
                        else:
                            raw.setdefault(channel, []).append(record.data)
                        if channel == "/timing":  # a tick's last message
                            self._ticks.append(raw)
                            raw = {}
                    elif kind == "Footer":
                        self.complete = True
            except BROKEN:
                self.complete = False


def read_record(found: dict[str, list[dict[str, Any]]]) -> TickRecord:
    """The tick whose messages `found` holds, by channel, as `messages` wrote them; without its events."""
    seen, command, timing = (found[channel][0] for channel in ("/observation", "/command", "/timing"))
    observation = _arrays(Observation, seen) | {"time_ns": seen["time_ns"]}
    state = None
    if "/state" in found:
        state = State(**_arrays(State, found["/state"][0]), time_ns=seen["time_ns"])
    return TickRecord(
        tick=timing["tick"],
        phase=Phase(command["phase"]),
        observation=Observation(**observation),
        state=state,
        command=Command(unpack(command["position"]), unpack(command["gain"]), Mode[command["mode"]]),
        proposal=_proposal(found),
        events=(),
        timing=Timing(**{field.name: timing[field.name] for field in fields(Timing)}),
        intent=read_intent(found["/intent"][0]) if "/intent" in found else None,
    )


def _proposal(found: dict[str, list[dict[str, Any]]]) -> Proposal:
    instruction = percept = plan = None
    if "/instruction" in found:
        asked = found["/instruction"][0]
        part: dict[str, Any] = {
            name: unpack(asked[name]) for name in ("velocity", "goal", "path", "ground") if name in asked
        }
        instruction = Instruction(**part, text=asked.get("text"))
        if "source" in asked:
            seen = {"goal": "place", "obstacles": "obstacles", "robots": "robots", "objects": "objects"}
            kept = {name: unpack(asked[key]) for name, key in seen.items() if key in asked}
            percept = Percept(asked["source"], 0.0, **kept)
    if "/plan" in found:
        told = found["/plan"][0]
        arrays: dict[str, Any] = {name: unpack(told[name]) for name in ("actions", "states", "path")}
        plan = Adopted(told["requested"], told["adopted"], Plan(tick=told["first"], seconds=told["seconds"], **arrays))
    return Proposal(instruction=instruction, percept=percept, plan=plan)


def _arrays(kind: type[Observation] | type[State], message: dict[str, Any]) -> dict[str, Array]:
    """The fields of a message that are arrays."""
    return {field.name: unpack(message[field.name]) for field in fields(kind) if field.name != "time_ns"}

"""Reads a flight log, whole or cut short."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from mcap.exceptions import McapError
from mcap.stream_reader import StreamReader
from zstandard import ZstdError

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.stack.log.format import FORMAT, SCHEMAS, unpack

Message = dict[str, Any]

# Of a header, what its readers go by: every run of this program has it.
_NEEDED = (
    "settings.task", "settings.backend", "settings.robot", "settings.policy", "settings.seed", "task", "backend",
    "policy.name", "robot.joints", "robot.feet", "robot.rate",
)  # fmt: skip


@dataclass(frozen=True)
class FlightLog:
    """A run's log. `messages` holds each channel's messages in order, arrays still packed.

    `complete` is False where the recording was cut short, by a kill or a full disk: what is there is good.
    """

    path: Path
    header: dict[str, Any]
    messages: dict[str, list[Message]]
    complete: bool

    @property
    def result(self) -> dict[str, Any] | None:
        """The run's result, or None if it did not live to write one."""
        return self.messages["/result"][-1] if self.messages["/result"] else None

    def ticks(self, channel: str) -> Array:
        """Tick of each message of a channel, `(messages,)`."""
        return np.array([message["tick"] for message in self.messages[channel]], dtype=int)

    def column(self, channel: str, field: str) -> Array:
        """A field over time, `(messages, ...)`. Raises KeyError if a message lacks it."""
        values = [message[field] for message in self.messages[channel]]
        return np.array([unpack(value) if isinstance(value, dict) else value for value in values])


def read_log(path: Path | str) -> FlightLog:
    """Read a flight log up to its last complete chunk. Raises ConfigError for what is none."""
    path = Path(path)
    found: dict[str, list[Message]] = {channel: [] for channel in SCHEMAS}
    with open_log(path) as file:
        complete = False
        topics: dict[int, str] = {}
        try:
            for kind, record in records(file):
                if kind == "Channel":
                    topics[record.id] = record.topic
                elif kind == "Message" and topics.get(record.channel_id) in found:
                    found[topics[record.channel_id]].append(json.loads(record.data))
                elif kind == "Footer":
                    complete = True
        except BROKEN:
            complete = False
    if not complete and found["/timing"]:
        last = found["/timing"][-1]["tick"]  # a tick's last message: what comes after belongs to a tick cut in two
        found = {name: [m for m in part if m.get("tick", last) <= last] for name, part in found.items()}
    if not found["/run"]:
        raise ConfigError(f"{path}: not a flight log, or cut short before its header was written")
    header = found["/run"][0]
    check_header(path, header)
    return FlightLog(path, as_now(header), found, complete)


def open_log(path: Path) -> BinaryIO:
    """Raises ConfigError for a file that cannot be read."""
    try:
        return path.open("rb")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None


def check_header(path: Path, header: dict[str, Any]) -> None:
    """Raise ConfigError for the header of a log that this version does not read."""
    if header.get("format") != FORMAT:
        raise ConfigError(f"{path}: log format {header.get('format')}, but this version reads {FORMAT}")
    missing = [name for name in _NEEDED if not _has(header, name.split("."))]
    if missing:
        raise ConfigError(
            f"{path}: a log whose header lacks {', '.join(missing)}: another program wrote it; record the run with "
            "`servoid run`"
        )


def as_now(header: dict[str, Any]) -> dict[str, Any]:
    """A header as an older program wrote it, by the names of today.

    The servos' gain was one of the task's settings, as text, and settings of the planner had other names.
    """
    settings, policy = header["settings"], header["policy"]
    if "gain" in settings.get("set", {}):
        chosen = {name: text for name, text in settings["set"].items() if name != "gain"}
        settings = settings | {"set": chosen, "gain": float(settings["set"]["gain"])}
    if policy.get("planner"):
        from servoid.policy.diffusion.settings import with_new_names

        policy = policy | {"planner": with_new_names(policy["planner"])}
    return header | {"settings": settings, "policy": policy}


def _has(values: Any, keys: list[str]) -> bool:
    return isinstance(values, dict) and keys[0] in values and (len(keys) == 1 or _has(values[keys[0]], keys[1:]))


# What the library raises at the point where a file was cut, depending on the record that it cuts.
BROKEN = (McapError, ZstdError, struct.error, ValueError, OSError)


def records(file: BinaryIO) -> Iterator[tuple[str, Any]]:
    """Kind and content of each record of a log. Raises one of BROKEN where it was cut."""
    for record in StreamReader(file, validate_crcs=True).records:
        yield type(record).__name__, record

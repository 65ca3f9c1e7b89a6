"""What a browser may say: requests as strict JSON, each with a sequence number and a time.

Whatever arrives is read by `parse_request` alone, in the page's process and again at the loop.
"""

from __future__ import annotations

import hmac
import json
from dataclasses import asdict, dataclass, field
from typing import Any

LONGEST = 4096  # bytes of a request
LONGEST_TEXT = 200  # characters of a sentence
FARTHEST = 100.0  # m of a goal
MOST_SETTINGS = 50
LATEST = 1e12  # s

# Kind -> the fields that it has beside sequence and time, and what they are.
KINDS: dict[str, dict[str, str]] = {
    "look": {},  # somebody is there
    "take": {},  # takes control
    "release": {},  # gives it up
    "beat": {"way": "way"},  # the person is there, and pushes the sticks so
    "goal": {"place": "place"},  # go there
    "text": {"text": "text"},  # do that
    "rest": {},  # stand still
    "end": {},  # end the task
    "skill": {"text": "text"},  # perform the skill of that name
    "start": {"task": "name", "set": "settings", "gain": "gain", "on": "switch"},  # begin a task; on: keep a log
    "do": {"what": "name", "value": "string"},  # what an item of the panel asks for
    "stop": {},  # come to rest, be lowered, torque off
    "off": {},  # torque off at once
    "seek": {"at": "seconds"},  # of a log: go to a moment
    "play": {"on": "switch"},  # go on from there
    "truth": {"on": "switch"},  # show the simulation's truth
}
HALTS = {"stop", "off"}  # which anyone may ask for who may see the page
OPEN = HALTS | {"look", "take", "truth", "seek", "play"}  # which ask for nothing that moves the robot


@dataclass(frozen=True)
class PageRequest:
    """What somebody at a page asks. A field that its kind does not have is empty."""

    kind: str
    sequence: int  # rises with each request of one sender
    time: float  # s of the sender's own clock
    way: tuple[float, float, float] = (0.0, 0.0, 0.0)  # each in -1..1: forward, to the left, turning left
    place: tuple[float, float] = (0.0, 0.0)  # m, odometry frame
    text: str = ""
    task: str = ""
    set: dict[str, str] = field(default_factory=dict)
    on: bool = False
    at: float = 0.0  # s
    gain: float = 1.0  # of the servos, for a soft start
    what: str = ""
    value: str = ""

    def encode(self) -> bytes:
        """As `parse_request` reads it."""
        values = asdict(self)
        names = ("kind", "sequence", "time", *KINDS[self.kind])
        return json.dumps({name: values[name] for name in names}).encode()


def parse_request(data: bytes | str, *, token: str | None = None) -> PageRequest:
    """The request in a message; with a `token`, it must bear that. Raises ValueError for anything else."""
    if len(data) > LONGEST:
        raise ValueError(f"longer than {LONGEST} bytes")
    try:
        values = json.loads(data)
    except (ValueError, RecursionError):
        raise ValueError("not JSON") from None
    if not isinstance(values, dict):
        raise ValueError("not an object")
    if token is not None and not _same(values.pop("token", None), token):
        raise ValueError("without the token")
    kind = values.pop("kind", None)
    if not isinstance(kind, str) or kind not in KINDS:
        raise ValueError("of an unknown kind")
    wanted = {"sequence": "sequence", "time": "time"} | KINDS[kind]
    if values.keys() != wanted.keys():
        raise ValueError(f"'{kind}' has {', '.join(wanted)} and nothing else")
    read: dict[str, Any] = {name: _READ[what](values[name]) for name, what in wanted.items()}
    return PageRequest(kind, **read)


def _same(given: Any, token: str) -> bool:
    """Whether that is the token; how long it takes to say does not tell how much of it was right."""
    return isinstance(given, str) and hmac.compare_digest(given.encode(errors="replace"), token.encode())


def _number(value: Any, most: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError("not a number")
    if not abs(value) <= most:  # NaN, too
        raise ValueError("a number out of range")
    return float(value)


def _numbers(value: Any, count: int, most: float) -> tuple[float, ...]:
    if not isinstance(value, list) or len(value) != count:
        raise ValueError(f"not {count} numbers")
    return tuple(_number(part, most) for part in value)


def _sequence(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**53:
        raise ValueError("sequence is no number from 0 on")
    return value


def _string(value: Any, longest: int = LONGEST_TEXT) -> str:
    if not isinstance(value, str) or len(value) > longest or not value.isprintable():
        raise ValueError(f"no text of at most {longest} characters")
    return value


def _filled(value: Any) -> str:
    text = _string(value).strip()
    if not text:
        raise ValueError("an empty text")
    return text


def _settings(value: Any) -> dict[str, str]:
    if not isinstance(value, dict) or len(value) > MOST_SETTINGS:
        raise ValueError("settings are no object of texts")
    return {_filled(name): _string(text) for name, text in value.items()}


def _gain(value: Any) -> float:
    if (gain := _number(value, 1.0)) <= 0.0:
        raise ValueError("a gain that is not above 0")
    return gain


def _switch(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError("neither true nor false")
    return value


_READ = {
    "sequence": _sequence,
    "time": lambda value: _number(value, LATEST),
    "seconds": lambda value: _number(value, LATEST),
    "way": lambda value: _numbers(value, 3, 1.0),
    "place": lambda value: _numbers(value, 2, FARTHEST),
    "text": _filled,
    "name": _filled,
    "string": _string,
    "gain": _gain,
    "settings": _settings,
    "switch": _switch,
}

"""What browsers may say, and who of them is heeded."""

from __future__ import annotations

import json
import math
import random

import pytest

from servoid.tools.web.browser.rights import LATE, LOST, NotHeeded, Rights
from servoid.tools.web.line.messages import KINDS, LONGEST, OPEN, PageRequest, parse_request

EXAMPLES = {
    "way": [0.5, 0.0, -1.0],
    "place": [1.0, -2.0],
    "text": "walk forward",
    "task": "walk",
    "set": {"vx": "0.1"},
    "on": True,
    "at": 2.5,
    "gain": 0.6,
    "what": "slide l_knee",
    "value": "0.25",
}


def message(kind: str, sequence: int = 1, time: float = 0.0, **more: object) -> dict[str, object]:
    return {"kind": kind, "sequence": sequence, "time": time, **{name: EXAMPLES[name] for name in KINDS[kind]}} | more


@pytest.mark.parametrize("kind", KINDS)
def test_a_request_is_read_as_it_was_written(kind: str) -> None:
    request = parse_request(json.dumps(message(kind)))
    assert request.kind == kind
    assert parse_request(request.encode()) == request


@pytest.mark.parametrize(
    "change",
    [
        {"way": [2.0, 0.0, 0.0]},
        {"way": [math.nan, 0.0, 0.0]},
        {"way": [0.0, 0.0]},
        {"way": [True, 0.0, 0.0]},
        {"way": "forward"},
        {"sequence": -1},
        {"sequence": 1.5},
        {"time": math.inf},
        {"kind": "torque"},
        {"kind": ["beat"]},
        {"more": 1},
    ],
)
def test_what_is_not_quite_a_request_is_none(change: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r".+"):
        parse_request(json.dumps(message("beat") | change))


@pytest.mark.parametrize(
    "data", ["", "[]", "null", "{", "9" * (LONGEST + 1), "[" * 2000, b"\xff\xfe", '{"kind":"beat"}']
)
def test_what_is_no_json_of_a_request_is_none(data: str | bytes) -> None:
    with pytest.raises(ValueError, match=r".+"):
        parse_request(data)


def test_without_the_token_nobody_is_heard() -> None:
    assert parse_request(json.dumps(message("stop", token="secret")), token="secret").kind == "stop"
    for given in ({}, {"token": "secre"}, {"token": None}, {"token": "\ud800"}):
        with pytest.raises(ValueError, match="token"):
            parse_request(json.dumps(message("stop") | given), token="secret")


def test_one_person_is_in_control_and_anyone_may_stop() -> None:
    control = Rights(None)
    control.come(0)
    control.come(1)
    assert hear(control, 0, message("take")) is None
    assert hear(control, 0, message("beat", 2)) is not None
    for kind in KINDS.keys() - OPEN:
        with pytest.raises(NotHeeded, match="take control first"):
            hear(control, 1, message(kind, hear.count))
    with pytest.raises(NotHeeded, match="somebody else"):
        hear(control, 1, message("take", hear.count))
    for kind in ("stop", "off"):
        request = hear(control, 1, message(kind, hear.count))
        assert request is not None
        assert request.kind == kind
    control.leave(0)
    hear(control, 1, message("take", hear.count))
    assert control.holder == 1


def test_control_of_somebody_who_is_silent_can_be_taken() -> None:
    control = Rights(None)
    control.come(0)
    control.come(1)
    hear(control, 0, message("take", 1, 0.0), now=10.0)
    hear(control, 1, message("take", 1, 0.0), now=10.0 + LOST)
    assert control.holder == 1


def test_what_was_too_long_on_its_way_is_no_heartbeat() -> None:
    """A network that hangs delivers old wishes in a burst: nobody may be there any more."""
    control = Rights(None)
    control.come(0)
    hear(control, 0, message("take", 1, 100.0), now=5.0)
    hear(control, 0, message("beat", 2, 101.0), now=6.0 + LATE - 0.01)
    with pytest.raises(NotHeeded, match="too long"):
        hear(control, 0, message("beat", 3, 102.0), now=7.0 + LATE + 0.01)
    assert hear(control, 0, message("stop", 4, 103.0), now=20.0) is not None


def test_an_older_request_never_follows_a_newer_one() -> None:
    control = Rights(None)
    control.come(0)
    hear(control, 0, message("take", 5))
    for sequence in (5, 4):
        with pytest.raises(NotHeeded, match="older"):
            hear(control, 0, message("beat", sequence))


def test_requests_of_several_people_go_on_in_one_order() -> None:
    control = Rights(None)
    control.come(0)
    control.come(1)
    numbers = [hear(control, who, message("truth", 1)) for who in (0, 1)]
    assert [request.sequence for request in numbers if request is not None] == [1, 2]


def test_nothing_that_arrives_breaks_the_page_or_gains_control() -> None:
    """A hundred thousand messages that are nearly right, from somebody without control."""
    rng = random.Random(1)
    control = Rights("secret")
    control.come(0)
    control.come(1)
    hear(control, 0, message("take", 1, token="secret"))
    passed = []
    for number in range(100_000):
        data = mutated(rng, json.dumps(message(rng.choice(list(KINDS)), number, token=rng.choice(["secret", "x", ""]))))
        try:
            passed.append(control.hear(1, data, 0.0))
        except NotHeeded:
            continue
    assert control.holder == 0
    assert {request.kind for request in passed if request is not None} <= {"stop", "off", "truth", "seek", "play"}
    assert passed  # some were right: a test that refuses all would see nothing


def mutated(rng: random.Random, text: str) -> str:
    """A message with a few of its characters changed, doubled or left out."""
    for _ in range(rng.choice([0, 1, 1, 2, 5])):
        i = rng.randrange(len(text) + 1)
        text = (
            text[:i]
            + rng.choice(["", '"', "{", "}", "[", "9", "-", "e9", "null", "\x00", "ü", text[i : i + 9]])
            + text[i + 1 :]
        )
    return text


def hear(control: Rights, who: int, values: dict[str, object], now: float = 0.0) -> PageRequest | None:
    hear.count += 1  # type: ignore[attr-defined]
    return control.hear(who, json.dumps(values), now)


hear.count = 10  # type: ignore[attr-defined]

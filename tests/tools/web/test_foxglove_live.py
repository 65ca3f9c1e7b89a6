"""A live run for Foxglove: what a client of its protocol sees, and ports that cannot be had."""

from __future__ import annotations

import json
import socket
from typing import Any

import numpy as np
import pytest

pytest.importorskip("foxglove", reason="foxglove-sdk is not installed: pip install 'servoid[foxglove]'")

from websockets.sync.client import connect
from websockets.typing import Subprotocol

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.stack.safety.event import Event
from servoid.tools.cli import main
from servoid.tools.web.browser.live_foxglove import LiveFoxglove
from servoid.tools.web.line.snapshot import BodyPose, Snapshot

ROBOT = load_robot()
N = len(ROBOT.names)
TICK = Snapshot(
    tick=7, time=1.0, phase="running", position=ROBOT.home, target=ROBOT.home, effort=np.zeros(N),
    temperature=np.full(N, 30.0), voltage=np.full(N, 12.0), age=np.zeros(N), fault=np.zeros(N, int), gain=np.ones(N),
    late=0.1, busy=2.0, missed=0,
    pose=BodyPose(np.array([1.0, 2.0, 0.25]), np.array([1.0, 0.0, 0.0, 0.0]), ROBOT.home),
)  # fmt: skip


def tell(served: LiveFoxglove) -> None:
    served.show(TICK, json.dumps({"tick": 7}))
    served.hear(Event(7, 1.0, "temperature", "l_knee", "l_knee is hot"))


def heard(client: Any) -> str | bytes:
    """The next message; nothing where none comes for a while, as before a subscription is taken up."""
    try:
        return client.recv(timeout=1.0)
    except TimeoutError:
        return b""


def test_a_client_of_foxglove_sees_numbers_frames_joints_and_events() -> None:
    served = LiveFoxglove(ROBOT, 0)
    try:
        with connect(served.url, subprotocols=[Subprotocol("foxglove.sdk.v1")], proxy=None) as client:
            channels: dict[str, Any] = {}
            while len(channels) < 5:  # a channel is told of with its first message
                tell(served)
                message = heard(client)
                told = json.loads(message) if isinstance(message, str) else {}
                channels |= {one["topic"]: one for one in told.get("channels", [])}
            assert channels.keys() == {"/frames", "/scene", "/joints", "/events", "/tick"}
            assert channels["/frames"]["schemaName"] == "foxglove.FrameTransforms"
            wanted = [{"id": i, "channelId": one["id"]} for i, one in enumerate(channels.values())]
            client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            names, seen = list(channels), dict[str, bytes]()
            while len(seen) < 5:
                tell(served)
                message = heard(client)
                if isinstance(message, bytes) and message[:1] == b"\x01":
                    seen[names[int.from_bytes(message[1:5], "little")]] = message[13:]
        assert json.loads(seen["/tick"]) == {"tick": 7}
        assert b"l_knee" in seen["/joints"]
        assert b"body_link" in seen["/frames"]
        assert b"l_knee is hot" in seen["/events"]
    finally:
        served.close()


def test_a_port_for_foxglove_that_is_taken_is_one_clear_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=f"--foxglove {port}: .*in use.*: choose another port"):
            LiveFoxglove(ROBOT, port)


def test_a_port_for_foxglove_that_is_none_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "stand", "--policy", "gait", "--foxglove", "70000"]) == 2
    assert "--foxglove 70000: give a number from 0" in capsys.readouterr().err

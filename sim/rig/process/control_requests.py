"""Requests on a rig's control socket: what tests and rollouts may see and do, beyond what goes over the wire."""

from __future__ import annotations

import json
import socket
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from servoid.hw.config import nearest
from servoid.hw.contracts.world import Start
from servoid.sim.rig.rig import Rig
from servoid.sim.rig.wire.faults import Fault
from servoid.sim.scene import from_plain


class Connection:
    """A control connection: requests and answers are JSON objects, one a line."""

    def __init__(self, stream: socket.socket) -> None:
        self.stream = stream
        self._buffer = b""

    def lines(self) -> list[bytes] | None:
        """Requests that have come; None when the other side is gone."""
        try:
            data = self.stream.recv(1 << 20)
        except ConnectionError:
            return None
        if not data:
            return None
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        return lines

    def answer(self, values: dict[str, Any]) -> bool:
        """Send an answer; False when the other side is gone."""
        try:
            self.stream.sendall(json.dumps(values).encode() + b"\n")
        except OSError:
            return False
        return True


def find(name: str, rig: Rig) -> Callable[..., dict[str, Any]]:
    """The request of that name on `rig`. Raises ValueError with the nearest name if there is none."""
    if name not in _REQUESTS:
        raise ValueError(f"unknown request '{name}'; {nearest(str(name), _REQUESTS)}")
    return partial(_REQUESTS[name], rig)


def _hold(rig: Rig) -> dict[str, Any]:
    """The robot is not let go when all servos have torque, until a reset."""
    rig.auto_release = False
    return {}


def _push(rig: Rig, velocity: list[float]) -> dict[str, Any]:
    rig.plant.push(np.asarray(velocity, float))
    return {}


def _furnish(rig: Rig, scene: dict[str, Any]) -> dict[str, Any]:
    """A scene around the robot; a reset must follow."""
    rig.plant.furnish(from_plain(scene))
    return {}


def _lay(rig: Rig, **values: list[float] | None) -> dict[str, Any]:
    """The robot is held and let go as a start says, until a reset."""
    rows = {name: None if value is None else np.array([value], dtype=float) for name, value in values.items()}
    rig.plant.laid = Start(**rows)
    rig.place(rig.robot.home if rows["joints"] is None else rows["joints"][0])
    return {}


def _roll(rig: Rig, places: list[list[float]]) -> dict[str, Any]:
    """Move the scene's spheres."""
    rig.plant.move(np.asarray(places, float))
    return {}


def _move(rig: Rig, pose: dict[str, float]) -> dict[str, Any]:
    rig.move(pose)
    return {}


def _joints(rig: Rig) -> dict[str, Any]:
    return {"joints": dict(zip(rig.robot.names, rig.plant.joints.tolist(), strict=True))}


def _press(rig: Rig, buttons: int) -> dict[str, Any]:
    rig.board.buttons = int(buttons)
    return {}


def _inject(rig: Rig, fault: dict[str, Any]) -> dict[str, Any]:
    """A fault whose times count from now."""
    seconds = rig.seconds
    until = fault.get("until")
    fault = {**fault, "at": seconds + fault.get("at", 0.0), "until": None if until is None else seconds + until}
    rig.inject(Fault(**fault))
    return {}


def _truth(rig: Rig) -> dict[str, Any]:
    plant = rig.plant
    values = {name: getattr(plant.data, name).tolist() for name in ("qpos", "qvel", "sensordata")}
    return {**values, "touches": plant.touches.tolist(), "held": plant.held}


def _accepted(rig: Rig) -> dict[str, Any]:
    forgotten = rig.forgotten
    return {"accepted": rig.take_accepted(), "forgotten": forgotten}


def _servos(rig: Rig) -> dict[str, Any]:
    return {"servos": rig.servo_states()}


def _statistics(rig: Rig) -> dict[str, Any]:
    struck = [{"kind": kind, "id": id, "count": n} for (kind, id), n in rig.injector.struck.items()]
    return {"struck": struck, "collisions": rig.wire.collisions, "instructions": rig.dispatcher.instructions}


_REQUESTS: dict[str, Callable[..., dict[str, Any]]] = {
    "hold": _hold,
    "push": _push,
    "furnish": _furnish,
    "lay": _lay,
    "roll": _roll,
    "move": _move,
    "joints": _joints,
    "press": _press,
    "inject": _inject,
    "truth": _truth,
    "accepted": _accepted,
    "servos": _servos,
    "statistics": _statistics,
}

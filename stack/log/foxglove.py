"""The log again for people, as plain numbers that Foxglove and PlotJuggler can draw.

Topics below `/view` follow Foxglove's message schemas where one fits (joints, frames, log lines) and hold nothing that
is not in the log's own channels. Whoever reads a log to repeat or to judge a run leaves them out. What was not measured
is left out, since JSON has no word for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.stack.log.tick import TickRecord
from servoid.stack.safety.event import Event

WORLD, BASE = "odometry", "base"  # frames
_LEVELS = {"fall": 4, "servo": 4, "stale": 4, "overload": 4, "temperature": 3, "voltage": 3, "derated": 3, "plan": 3}
_INFO = 2  # level of other events
_DIGITS = 5  # after the point: exact values are in the log's own channels, and these are twice as short
_SECOND = 1_000_000_000

_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


def _list(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


_VECTOR = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_JOINTS = _object(
    timestamp=_TIME, joints=_list(_object(name=_TEXT, position=_NUMBER, velocity=_NUMBER, effort=_NUMBER))
)
_TRANSFORM = _object(
    timestamp=_TIME,
    parent_frame_id=_TEXT,
    child_frame_id=_TEXT,
    translation=_VECTOR,
    rotation=_object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER),
)
_LOG = _object(
    timestamp=_TIME, level={"type": "integer"}, message=_TEXT, name=_TEXT, file=_TEXT, line={"type": "integer"}
)
_TWIST = _object(forward=_NUMBER, left=_NUMBER, turn=_NUMBER)
# Topic -> name of its schema, and the schema.
VIEWS: dict[str, tuple[str, dict[str, Any]]] = {
    "/view/joints": ("foxglove.JointStates", _JOINTS),
    "/view/targets": ("foxglove.JointStates", _JOINTS),
    "/view/frames": ("foxglove.FrameTransforms", _object(transforms=_list(_TRANSFORM))),
    "/view/log": ("foxglove.Log", _LOG),
    "/view/motion": (
        "servoid.view.motion",
        _object(phase=_TEXT, velocity=_TWIST, asked=_TWIST, height=_NUMBER, tilt=_NUMBER),
    ),
    "/view/health": (
        "servoid.view.health",
        _object(voltage=_NUMBER, temperature=_object(), late_ms=_NUMBER, missed={"type": "integer"}),
    ),
}

Message = tuple[str, dict[str, Any]]


def views(record: TickRecord, names: Sequence[str], wall_ns: int) -> list[Message]:
    """Topic and message of all that is to be seen of a tick, whose joints have these names."""
    stamp, observation, state = _stamp(wall_ns), record.observation, record.state
    measured = {"position": observation.position, "velocity": observation.velocity, "effort": observation.effort}
    out: list[Message] = [
        ("/view/joints", {"timestamp": stamp, "joints": _joints(names, measured)}),
        ("/view/targets", {"timestamp": stamp, "joints": _joints(names, {"position": record.command.position})}),
        (
            "/view/health",
            _known(voltage=_mean(observation.voltage), late_ms=record.timing.late * 1e-6)
            | {"missed": record.timing.missed, "temperature": _by_name(names, observation.temperature)},
        ),
    ]
    if state is not None:
        w, x, y, z = (float(value) for value in state.orientation)
        frame = {
            "timestamp": stamp,
            "parent_frame_id": WORLD,
            "child_frame_id": BASE,
            "translation": _named("xyz", state.displacement),
            "rotation": {"x": x, "y": y, "z": z, "w": w},
        }
        out.append(("/view/frames", {"transforms": [frame]}))
        going = np.array([*state.velocity[:2], state.angular_velocity[2]])
        motion: dict[str, Any] = {
            "phase": str(record.phase),
            "velocity": _named(_WAYS, going),
            "height": float(state.displacement[2]),
            "tilt": float(np.arccos(np.clip(-state.gravity[2], -1.0, 1.0))),
        }
        if record.proposal.instruction is not None:
            motion["asked"] = _named(_WAYS, record.proposal.instruction.velocity)
        out.append(("/view/motion", motion))
    return out + [line(event, wall_ns) for event in record.events]


def line(event: Event, wall_ns: int) -> Message:
    """An event as a line of Foxglove's log."""
    text = event.text if event.joint is None else f"{event.joint}: {event.text}"
    told = {"level": _LEVELS.get(event.kind, _INFO), "message": text, "name": event.kind, "file": "", "line": 0}
    return "/view/log", {"timestamp": _stamp(wall_ns)} | told


_WAYS = ("forward", "left", "turn")


def _stamp(wall_ns: int) -> dict[str, int]:
    seconds, rest = divmod(wall_ns, _SECOND)
    return {"sec": seconds, "nsec": rest}


def _joints(names: Sequence[str], fields: dict[str, Array]) -> list[dict[str, Any]]:
    columns = {field: np.round(values, _DIGITS).tolist() for field, values in fields.items()}
    return [
        {"name": name} | {field: values[i] for field, values in columns.items() if np.isfinite(values[i])}
        for i, name in enumerate(names)
    ]


def _by_name(names: Sequence[str], values: Array) -> dict[str, float]:
    return {name: value for name, value in zip(names, values.tolist(), strict=True) if np.isfinite(value)}


def _named(keys: Sequence[str], values: Array) -> dict[str, float]:
    return dict(zip(keys, np.round(np.asarray(values, dtype=float), _DIGITS).tolist(), strict=True))


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else np.nan


def _known(**values: float) -> dict[str, float]:
    return {key: value for key, value in values.items() if np.isfinite(value)}

"""What a flight log holds: channels, their fields, and how a tick becomes messages.

Messages are JSON; arrays are base64 with their type and shape. Observations and commands are float64: they are all
that a run feeds back on, so the estimator can be run again on them with identical results, and a replay compares them
bit by bit; rounded, a difference would hide until it has grown. What is derived from them is float32.
"""

from __future__ import annotations

import base64
import math
from typing import Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.operator import Halt, Intent
from servoid.stack.log.tick import TickRecord
from servoid.stack.safety.event import Event

FORMAT = 1
PROFILE = "servoid"

EXACT, COMPACT = "<f8", "<f4"

_OBSERVATION = {
    "position": "rad",
    "velocity": "rad/s",
    "effort": "N m",
    "temperature": "degrees C",
    "voltage": "V",
    "age": "s",
    "fault": "bits of the servos' hardware-error register",
    "orientation": "quaternion w x y z",
    "angular_velocity": "rad/s",
    "specific_force": "m/s2",
    "imu_age": "s",
}
_STATE = {
    "orientation": "quaternion w x y z, base in the odometry frame",
    "gravity": "unit vector, base frame",
    "yaw": "rad",
    "angular_velocity": "rad/s, base frame",
    "velocity": "m/s, heading frame",
    "displacement": "m, odometry frame; z above the soles",
    "position": "rad",
    "joint_velocity": "rad/s",
    "contact": "0..1",
}
_ARRAY = {
    "type": "object",
    "properties": {
        "dtype": {"type": "string"},
        "shape": {"type": "array", "items": {"type": "integer"}},
        "data": {"type": "string", "contentEncoding": "base64"},
    },
}
_INTEGER, _NUMBER, _TEXT = {"type": "integer"}, {"type": "number"}, {"type": "string"}


def _arrays(fields: dict[str, str]) -> dict[str, Any]:
    return {name: _ARRAY | {"description": unit} for name, unit in fields.items()}


def _schema(properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


# JSON schema of each channel. Ticks count from the first of the run, those of plans from the start of the task.
SCHEMAS: dict[str, dict[str, Any]] = {
    "/run": _schema({"format": _INTEGER, "settings": {"type": "object"}, "robot": {"type": "object"}}),
    "/observation": _schema({"tick": _INTEGER, "time_ns": _INTEGER} | _arrays(_OBSERVATION)),
    "/state": _schema({"tick": _INTEGER} | _arrays(_STATE)),
    "/command": _schema(
        {"tick": _INTEGER, "mode": _TEXT, "phase": _TEXT} | _arrays({"position": "rad", "gain": "of the firmware's"})
    ),
    "/instruction": _schema(
        {"tick": _INTEGER, "source": _TEXT, "text": _TEXT, "skill": _TEXT}
        | _arrays(
            {
                "velocity": "m/s, m/s, rad/s",
                "goal": "m, heading frame",
                "path": "m, heading frame",
                "ground": "m/s over the ground, heading frame",
                "place": "m, goal in the odometry frame",
                "obstacles": "x, y, radius m, odometry frame",
                "robots": "x, y m and heading rad, odometry frame",
                "objects": "x, y, z m of the middle and quaternion w x y z, odometry frame",
            }
        )
    ),
    "/intent": _schema(
        {"tick": _INTEGER, "sequence": _INTEGER, "age": _NUMBER, "text": _TEXT, "ends": {"type": "boolean"}}
        | {"halt": _INTEGER, "skill": _TEXT, "skills": _INTEGER}
        | _arrays({"way": "forward, left, turning left, -1..1", "goal": "m, odometry frame"})
    ),
    "/plan": _schema(
        {"tick": _INTEGER, "requested": _INTEGER, "adopted": _INTEGER, "first": _INTEGER, "seconds": _NUMBER}
        | _arrays({"actions": "rad", "states": "features", "path": "m, heading frame of the requested tick"})
        | _arrays({"ticks": "of states and path, ahead of the requested tick"})
    ),
    "/event": _schema({"tick": _INTEGER, "time": _NUMBER, "kind": _TEXT, "joint": _TEXT, "text": _TEXT}),
    "/timing": _schema(
        {"tick": _INTEGER}
        | {name: _INTEGER for name in ("late", "missed", "read", "estimate", "act", "guard", "write", "record")}
    ),
    "/result": _schema({"outcome": _TEXT, "success": {"type": "boolean"}, "metrics": {"type": "object"}}),
}
# What a replay may change: channels, None standing for all of their fields. A rig's clock begins anywhere.
MACHINE_DEPENDENT = {
    "/run": None,
    "/timing": None,
    "/result": None,
    "/plan": ("seconds",),
    "/observation": ("time_ns",),
}


def pack(array: Any, dtype: str) -> dict[str, Any]:
    """An array as a JSON value."""
    values = np.ascontiguousarray(array, dtype=dtype)
    shape = list(np.shape(array))
    return {"dtype": dtype, "shape": shape, "data": base64.b64encode(values.tobytes()).decode("ascii")}


def unpack(value: dict[str, Any]) -> Array:
    """The array of a JSON value."""
    return np.frombuffer(base64.b64decode(value["data"]), value["dtype"]).reshape(value["shape"])


def plain(value: Any) -> Any:
    """Values as JSON knows them: tuples as lists, numpy scalars as numbers, what is not finite as null."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, (str, int, float, bool, type(None))) else str(value)


def messages(record: TickRecord) -> list[tuple[str, dict[str, Any]]]:
    """Channel and message of everything in a tick."""
    tick, proposal = {"tick": record.tick}, record.proposal
    observation = {
        name: pack(getattr(record.observation, name), "<i4" if name == "fault" else EXACT) for name in _OBSERVATION
    }
    command = {"position": pack(record.command.position, EXACT), "gain": pack(record.command.gain, EXACT)}
    out: list[tuple[str, dict[str, Any]]] = [
        ("/observation", tick | {"time_ns": record.observation.time_ns} | observation),
        ("/command", tick | {"mode": record.command.mode.name, "phase": str(record.phase)} | command),
    ]
    if record.state is not None:
        out.append(("/state", tick | {name: pack(getattr(record.state, name), COMPACT) for name in _STATE}))
    if proposal.instruction is not None:
        instruction: dict[str, Any] = tick | {"velocity": pack(proposal.instruction.velocity, COMPACT)}
        if proposal.instruction.text is not None:
            instruction["text"] = proposal.instruction.text
        if proposal.instruction.skill is not None:
            instruction["skill"] = proposal.instruction.skill
        arrays = {name: getattr(proposal.instruction, name) for name in ("goal", "path", "ground")}
        if (percept := proposal.percept) is not None:
            instruction["source"] = percept.source
            arrays |= {"place": percept.goal, "obstacles": percept.obstacles, "robots": percept.robots}
            arrays |= {"objects": percept.objects}
        instruction |= {name: pack(array, COMPACT) for name, array in arrays.items() if array is not None}
        out.append(("/instruction", instruction))
    if record.intent is not None:
        out.append(("/intent", tick | intent_message(record.intent)))
    if proposal.plan is not None:
        plan = proposal.plan.plan
        out.append((
            "/plan",
            tick
            | {"requested": proposal.plan.requested, "adopted": proposal.plan.adopted, "first": plan.tick}
            | {name: pack(getattr(plan, name), COMPACT) for name in ("actions", "states", "path")}
            | ({} if plan.ticks is None else {"ticks": pack(plan.ticks, "<i4")})
            | {"seconds": plan.seconds},
        ))  # fmt: skip
    out += [("/event", event_message(event)) for event in record.events]
    timing = record.timing
    out.append(("/timing", tick | {name: getattr(timing, name) for name in timing.__slots__}))
    return out


def event_message(event: Event) -> dict[str, Any]:
    return {name: getattr(event, name) for name in event.__slots__}


def intent_message(intent: Intent) -> dict[str, Any]:
    """An intent as JSON. One from nobody, whose age is infinite, has no age."""
    message: dict[str, Any] = {
        "sequence": intent.sequence,
        "age": intent.age if math.isfinite(intent.age) else None,
        "way": pack(intent.way, EXACT),
        "ends": intent.ends,
        "halt": int(intent.halt),
    }
    if intent.goal is not None:
        message["goal"] = pack(intent.goal, EXACT)
    if intent.skill is not None:
        message |= {"skill": intent.skill, "skills": intent.skills}
    return message if intent.text is None else message | {"text": intent.text}


def read_intent(message: dict[str, Any]) -> Intent:
    """The intent that `intent_message` wrote."""
    return Intent(
        sequence=message["sequence"],
        age=math.inf if message["age"] is None else message["age"],
        way=unpack(message["way"]),
        goal=unpack(message["goal"]) if "goal" in message else None,
        text=message.get("text"),
        skill=message.get("skill"),
        skills=message.get("skills", 0),
        ends=message["ends"],
        halt=Halt(message["halt"]),
    )

"""A tracker's network, what it observes by, and the gait that it learned on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import CheckpointError, read_header
from servoid.policy.mlp import Mlp
from servoid.policy.references.gait import GaitSettings, gait_of
from servoid.policy.tracker.observation import TrackerObservation
from servoid.policy.tracker.points import PointObservation


def load_tracker(path: Path, robot: Robot, shape: tuple[int, ...] = ()) -> tuple[Mlp, TrackerObservation]:
    """The network in `path`, and what it observes by, of leading dimensions `shape`. Raises CheckpointError."""
    config = read_header(path).get("config")
    known: Mapping[str, Any] = config if isinstance(config, dict) else {}
    observation = observation_of(robot, shape, clips="clips" in known, points=bool(known.get("points")))
    return Mlp.load(path, "tracker", robot, observation.size)[0], observation


def observation_of(robot: Robot, shape: tuple[int, ...], *, clips: bool, points: bool) -> TrackerObservation:
    """Of a tracker of the gait alone, of one of `clips` and any reference, or of one that sees key points alone."""
    return PointObservation(robot, shape) if points else TrackerObservation(robot, shape, clips=clips)


def gait_of_tracker(path: Path, robot: Robot) -> GaitSettings:
    """Settings of the gait that the tracker in `path` walks by: its own where it learned on another one than the
    robot's. Raises CheckpointError."""
    config = read_header(path).get("config")
    own = config.get("gait") if isinstance(config, dict) else None
    if own is None:
        return gait_of(robot)
    try:
        values: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in own.items()
        }
        return GaitSettings(**values)
    except (AttributeError, TypeError) as error:
        raise CheckpointError(f"{path}: its gait is not one of this program: {error}") from error


def written(gait: GaitSettings) -> Mapping[str, Any]:
    """A gait as a header holds it."""
    return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(gait).items()}

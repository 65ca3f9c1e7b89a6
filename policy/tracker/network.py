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


def load_tracker(path: Path, robot: Robot) -> tuple[Mlp, bool]:
    """The network in `path`, and whether it tracks clips too: see `TrackerObservation`. Raises CheckpointError."""
    config = read_header(path).get("config")
    clips = isinstance(config, dict) and "clips" in config
    network, _ = Mlp.load(path, "tracker", robot, TrackerObservation(robot, clips=clips).size)
    return network, clips


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

"""A tracker's network, and what it observes by."""

from __future__ import annotations

from pathlib import Path

from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import read_header
from servoid.policy.mlp import Mlp
from servoid.policy.tracker.observation import TrackerObservation


def load_tracker(path: Path, robot: Robot) -> tuple[Mlp, bool]:
    """The network in `path`, and whether it tracks clips too: see `TrackerObservation`. Raises CheckpointError."""
    config = read_header(path).get("config")
    clips = isinstance(config, dict) and "clips" in config
    network, _ = Mlp.load(path, "tracker", robot, TrackerObservation(robot, clips=clips).size)
    return network, clips

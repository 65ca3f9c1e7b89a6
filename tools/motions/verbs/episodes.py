"""Clips of the episodes of LeRobot datasets: what `servoid collect` and `servoid dataset add` record, or others."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError, available
from servoid.hw.contracts.body import Array
from servoid.hw.geometry import headed, joined, multiply, rotate
from servoid.hw.robot.description import Robot
from servoid.hw.robot.legs import Legs
from servoid.policy.features import raw_layout, recorded_names
from servoid.policy.motion.clip import About, Clip
from servoid.stack.estimation.estimator import FOOT_SOFTNESS
from servoid.tools.learn.dataset.reader import Dataset, read_dataset

_STATE, _GOALS = "observation.state", "action"
_OTHERS = ".pos"  # LeRobot's own robots call a joint's position so
_SLACK = 0.02  # rad beyond a joint's range: what floats and a servo's own clipping come to


def clip_of_episode(folder: Path, episode: int | None, robot: Robot, name: str, about: About) -> Clip:
    """The goals of an episode, with the motion of the base that it holds; where it holds none, that of a robot which
    plays the goals in physics. `episode` may be None where there is one.

    Raises ConfigError for a dataset of another robot or rate, or where a column is missing.
    """
    dataset = read_dataset(folder)
    number = _number(dataset, episode)
    order = _order(dataset, robot)
    if dataset.info["fps"] != robot.rate:
        raise ConfigError(
            f"{folder}: has {dataset.info['fps']} frames a second, and {robot.name} runs at {robot.rate}: record it at "
            "that rate"
        )
    estimated = _names(dataset, _STATE) == recorded_names(robot)[_STATE]
    columns = dataset.columns([_GOALS, _STATE] if estimated else [_GOALS], number)
    goals = columns[_GOALS].astype(float)[:, order]
    beyond = np.maximum(robot.lower - goals, goals - robot.upper).max(0)
    if not np.isfinite(goals).all() or (beyond > _SLACK).any():
        far = ", ".join(f"{robot.names[i]} by {beyond[i]:.2f}" for i in np.flatnonzero(~(beyond <= _SLACK)))
        raise ConfigError(f"{folder}: episode {number} goes beyond the joint ranges of {robot.name}: {far} rad")
    if not estimated:
        from servoid.tools.motions.physics import play

        return play(goals, robot, begins=about.begins).as_clip(name, about)
    fields: Mapping[str, Array] = raw_layout(len(robot.joints)).split(columns[_STATE].astype(float))
    turn = _orientation(fields["gravity"], fields["yaw"][:, 0])
    place, contact = fields["displacement"], _contact(fields["position"], turn, robot)
    return Clip(name, goals, place, turn, contact, about).placed()


def _number(dataset: Dataset, episode: int | None) -> int:
    count = len(dataset.episodes)
    if episode is None and count == 1:
        return 0
    if episode is None or not 0 <= episode < count:
        what = "episode missing" if episode is None else f"no episode {episode}"
        raise ConfigError(f"{dataset.folder}: {what}; choose one with --episode: 0 to {count - 1}")
    return episode


def _names(dataset: Dataset, column: str) -> tuple[str, ...]:
    """Names of a column's numbers; nothing where there is no such column, or they have no names."""
    names: Any = dataset.features.get(column, {}).get("names")
    if isinstance(names, dict):  # grouped by kind: {"motors": [...]}
        names = [name for group in names.values() for name in group]
    return tuple(map(str, names or ()))


def _order(dataset: Dataset, robot: Robot) -> list[int]:
    """Where the joints of the robot are in a row of goals. Raises ConfigError."""
    if _GOALS not in dataset.features:
        raise ConfigError(f"{dataset.folder}: no column '{_GOALS}'; it has {', '.join(dataset.features)}")
    kind = str(dataset.info["robot_type"])
    names = [name.removesuffix(_OTHERS) for name in _names(dataset, _GOALS)]
    lacking = [joint for joint in robot.names if joint not in names]
    if lacking or (kind != robot.name and kind in available("robots")):
        why = f"its '{_GOALS}' has no {', '.join(lacking[:4])}{' ...' if len(lacking) > 4 else ''}"
        raise ConfigError(
            f"{dataset.folder}: is of robot '{kind}', not of {robot.name}" + (f": {why}" if lacking else "")
        )
    return [names.index(joint) for joint in robot.names]


def _orientation(gravity: Array, yaw: Array) -> Array:
    """Quaternions `(ticks, 4)` w x y z by gravity `(ticks, 3)` in the base frame and the heading `(ticks,)` rad."""
    roll = np.arctan2(-gravity[:, 1], -gravity[:, 2]) / 2
    pitch = np.arctan2(gravity[:, 0], np.hypot(gravity[:, 1], gravity[:, 2])) / 2
    none = np.zeros(len(roll))
    tilted = multiply(joined(np.cos(pitch), none, np.sin(pitch), none), joined(np.cos(roll), np.sin(roll), none, none))
    return headed(tilted, yaw)


def _contact(joints: Array, turn: Array, robot: Robot) -> Array:
    """How much each foot carries `(ticks, n_feet)`, 0 to 1. A dataset does not say: by how much lower its sole is than
    the others, as the estimator has it."""
    legs = Legs(robot)
    _, corners = legs.soles(legs.pick(joints))
    lowest = rotate(turn[:, None, None, :], corners)[..., 2].min(-1)
    share = np.exp(-(lowest - lowest.min(-1, keepdims=True)) / FOOT_SOFTNESS)
    return share / share.sum(-1, keepdims=True)

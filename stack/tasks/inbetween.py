"""Pass through keyframes of recorded motions at given times; what lies between them is the robot's affair."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, Keyframes, State
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import Percept
from servoid.hw.geometry import to_heading, turned
from servoid.hw.robot.description import Robot
from servoid.policy.diffusion.features import Layout, raw_layout
from servoid.stack.log.flightlog import FlightLog, read_log
from servoid.stack.tasks.base import BaseTask, Settings, require_positive

_SOON = 0.2  # s: nearer keyframes are not hurried to
_FASTEST = np.array([0.25, 0.1, 0.8])  # m/s forward and to the left, rad/s, of the asked velocity


@dataclass(frozen=True)
class InbetweenSettings(Settings):
    seconds: Annotated[float, "s at most; the episode ends with its last keyframe"] = 60.0
    clips: Annotated[tuple[Path, ...], "flight logs of recorded motions: FILE:FILE:..."] = ()
    count: Annotated[int, "clips in an episode, drawn from those, one after the other"] = 3
    keyframes: Annotated[int, "of each clip"] = 3
    interval: Annotated[float, "s between keyframes"] = 0.52

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "count", "keyframes", "interval")


class Inbetween(BaseTask):
    name = "inbetween"
    description = "pass through keyframes of recorded motions"
    settings_type = InbetweenSettings

    def __init__(self, settings: InbetweenSettings, dt: float) -> None:
        """Raises ConfigError for a clip that cannot be read or is too short."""
        super().__init__(settings, dt)
        self._interval = max(round(settings.interval / dt), 1)
        self._span = settings.keyframes * self._interval
        self._clips = {path: _rows(read_log(path), dt, self._span) for path in settings.clips}
        self._robot: Robot | None = None

    def check(self, robot: Robot) -> None:
        """Raise ConfigError where a clip is another robot's, or leaves the joints' limits."""
        self._robot = robot
        layout = raw_layout(len(robot.joints))
        for path, rows in self._clips.items():
            if rows.shape[1] != layout.size:
                raise ConfigError(f"{path}: recorded on another robot than {robot.name}: its joints are not as many")
            joints = rows[:, layout.slice("position")]
            outside = np.argwhere((joints < robot.lower - 1e-6) | (joints > robot.upper + 1e-6))
            if len(outside):
                row, joint = outside[0]
                low, high = robot.lower[joint], robot.upper[joint]
                raise ConfigError(
                    f"{path}: tick {row} of the task: {robot.names[joint]} is at {joints[row, joint]:.3f} rad, outside"
                    f" its limits {low:.3f} to {high:.3f}: no keyframe can be taken from this clip"
                )

    def reset(self, rng: np.random.Generator) -> None:
        """Draw clips and where in them, and string them together. Raises ConfigError without clips."""
        if not self._clips:
            raise ConfigError(
                "inbetween: no clips: record some, as with `servoid run walk --policy expert --record FILE`, and give"
                " them with --set clips=FILE:FILE"
            )
        motions, frames, place, yaw = list(self._clips.values()), [], np.zeros(2), 0.0
        for _ in range(self.settings.count):
            rows = motions[int(rng.integers(len(motions)))]
            start = int(rng.integers(len(rows) - self._span))
            picked = rows[start : start + self._span + 1 : self._interval]
            moved = _moved(picked, place, yaw)
            frames.append(moved[1:])
            layout = raw_layout((rows.shape[1] - raw_layout(0).size) // 2)
            place, yaw = moved[-1, layout.slice("displacement")][:2], float(moved[-1, layout.slice("yaw")][0])
        self._layout: Layout = layout
        self._frames: Array = np.concatenate(frames)  # (keyframes of the episode, state features)
        self._ticks: Array = self._interval * np.arange(1, len(self._frames) + 1)
        self._tick = 0

    def percept(self, state: State) -> Percept:
        return Percept(source="task", age=0.0, goal=self._places[-1, :2].copy())

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        """The keyframes that are still to come, and the velocity that comes to the next one in time."""
        self._tick = tick
        coming = self._ticks > tick
        if not coming.any():
            return Instruction(velocity=np.zeros(3))
        ahead, frames = self._ticks[coming] - tick, self._frames[coming]
        seconds = max(float(ahead[0]) * self.dt, _SOON)
        turn = float(frames[0, self._layout.slice("yaw")][0]) - float(state.yaw)
        turn = (turn + math.pi) % (2.0 * math.pi) - math.pi
        way = to_heading(frames[0, self._layout.slice("displacement")][:2], state)
        velocity = np.clip(np.array([*way, turn]) / seconds, -_FASTEST, _FASTEST)
        return Instruction(velocity=velocity, keyframes=Keyframes(ahead, frames.astype(np.float32)))

    @property
    def guides(self) -> bool:
        """By the velocity alone, there being no cost of keyframes."""
        return self.settings.cost.twist

    def done(self, state: State) -> bool:
        return self._tick >= self._ticks[-1]

    def success(self, trace: Trace) -> bool:
        """Not fallen until the last keyframe. How near it came is among the metrics, as in the paper."""
        return not trace.fallen and len(trace.yaw) > self._ticks[-1]

    def metrics(self, trace: Trace) -> dict[str, float]:
        """Mean error at the keyframes that it lived to see: of the base (`mrpe_m`), and of the joints' places relative
        to the base (`mjpe_m`), for a robot that is known."""
        seen = self._ticks < len(trace.yaw)
        if not seen.any():
            return {"mrpe_m": float("nan"), "mjpe_m": float("nan")}
        ticks = self._ticks[seen]
        base = np.linalg.norm(trace.displacement[ticks] - self._places[seen], axis=1).mean()
        joints = float("nan")
        if self._robot is not None and trace.joints is not None:
            from servoid.sim.kinematics import joint_places

            wanted = self._frames[seen][:, self._layout.slice("position")]
            apart = joint_places(self._robot, trace.joints[ticks]) - joint_places(self._robot, wanted)
            joints = float(np.linalg.norm(apart, axis=-1).mean())
        return {"mrpe_m": float(base), "mjpe_m": joints}

    @property
    def _places(self) -> Array:
        """Where the base shall be at the keyframes `(n, 3)` m."""
        return self._frames[:, self._layout.slice("displacement")]


def _rows(log: FlightLog, dt: float, span: int) -> Array:
    """State features of each tick of a log's task `(ticks, state features)`. Raises ConfigError."""
    task = set(log.ticks("/instruction").tolist())
    chosen = np.array([tick in task for tick in log.ticks("/state").tolist()], dtype=bool)
    if abs(1.0 / log.header["robot"]["rate"] - dt) > 1e-9:
        raise ConfigError(f"{log.path}: recorded at {log.header['robot']['rate']} ticks a second, not {1.0 / dt:g}")
    if chosen.sum() <= span:
        raise ConfigError(f"{log.path}: its task lasted {chosen.sum()} ticks; keyframes need more than {span}")
    fields = [name for name, _ in raw_layout(0).fields]
    columns = [log.column("/state", name)[chosen].astype(float) for name in fields]
    return np.concatenate([column.reshape(len(column), -1) for column in columns], axis=1)


def _moved(rows: Array, place: Array, yaw: float) -> Array:
    """State features `(n, size)`, moved over the ground so that the first row is at `place` `(2,)` m and `yaw`."""
    layout = raw_layout((rows.shape[1] - raw_layout(0).size) // 2)
    moved = rows.copy()
    where, heading = layout.slice("displacement"), layout.slice("yaw")
    turn = yaw - float(rows[0, heading][0])
    planar = slice(where.start, where.start + 2)
    moved[:, planar] = turned(rows[:, planar] - rows[0, planar], turn) + place
    moved[:, heading] += turn
    return moved

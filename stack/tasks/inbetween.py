"""Pass through keyframes of recorded motions at given times; how it gets from one to the next is up to the robot."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, Keyframes, State
from servoid.hw.contracts.task import Criterion, Episode, Trace
from servoid.hw.contracts.world import Percept
from servoid.hw.geometry import to_heading, turned
from servoid.hw.robot.description import Robot, shipped_robot
from servoid.hw.setting import Setting
from servoid.policy.features import Layout, raw_layout
from servoid.stack.log.flightlog import FlightLog, read_log
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, Settings

_SOON = 0.2  # s: nearer keyframes are not hurried to
_FASTEST = np.array([0.25, 0.1, 0.8])  # m/s forward and to the left, rad/s, that is asked of the shipped robot


@dataclass(frozen=True)
class InbetweenSettings(Settings):
    seconds: Annotated[float, Setting("longest episode; it ends with its last keyframe", "s", above=0)] = 60.0
    clips: Annotated[tuple[Path, ...], Setting("flight logs of recorded motions: FILE:FILE:...")] = ()
    count: Annotated[int, Setting("clips in an episode, drawn from those, one after the other", above=0)] = 3
    keyframes: Annotated[int, Setting("keyframes of each clip", above=0)] = 3
    interval: Annotated[float, Setting("time between keyframes", "s", above=0)] = 0.52


@dataclass(frozen=True, kw_only=True)
class KeyframeEpisode(Episode):
    frames: Array  # (n, state features) to be in at
    ticks: Array  # (n,) int

    @property
    def layout(self) -> Layout:
        return _layout(self.frames)

    @property
    def places(self) -> Array:
        """Where the base shall be at the keyframes `(n, 3)` m."""
        return self.frames[:, self.layout.slice("displacement")]


class Inbetween(BaseTask):
    name = "inbetween"
    description = "pass through keyframes of recorded motions"
    settings_type = InbetweenSettings
    guided_by_velocity_alone = True  # there is no cost of keyframes

    def __init__(self, settings: InbetweenSettings, dt: float, robot: Robot | None = None) -> None:
        """Raises ConfigError for a clip that cannot be read, is too short, is another robot's, or leaves its limits."""
        super().__init__(settings, dt, robot)
        self._interval = self.ticks(settings.interval)
        self._span = settings.keyframes * self._interval
        self._clips = {path: _rows(read_log(path), dt, self._span) for path in settings.clips}
        if robot is not None:
            for path, rows in self._clips.items():
                _check(path, rows, robot)

    def scenario(self, rng: np.random.Generator) -> KeyframeEpisode:
        """Draw clips and where in them, and string them together. Raises ConfigError without clips."""
        if not self._clips:
            raise ConfigError(
                "inbetween: no clips: record some, as with `servoid run walk --policy expert --record FILE`, and name"
                " them with --set clips=FILE:FILE"
            )
        motions, frames, place, yaw = list(self._clips.values()), [], np.zeros(2), 0.0
        for _ in range(self.settings.count):
            rows = motions[int(rng.integers(len(motions)))]
            start = int(rng.integers(len(rows) - self._span))
            picked = rows[start : start + self._span + 1 : self._interval]
            moved = _moved(picked, place, yaw)
            frames.append(moved[1:])
            layout = _layout(rows)
            place, yaw = moved[-1, layout.slice("displacement")][:2], float(moved[-1, layout.slice("yaw")][0])
        joined = np.concatenate(frames)
        return KeyframeEpisode(frames=joined, ticks=self._interval * np.arange(1, len(joined) + 1))

    def behaviour(self, episode: KeyframeEpisode) -> BaseBehaviour:
        return _Pass(episode, self.dt, _FASTEST * (self.robot or shipped_robot()).walking.relative)

    def criteria(self, trace: Trace, episode: KeyframeEpisode) -> list[Criterion]:
        """Not fallen until the last keyframe. How near it came is among the metrics, as in the paper."""
        least = int(episode.ticks[-1]) + 1
        return [Criterion.never("fell", trace.fallen), Criterion("lasted", len(trace.yaw), "ticks", least=least)]

    def metrics(self, trace: Trace, episode: KeyframeEpisode) -> dict[str, float]:
        """Mean error at the keyframes that it lived to see: of the base (`mrpe_m`), and of the joints' places relative
        to the base (`mjpe_m`), for a robot that is known."""
        seen = episode.ticks < len(trace.yaw)
        if not seen.any():
            return {"mrpe_m": float("nan"), "mjpe_m": float("nan")}
        ticks = episode.ticks[seen]
        base = np.linalg.norm(trace.displacement[ticks] - episode.places[seen], axis=1).mean()
        joints = float("nan")
        if self.robot is not None and trace.joints is not None:
            from servoid.sim.kinematics import joint_places

            wanted = episode.frames[seen][:, episode.layout.slice("position")]
            apart = joint_places(self.robot, trace.joints[ticks]) - joint_places(self.robot, wanted)
            joints = float(np.linalg.norm(apart, axis=-1).mean())
        return {"mrpe_m": float(base), "mjpe_m": joints}


class _Pass(BaseBehaviour):
    def __init__(self, episode: KeyframeEpisode, dt: float, fastest: Array) -> None:
        super().__init__(episode)
        self._dt, self._fastest, self._tick = dt, fastest, 0

    def percept(self, state: State) -> Percept:
        return Percept(source="task", age=0.0, goal=self.episode.places[-1, :2].copy())

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        """The keyframes that are still to come, and the velocity that comes to the next one in time."""
        self._tick, layout = tick, self.episode.layout
        coming = self.episode.ticks > tick
        if not coming.any():
            return Instruction(velocity=np.zeros(3))
        ahead, frames = self.episode.ticks[coming] - tick, self.episode.frames[coming]
        seconds = max(float(ahead[0]) * self._dt, _SOON)
        turn = float(frames[0, layout.slice("yaw")][0]) - float(state.yaw)
        turn = (turn + math.pi) % (2.0 * math.pi) - math.pi
        way = to_heading(frames[0, layout.slice("displacement")][:2], state)
        velocity = np.clip(np.array([*way, turn]) / seconds, -self._fastest, self._fastest)
        return Instruction(velocity=velocity, keyframes=Keyframes(ahead, frames.astype(np.float32)))

    def done(self, state: State) -> bool:
        return bool(self._tick >= self.episode.ticks[-1])


def _check(path: Path, rows: Array, robot: Robot) -> None:
    """Raise ConfigError where a clip is another robot's, or leaves the joints' limits."""
    layout = raw_layout(len(robot.joints))
    if rows.shape[1] != layout.size:
        raise ConfigError(f"{path}: recorded on another robot than {robot.name}: the number of joints differs")
    joints = rows[:, layout.slice("position")]
    outside = np.argwhere((joints < robot.lower - 1e-6) | (joints > robot.upper + 1e-6))
    if len(outside):
        row, joint = outside[0]
        low, high = robot.lower[joint], robot.upper[joint]
        raise ConfigError(
            f"{path}: tick {row} of the task: {robot.names[joint]} is at {joints[row, joint]:.3f} rad, outside"
            f" its limits {low:.3f} to {high:.3f}: no keyframe can be taken from this clip"
        )


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
    layout, moved = _layout(rows), rows.copy()
    where, heading = layout.slice("displacement"), layout.slice("yaw")
    turn = yaw - float(rows[0, heading][0])
    planar = slice(where.start, where.start + 2)
    moved[:, planar] = turned(rows[:, planar] - rows[0, planar], turn) + place
    moved[:, heading] += turn
    return moved


def _layout(rows: Array) -> Layout:
    """The layout of state features, by their number."""
    return raw_layout((rows.shape[1] - raw_layout(0).size) // 2)

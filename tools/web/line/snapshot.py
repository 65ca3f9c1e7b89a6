"""What the page is told of a tick: a copy, so that the loop and the page share nothing."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import State
from servoid.hw.contracts.world import Truth
from servoid.hw.geometry import turned
from servoid.stack.log.tick import TickRecord
from servoid.stack.safety.event import Event

MEMORY = 150  # ticks for which a plan may have been under way


@dataclass(frozen=True)
class RunInfo:
    """What the page is told once, when a run begins."""

    robot: str  # name or file
    title: str  # what runs: the task, say
    backend: str
    policy: str
    simulated: bool  # whether there is a truth to be shown
    gain: float = 1.0
    goal: Array | None = None  # (2,) m in the frame that the robot starts in, where the episode fixes one
    reach: float | None = None  # m around the goal that count as there
    path: Array | None = None  # (n, 2) m, the way that the robot shall walk, in that frame
    steers: bool = True  # whether there is anything to be in control of
    insists: bool = True  # whether a wish to stop that is not heeded is sent as the signal of Ctrl-C
    length: float | None = None  # s of a log that is looked back into; None: a run
    events: tuple[Event, ...] = ()  # that are known from the beginning: of a log
    skills: tuple[str, ...] = ()  # that can be asked for
    pillars: int | None = None  # how many of the obstacles stand, the first ones; the others roll. None: all stand


@dataclass(frozen=True)
class BodyPose:
    """A robot somewhere."""

    place: Array  # (3,) m of the base
    orientation: Array  # (4,) quaternion w x y z
    joints: Array  # (n_joints,) rad


@dataclass(frozen=True)
class PlanOutcome:
    """What came of a plan."""

    places: Array  # (n, 2) m, where the robot was at the plan's ticks
    off: float  # m between the last of them and where the plan had it,
    ticks: float  # this many ticks after it was asked for


@dataclass(frozen=True)
class Snapshot:
    """One tick. Places are in the odometry frame, but for the truth, which is in the world's."""

    tick: int
    time: float  # s since the first tick of the run
    phase: str
    position: Array  # (n_joints,) rad, as measured; what was not read is NaN
    target: Array  # (n_joints,) rad
    effort: Array  # (n_joints,) N m
    temperature: Array  # (n_joints,) degrees C
    voltage: Array  # (n_joints,) V
    age: Array  # (n_joints,) s
    fault: Array  # (n_joints,) bits of the servos' hardware-error register
    gain: Array  # (n_joints,) of the firmware's
    late: float  # ms that the tick began late
    busy: float  # ms that it took
    missed: int  # ticks that were skipped before it
    pose: BodyPose | None = None  # the estimate
    velocity: Array | None = None  # (3,) m/s forward, m/s left, rad/s: the estimate
    tilt: float = float("nan")  # rad
    contact: Array | None = None  # (n_feet,) 0..1
    asked: Array | None = None  # (3,) velocity that the task asks for
    text: str | None = None
    goal: Array | None = None  # (2,) m
    path: Array | None = None  # (n, 2) m: where to be at the next ticks
    obstacles: Array | None = None  # (n, 3) m: x, y, radius
    robots: Array | None = None  # (n, 3): x, y m and heading rad
    plan: Array | None = None  # (n, 2) m: where the robot means to go, where a plan was adopted at this tick
    truth: BodyPose | None = None
    beside: BodyPose | None = None  # another pose to be compared with: of a reference, or of another run
    became: PlanOutcome | None = None  # of the newest plan, where what came after it is known
    other: Snapshot | None = None  # the same moment of another run
    handles: dict[str, Array] | None = None  # (3,) m: what can be dragged in the picture, by name
    events: tuple[Event, ...] = field(default=())


class Snapshots:
    """Makes snapshots of ticks. It remembers where the robot was when plans were asked for."""

    def __init__(self, start_ns: int | None = None) -> None:
        """`start_ns` is time 0 by the body's clock, by default that of the first tick."""
        self._first_ns = start_ns
        self._states: deque[tuple[Array, float]] = deque(maxlen=MEMORY)  # displacement and heading of the last ticks

    def take(self, record: TickRecord, truth: Truth | None, events: tuple[Event, ...]) -> Snapshot:
        """The snapshot of a tick; `events` are those of this tick and of earlier ones that were not told yet."""
        seen, proposal, timing = record.observation, record.proposal, record.timing
        self._first_ns = seen.time_ns if self._first_ns is None else self._first_ns
        percept, instruction, state = proposal.percept, proposal.instruction, record.state
        if state is not None:
            self._states.append((state.displacement, float(state.yaw)))
        return Snapshot(
            tick=record.tick,
            time=(seen.time_ns - self._first_ns) * 1e-9,
            phase=str(record.phase),
            position=seen.position,
            target=record.command.position,
            effort=seen.effort,
            temperature=seen.temperature,
            voltage=seen.voltage,
            age=seen.age,
            fault=seen.fault,
            gain=record.command.gain,
            late=timing.late * 1e-6,
            busy=(timing.read + timing.estimate + timing.act + timing.guard + timing.write + timing.record) * 1e-6,
            missed=timing.missed,
            pose=None if state is None else BodyPose(state.displacement, state.orientation, state.position),
            velocity=None if state is None else np.array([*state.velocity[:2], state.angular_velocity[2]]),
            tilt=np.nan if state is None else float(np.arccos(np.clip(-state.gravity[2], -1.0, 1.0))),
            contact=None if state is None else state.contact,
            asked=None if instruction is None else instruction.velocity,
            text=None if instruction is None else instruction.text,
            goal=_goal(record),
            path=None if instruction is None or state is None else _placed(instruction.path, state),
            obstacles=None if percept is None else percept.obstacles,
            robots=None if percept is None else percept.robots,
            plan=self._plan(record),
            truth=None if truth is None else BodyPose(*(np.array(part[0]) for part in _parts(truth))),
            events=events,
        )

    def _plan(self, record: TickRecord) -> Array | None:
        """The path of a plan that was adopted at this tick, from where the robot was when it was asked for."""
        adopted = record.proposal.plan
        if adopted is None or record.state is None:
            return None
        ago = adopted.adopted - adopted.requested
        if not 0 <= ago < len(self._states):
            return None
        place, yaw = self._states[-1 - ago]
        path = np.asarray(adopted.plan.path, dtype=float)
        return place[:2] + turned(path, yaw) if np.isfinite(path).all() else None


def _goal(record: TickRecord) -> Array | None:
    """Where the robot is to go, in the odometry frame."""
    percept, instruction = record.proposal.percept, record.proposal.instruction
    if percept is not None and percept.goal is not None:
        return percept.goal
    if instruction is None or record.state is None:
        return None
    return _placed(instruction.goal, record.state)


def _placed(points: Array | None, state: State) -> Array | None:
    """Points `(..., 2)` of the heading frame in the odometry frame."""
    return None if points is None else state.displacement[:2] + turned(points, float(state.yaw))


def _parts(truth: Truth) -> tuple[Array, Array, Array]:
    return truth.position, truth.orientation, truth.joints

"""One run, composed from its settings: what the command line, the Python API, rollouts and replays all use."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.backend import Backend
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Policy
from servoid.hw.contracts.task import Task, Trace
from servoid.hw.contracts.world import Scene
from servoid.hw.robot.calibration import calibrated
from servoid.hw.robot.description import Robot, load_robot
from servoid.stack.control.policies import make_policy, policy_fingerprint
from servoid.stack.estimation.estimator import Estimator
from servoid.stack.estimation.odometry import load_odometry
from servoid.stack.log.tick import Listener, TickRecord
from servoid.stack.runtime.backends import backend_kind, make_backend
from servoid.stack.runtime.clock import RealTime, Schedule, WallClock
from servoid.stack.runtime.interrupt import Interrupt, Stops
from servoid.stack.runtime.loop import Loop
from servoid.stack.runtime.multi_robot import Others
from servoid.stack.runtime.phases import Phases
from servoid.stack.runtime.realtime import undisturbed
from servoid.stack.safety.event import Event
from servoid.stack.safety.guard import Guard, Phase
from servoid.stack.tasks import load_task

MAX_GAIN = 2.0  # times the firmware's configured gain; above, a servo of this class rings
TASK_STREAM = 1  # distinguishes the task's random stream from others of the same seed


@dataclass(frozen=True)
class RunSettings:
    """What to run. `set` overrides the task's settings by name; `gain` in it scales the servos' position gain."""

    task: str
    backend: str = "sim"
    robot: str = "op3"
    policy: str = "diffusion"
    randomise: bool = False  # draw the simulated robot's mass, friction, delays and so on
    seconds: float | None = None  # instead of the task's own
    seed: int = 0
    set: Mapping[str, str] = field(default_factory=dict)
    start: bool = False  # move a real robot without asking
    record: Path | None = None  # flight log to write
    realtime: bool | None = None  # in step with the wall; None: only where there is hardware
    port: str | None = None


@dataclass(frozen=True)
class Script:
    """What came to a recorded run from outside, for a run that repeats it."""

    stops: tuple[Event, ...] = ()  # what ended it: Ctrl-C, a full disk
    plans: Mapping[int, int] | None = None  # ticks of plan requests, and when their plans were adopted
    velocities: Array | None = None  # (ticks, 3) that a person steered by,
    ended: bool = False  # and whether the person ended the run


@dataclass(frozen=True)
class Result:
    """How a run went, by what the robot knew. Times s, lateness ms."""

    outcome: str  # succeeded, failed, fell, timed_out, stopped or interrupted
    success: bool
    seconds: float  # spent on the task
    ticks: int  # spent on the task
    missed: int
    late_p50_ms: float
    late_p99_ms: float
    metrics: dict[str, float]
    events: tuple[Event, ...]
    trace: Trace
    log: Path | None
    interrupted: bool = False  # whether it was told to end, be it after its task had ended

    def summary(self) -> dict[str, Any]:
        """The result as JSON values, without the trace."""
        from servoid.stack.log.format import event_message, plain

        names = ("outcome", "success", "seconds", "ticks", "missed", "late_p50_ms", "late_p99_ms", "metrics")
        values: dict[str, Any] = plain({name: getattr(self, name) for name in names})
        return values | {"events": [event_message(event) for event in self.events]}


def run(
    settings: RunSettings,
    *,
    backend: Backend | None = None,
    on_tick: Listener | None = None,
    policy: Policy | None = None,
    confirm: Callable[[str], None] | None = None,
    script: Script | None = None,
) -> Result:
    """Do one run and return how it went, the robot with torque off.

    `backend` and `policy` replace those that the settings name; a backend that offers a `simulation` starts itself and
    need not keep to real time. `on_tick` is called after each tick and must be quick. `confirm` asks the person
    at a real robot, and returns when it may move. `script` repeats a recorded run. Raises ConfigError before anything
    is connected, BackendError when the body cannot be reached.
    """
    script = script or Script()
    robot = load_robot(settings.robot)
    task, gain = _task(settings, robot)
    simulated = backend_kind(settings.backend).simulated if backend is None else backend.simulation is not None
    realtime = not simulated if settings.realtime is None else settings.realtime
    if not (simulated or settings.start or confirm):
        raise ConfigError(
            "nothing moves by itself on a real robot: give start=True (--start), or confirm at the prompt"
        )
    odometry = load_odometry(robot)
    if settings.record is not None:
        from servoid.stack.log.recorder import Recorder, check_new

        check_new(settings.record)
    if script.velocities is not None:
        task.steer_by(script.velocities, script.ended)
    scene = start_task(task, settings.seed)
    assembled, assembly = (robot, None) if simulated or backend is not None else calibrated(robot)
    body = backend or make_backend(
        settings.backend,
        assembled,
        seed=settings.seed,
        randomise=settings.randomise,
        port=settings.port,
        scene=scene,
    )
    surroundings = None if body.simulation is None else body.simulation.surroundings
    if scene is not None and simulated and surroundings is None:
        raise ConfigError(
            f"task '{task.name}' has a scene: make the backend with it (servoid.stack.runtime.run.prepare does)"
        )
    if task.teammates and policy is not None:
        robots = len(task.teammates) + 1
        raise ConfigError(f"task '{task.name}' has {robots} robots, each with its own policy: name one instead")
    with ExitStack() as stack:
        stack.callback(task.close)
        interrupt = stack.enter_context(Interrupt(eager=True))
        pilot = make_policy(settings.policy, robot, task, realtime) if policy is None else policy
        stack.callback(pilot.close)
        if script.plans is not None:
            pilot.repeat(script.plans)
        stack.callback(body.close)
        stack.callback(setattr, interrupt, "eager", False)  # a second Ctrl-C must not break off the closing
        push = None if body.simulation is None else body.simulation.push
        if push is None and task.pushes:
            raise ConfigError(f"backend '{body.name}' cannot push the robot: drop the task's push setting")
        pilot.reset(None, np.array(settings.seed))
        sensors, motors = body.connect()
        if not (simulated or settings.start) and confirm is not None:
            known = f"{assembly}. " if assembly is not None else ""
            confirm(f"{known}{robot.name} will go to its home pose and then: {task.name}")

        # From here on a Ctrl-C is a request, until the motors are off.
        interrupt.settle()
        guard = Guard(robot, motors, gain)
        if assembly is not None:
            guard.note("system", assembly)
        estimator = Estimator(robot, odometry)
        look = None if surroundings is None else surroundings.look
        phases = Phases(robot, guard, estimator, task, pilot, push, look)
        tally = _Tally()
        listeners: list[Listener] = [tally]
        others = None
        time = body.clock
        if task.teammates and body.simulation is not None:
            # Their planners never run beside the loop: the log, which is the first robot's, has to repeat them.
            time = others = Others(
                robot,
                body,
                task.teammates,
                lambda its: make_policy(settings.policy, robot, its, realtime=False),
                guard,
                interrupt,
                settings.seed,
                gain,
            )
            stack.callback(others.close)
            listeners.append(others)
        recorder = None
        if settings.record is not None:
            from servoid.stack.log.provenance import header

            recorder = Recorder.create(
                settings.record,
                header(
                    settings,
                    robot,
                    task,
                    body.name,
                    policy_fingerprint(settings.policy) if policy is None else {"name": type(policy).__qualname__},
                ),
                wait=simulated and not realtime,
            )
            listeners.append(recorder)
        if on_tick is not None:
            listeners.append(on_tick)
        if realtime:
            stack.enter_context(undisturbed(not simulated, lambda text: guard.note("system", text)))
        clock = RealTime(time) if realtime and not isinstance(time, WallClock) else time
        requests = Stops(interrupt, lambda: recorder.error if recorder is not None else None, script.stops)
        loop = Loop(
            sensors, estimator, phases, guard, Schedule(clock, robot.rate), interrupt, requests, tuple(listeners)
        )
        try:
            loop.run()
            if others is not None:
                others.finish()
        except BaseException as error:
            if recorder is not None:
                recorder.events(guard.events())
                recorder.close({"outcome": "error", "error": f"{type(error).__name__}: {error}"})
            raise
        last = guard.events()
        tally.events += last
        result = replace(tally.result(phases, guard, task, settings), interrupted=interrupt.count > 0)
        if recorder is not None:
            recorder.events(last)
            recorder.close(result.summary())
            result = _with_failure(result, recorder.error)
        return result


def prepare(settings: RunSettings) -> tuple[Task, Backend]:
    """The task of a run, its episode drawn, and the simulated body with its scene, for `run` and for judging it.

    Raises ConfigError like `run`.
    """
    robot = load_robot(settings.robot)
    task, _ = _task(settings, robot)
    scene = start_task(task, settings.seed)
    body = make_backend(
        settings.backend,
        robot,
        seed=settings.seed,
        randomise=settings.randomise,
        port=settings.port,
        scene=scene,
    )
    return task, body


def start_task(task: Task, seed: int) -> Scene | None:
    """Draw the episode that a run with this seed does; its scene."""
    task.reset(np.random.default_rng([seed, TASK_STREAM]))
    return task.scene()


def _task(settings: RunSettings, robot: Robot) -> tuple[Task, float]:
    values = dict(settings.set)
    text = values.pop("gain", "1")
    try:
        gain = float(text)
    except ValueError:
        raise ConfigError(f"gain: '{text}' is not a number") from None
    if not 0.0 < gain <= MAX_GAIN:
        raise ConfigError(f"gain: {gain:g} is outside 0 to {MAX_GAIN:g}: it scales the servos' position gain")
    if settings.seconds is not None:
        values["seconds"] = repr(settings.seconds)
    return load_task(settings.task, values, robot.dt, robot), gain


def _with_failure(result: Result, error: str | None) -> Result:
    """The result with a failure of the log that came too late to stop the run."""
    if error is None or any(event.kind == "record" for event in result.events):
        return result
    last = result.events[-1]
    return replace(result, events=(*result.events, Event(last.tick, last.time, "record", None, error)))


class _Tally:
    """Counts while a run goes on."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self._late = array("q")  # ns; a list of numbers would be five times as large
        self._missed = 0

    def __call__(self, record: TickRecord) -> None:
        self.events += record.events
        if record.phase is Phase.RUNNING:
            self._late.append(record.timing.late)
            self._missed += record.timing.missed

    def result(self, phases: Phases, guard: Guard, task: Task, settings: RunSettings) -> Result:
        trace = phases.trace()
        success = bool(phases.ended is not None and task.success(trace))
        late = np.array(self._late or [0], dtype=float) * 1e-6
        return Result(
            outcome=_outcome(phases, guard, success, trace),
            success=success,
            seconds=phases.task_ticks * trace.dt,
            ticks=phases.task_ticks,
            missed=self._missed,
            late_p50_ms=float(np.percentile(late, 50)),
            late_p99_ms=float(np.percentile(late, 99)),
            metrics=task.metrics(trace) if phases.task_ticks else {},
            events=tuple(self.events),
            trace=trace,
            log=settings.record,
        )


def _outcome(phases: Phases, guard: Guard, success: bool, trace: Trace) -> str:
    if phases.ended is not None:
        return "succeeded" if success else "timed_out" if phases.ended == "time" else "failed"
    if trace.fallen:
        return "fell"
    return "interrupted" if guard.cause == "interrupt" else "stopped"

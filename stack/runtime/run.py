"""One run, composed from its settings: what the command line, the Python API, rollouts and replays all use."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from types import TracebackType

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.backend import Backend
from servoid.hw.contracts.control import Policy
from servoid.hw.contracts.task import Assignment, Behaviour, Episode, Task
from servoid.hw.dynamixel.calibration import calibrated
from servoid.hw.robot.description import Robot, load_robot
from servoid.hw.seeds import Stream, generator
from servoid.policy.text.encoder import load_encoder
from servoid.stack.control.get_up import GetUp, fingerprints, get_up
from servoid.stack.control.policies import make_policy, policy_fingerprint, sentences_known, skills_known
from servoid.stack.estimation.estimator import Estimator
from servoid.stack.estimation.odometry import odometry_of
from servoid.stack.log.provenance import header
from servoid.stack.log.recorder import Recorder, check_new
from servoid.stack.log.tick import Listener
from servoid.stack.runtime.backends import backend_kind, make_backend
from servoid.stack.runtime.clock import RealTime, Schedule, WallClock
from servoid.stack.runtime.interrupt import Interrupt, Stops
from servoid.stack.runtime.loop import ControlledRobot, Loop
from servoid.stack.runtime.multi_robot import Teammates
from servoid.stack.runtime.operator import Held, Operator, Recorded
from servoid.stack.runtime.phases import Phases, Recovering
from servoid.stack.runtime.realtime import undisturbed
from servoid.stack.runtime.result import Result, Tally
from servoid.stack.runtime.settings import RunSettings, Script
from servoid.stack.safety.event import Event
from servoid.stack.safety.guard import Guard
from servoid.stack.safety.recovery import TRIES
from servoid.stack.skills.rewording import RewordedPolicy
from servoid.stack.skills.runtime import SkillPolicy
from servoid.stack.skills.skill import chosen, load_skills
from servoid.stack.skills.skill import fingerprints as skill_fingerprints
from servoid.stack.skills.telling import ToldPolicy
from servoid.stack.tasks import load_task, source
from servoid.stack.tasks.steer import SteeredAgain

Confirm = Callable[[str], None]


def run(
    settings: RunSettings,
    *,
    backend: Backend | None = None,
    on_tick: Listener | None = None,
    policy: Policy | None = None,
    confirm: Confirm | None = None,
    script: Script | None = None,
    operator: Operator | None = None,
) -> Result:
    """Do one run and return how it went, the robot with torque off.

    `backend` and `policy` replace those that the settings name; a backend that offers a `simulation` starts itself and
    need not keep to real time. `on_tick` is called after each tick and must be quick. `confirm` asks the person at a
    real robot, and returns when it may move. `script` repeats a recorded run. `operator` reads what a person wants: its
    stop ends any task, and a task that is steered goes by it instead of opening a device of its own. Raises ConfigError
    before anything is connected, BackendError when the body cannot be reached.
    """
    with Run(
        settings, backend=backend, on_tick=on_tick, policy=policy, confirm=confirm, script=script, operator=operator
    ) as one:
        one.prepare()
        one.connect()
        one.loop()
        return one.report()


def prepare(settings: RunSettings) -> tuple[Assignment, Backend]:
    """The task of a run, its episode drawn, and the simulated body with its scene, for `run` and for judging it.

    Raises ConfigError like `run`.
    """
    robot = load_robot(settings.robot)
    assignment = draw(_task(settings, robot), settings.seed)
    return assignment, _body(settings, robot, assignment.episode)


def draw(task: Task, seed: int) -> Assignment:
    """The episode that a run with this seed does."""
    return Assignment(task, task.scenario(generator(seed, Stream.TASK)))


class Run:
    """A run in four steps: prepare, connect, loop, report. It takes what `run` takes; leaving it lets go of all that it
    holds."""

    robot: Robot
    assignment: Assignment
    behaviour: Behaviour
    body: Backend
    policy: Policy
    guard: Guard
    phases: Phases

    def __init__(
        self,
        settings: RunSettings,
        *,
        backend: Backend | None = None,
        on_tick: Listener | None = None,
        policy: Policy | None = None,
        confirm: Confirm | None = None,
        script: Script | None = None,
        operator: Operator | None = None,
    ) -> None:
        self.settings, self._backend, self._on_tick, self._policy = settings, backend, on_tick, policy
        self._confirm, self._script = confirm, script or Script()
        self._operator = operator
        self._get_up: GetUp | None = None
        self._begun = 0  # times that the policy has begun
        self._interrupt = Interrupt(eager=True)
        self._open = ExitStack()
        self._tally = Tally()
        self._recorder: Recorder | None = None
        self._teammates: Teammates | None = None
        self._assembly: str | None = None  # which calibration a real robot goes by
        self._unlearned: str | None = None  # why odometry is by the legs alone

    def __enter__(self) -> Run:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._open.__exit__(kind, error, at)

    def prepare(self) -> None:
        """Choose robot, task and body, and check that they go together; nothing is connected. Raises ConfigError."""
        settings, backend = self.settings, self._backend
        self.robot = load_robot(settings.robot)
        task = _task(settings, self.robot)
        simulated = backend_kind(settings.backend).simulated if backend is None else backend.simulation is not None
        self.realtime = not simulated if settings.realtime is None else settings.realtime
        if not (simulated or settings.start or self._confirm):
            raise ConfigError(
                "nothing moves by itself on a real robot: give start=True (--start), or confirm at the prompt"
            )
        if settings.recover:
            self._get_up = get_up(self.robot)
        self._odometry, self._unlearned = odometry_of(self.robot)
        if settings.record is not None:
            check_new(settings.record)
        self.assignment = draw(task, settings.seed)
        assembled = self.robot
        if not simulated and backend is None:
            assembled, self._assembly = calibrated(self.robot)
        self.body = backend or _body(settings, assembled, self.assignment.episode)
        self._check()

    def _check(self) -> None:
        """Raise ConfigError where the task asks for what body or policy do not have."""
        name, episode, simulation = self.assignment.task.name, self.assignment.episode, self.body.simulation
        scene = episode.scene
        if scene is not None and simulation is not None and simulation.surroundings is None:
            raise ConfigError(
                f"task '{name}' has a scene: make the backend with it (servoid.stack.runtime.run.prepare does)"
            )
        if scene is not None and scene.robots is not None and self._policy is not None:
            robots = len(scene.robots) + 1
            raise ConfigError(f"task '{name}' has {robots} robots, each with its own policy: name one instead")
        if scene is not None and scene.robots is not None and self.settings.recover:
            raise ConfigError(f"task '{name}' has several robots, and a fall of one ends it: drop --recover")
        if scene is not None and scene.objects and simulation is None:
            things = ", ".join(dict.fromkeys(thing.kind for thing in scene.objects))
            raise ConfigError(
                f"task '{name}' needs to see its {things}, and backend '{self.body.name}' shows none: "
                "use a simulated one; servoid run skill performs the motion alone"
            )
        if episode.pushes and simulation is None:
            raise ConfigError(f"backend '{self.body.name}' cannot push the robot: drop the task's push setting")

    def connect(self) -> None:
        """Make the policy and open the body; ask whether a real robot may move. A Ctrl-C raises KeyboardInterrupt.

        Raises ConfigError where the policy does not fit, BackendError where the body cannot be reached.
        """
        settings, task, body, robot = self.settings, self.assignment.task, self.body, self.robot
        self.behaviour = self._behaviour()
        self._open.callback(self.behaviour.close)
        self._open.enter_context(self._interrupt)
        self.policy = self._policy or make_policy(
            settings.policy, robot, task, self.realtime, planner=self._script.planner
        )
        self._open.callback(self.policy.close)
        self.policy = self._with_skills(self.policy)
        self._interrupt.check()
        self._open.callback(body.close)
        self._open.callback(setattr, self._interrupt, "eager", False)  # a second Ctrl-C must not break off the closing
        self._begin_policy()
        sensors, motors = body.connect()
        self._interrupt.check()
        if body.simulation is None and not settings.start and self._confirm is not None:
            known = f"{self._assembly}. " if self._assembly is not None else ""
            again = (
                ""
                if self._get_up is None
                else f"; if it lies or falls, it gets up by itself, {TRIES} tries: keep away from it"
            )
            self._confirm(f"{known}{robot.name} will go to its home pose and then: {task.name}{again}")
        self._interrupt.settle()  # from here on a Ctrl-C is a request, until the motors are off
        self.guard = Guard(robot, motors, settings.gain, recover=settings.recover)
        for text in (self._assembly, self._unlearned):
            if text is not None:
                self.guard.note("system", text)
        self._controlled = ControlledRobot(robot, sensors, Estimator(robot, self._odometry), self.guard)
        recovering = None if self._get_up is None else Recovering(self._get_up, self._begin_policy)
        self.phases = Phases(
            self._controlled, self.assignment, self.behaviour, self.policy, body.simulation, recovering
        )

    def _with_skills(self, policy: Policy) -> Policy:
        """The policy with what performs skills: itself, where its network knows them. Raises ConfigError."""
        settings, robot, assignment = self.settings, self.robot, self.assignment
        known = () if self._policy else skills_known(settings.policy, robot, self._script.planner)
        told = assignment.episode.told
        if known:
            if unknown := [name for name in told if name not in known]:
                raise ConfigError(
                    f"policy '{settings.policy}' does not know the skill '{unknown[0]}': use --policy expert, which "
                    "performs it by what its file says"
                )
            skills = load_skills(robot)
            return ToldPolicy(robot, policy, {name: chosen(name, skills) for name in known}, load_encoder())
        if told and not assignment.task.performs:
            asked = ", ".join(told)
            raise ConfigError(
                f"policy '{settings.policy}' knows no skills, and what is said asks for some ({asked}): use --policy "
                "skills, or servoid run skill --set text=..."
            )
        planner = self._script.planner
        sentences, seconds = ((), 0.0) if self._policy else sentences_known(settings.policy, robot, planner)
        if sentences:
            policy = RewordedPolicy(robot, policy, sentences, seconds)
        return SkillPolicy(robot, policy, load_skills(robot)) if assignment.task.performs else policy

    def loop(self) -> None:
        """Do the ticks of the run, until torque is off. Raises BackendError where the body cannot be reached."""
        listeners: list[Listener] = [self._tally]
        clock = self.body.clock
        if behaviours := self.behaviour.teammates:
            clock = self._teammates = Teammates(
                self.settings,
                self.assignment,
                behaviours,
                self.body,
                self._controlled,
                self._interrupt,
                self._script,
            )
            self._open.callback(self._teammates.close)
            listeners.append(self._teammates)
        if self.settings.record is not None:
            listeners.append(self._record())
        if self._on_tick is not None:
            listeners.append(self._on_tick)
        if self.realtime:
            self._open.enter_context(undisturbed(self.body.simulation is None, self._note))
            clock = clock if isinstance(clock, WallClock) else RealTime(clock)
        operator, schedule = self._operator, Schedule(clock, self.robot.rate)
        asked = (lambda: None) if operator is None else operator.stop
        stops = Stops(self._interrupt, self._failure, self._script.stops, asked)
        loop = Loop(self._controlled, self.phases, schedule, self._interrupt, stops, tuple(listeners), operator)
        try:
            loop.run()
            if self._teammates is not None:
                self._teammates.finish()
        except BaseException as error:
            if self._recorder is not None:
                self._recorder.events(self.guard.events())
                self._recorder.close({"outcome": "error", "error": f"{type(error).__name__}: {error}"})
            raise

    def report(self) -> Result:
        """How the run went, and the end of its log."""
        last = self.guard.events()
        self._tally.events += last
        told = self._interrupt.count > 0 or (self._operator is not None and self._operator.intent.halt > 0)
        result = self._tally.result(self.phases, self.guard, self.assignment, self.settings.record, told)
        if self._recorder is not None:
            self._recorder.events(last)
            self._recorder.close(result.summary())
            result = _with_failure(result, self._recorder.error)
        return result

    def _begin_policy(self) -> None:
        """Let the policy begin, at first or anew; it adopts the plans that a recorded run adopted since then."""
        plans = self._script.plans
        if plans is not None:
            self.policy.repeat(plans[self._begun] if self._begun < len(plans) else {})
        self._begun += 1
        self.policy.reset(None, np.array(self.settings.seed))

    def _behaviour(self) -> Behaviour:
        """What is asked of the robot; where a person asks, through the operator, whose device is opened here."""
        task, episode, script = self.assignment.task, self.assignment.episode, self._script
        if script.intents is not None:
            self._operator = Operator(Recorded(script.intents), held=script.held)
        elif task.steered and script.velocities is not None:
            return SteeredAgain(script.velocities, script.ended)
        elif task.steered and self._operator is None:
            self._operator = Operator(task.open_source(), held=False)
            self._open.callback(self._operator.close)
        operator = self._operator
        if operator is None:
            return task.behaviour(episode)
        behaviour = task.steered_behaviour(episode, operator.wanted) if task.steered else task.behaviour(episode)
        return Held(behaviour, operator, partial(self._note, kind="operator")) if operator.held else behaviour

    def _record(self) -> Recorder:
        settings, own = self.settings, self._policy
        assert settings.record is not None
        policy = policy_fingerprint(settings.policy, self.robot) if own is None else {"name": type(own).__qualname__}
        facts = header(settings, self.robot, self.assignment, source(settings.task), self.body.name, policy)
        facts["operator"] = None if self._operator is None else {"held": self._operator.held}
        if self.assignment.task.performs:
            facts["skills"] = skill_fingerprints(self.robot)
        facts["recovery"] = None if self._get_up is None else fingerprints(self.robot)
        wait = self.body.simulation is not None and not self.realtime
        self._recorder = Recorder.create(settings.record, facts, wait=wait)
        return self._recorder

    def _failure(self) -> str | None:
        return None if self._recorder is None else self._recorder.error

    def _note(self, text: str, kind: str = "system") -> None:
        self.guard.note(kind, text)


def _task(settings: RunSettings, robot: Robot) -> Task:
    values = dict(settings.set)
    if settings.seconds is not None:
        values["seconds"] = repr(settings.seconds)
    return load_task(settings.task, values, robot.dt, robot)


def _body(settings: RunSettings, robot: Robot, episode: Episode) -> Backend:
    return make_backend(
        settings.backend,
        robot,
        seed=settings.seed,
        randomise=settings.randomise,
        port=settings.port,
        episode=episode,
    )


def _with_failure(result: Result, error: str | None) -> Result:
    """The result with a failure of the log that came too late to stop the run."""
    if error is None or any(event.kind == "record" for event in result.events):
        return result
    last = result.events[-1]
    return replace(result, events=(*result.events, Event(last.tick, last.time, "record", None, error)))


__all__ = ["Result", "Run", "RunSettings", "Script", "draw", "prepare", "run"]

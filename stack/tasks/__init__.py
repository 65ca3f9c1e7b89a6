"""What the robot is asked to do: a class, and settings in `configs/tasks/<name>.yaml` or in the class's defaults alone.

Others come from installed packages, by entry points of the group `servoid.tasks`, or from a file: `FILE.py:Class`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from servoid.hw.config import ConfigError, load_yaml, nearest, resolve
from servoid.hw.contracts.task import Task
from servoid.hw.overrides import override
from servoid.hw.plugins import Plugin, installed, load_plugin
from servoid.hw.robot.description import Robot
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, Settings, beyond, fitted
from servoid.stack.tasks.body.crouch_under import CrouchUnder
from servoid.stack.tasks.body.reach_hand import ReachHand
from servoid.stack.tasks.cross import Cross
from servoid.stack.tasks.forest import Forest
from servoid.stack.tasks.goal import Goal
from servoid.stack.tasks.inbetween import Inbetween
from servoid.stack.tasks.learned.carry_run import RunCarry
from servoid.stack.tasks.learned.clip_run import RunClip
from servoid.stack.tasks.learned.run import RunDodgeball, RunLocation, RunSpeed, RunSteering
from servoid.stack.tasks.obstacle import Obstacle
from servoid.stack.tasks.path import Path
from servoid.stack.tasks.skills.get_up import LieAndStand
from servoid.stack.tasks.skills.kick import Kick
from servoid.stack.tasks.skills.skill import PerformSkills
from servoid.stack.tasks.stand import Stand
from servoid.stack.tasks.steer import Steer
from servoid.stack.tasks.stories.story import Story
from servoid.stack.tasks.text import Text
from servoid.stack.tasks.velocity import Velocity
from servoid.stack.tasks.walk import Survive, Walk

GROUP = "servoid.tasks"  # of entry points


@dataclass(frozen=True)
class TaskEntry:
    """A task that can be run: its class, by what name, and where it came from."""

    name: str
    cls: type[BaseTask]
    description: str
    plugin: Plugin | None = None  # None: one of Servoid's own


_CLASSES: tuple[type[BaseTask], ...] = (
    Stand, Walk, Goal, Velocity, Path, Forest, Obstacle, Cross, ReachHand, CrouchUnder, Inbetween, Survive, Text, Steer,
    PerformSkills, Kick, LieAndStand, Story, RunSpeed, RunSteering, RunLocation, RunDodgeball, RunClip,
    RunCarry,
)  # fmt: skip
_OWN: dict[str, TaskEntry] = {
    **{cls.name: TaskEntry(cls.name, cls, cls.description) for cls in _CLASSES},
    # The same classes with other files of settings.
    "goal-near": TaskEntry("goal-near", Goal, "walk to a near point"),
    "goal-far": TaskEntry("goal-far", Goal, "walk to a far point"),
    "reach": TaskEntry("reach", Story, "bring the base over a point"),
    "strike": TaskEntry("strike", Story, "punch or kick a bag, as told, so that it falls"),
    "sit": TaskEntry("sit", Story, "sit down on a seat, and stay there"),
    "rise": TaskEntry("rise", Story, "sit down on a seat, and rise from it"),
    "perturb": TaskEntry("perturb", Walk, "walk ahead while being pushed once a second"),
}


def names() -> tuple[str, ...]:
    """Names of all tasks, Servoid's own first, in the order in which they are best tried."""
    return (*_OWN, *(name for name in installed(GROUP) if name not in _OWN))


def find(name: str) -> TaskEntry:
    """The task of that name, or of a file: `FILE.py:Class`. Servoid's own hide others of their names.

    Raises ConfigError with the nearest name, or with what is wrong with a class of a user's own.
    """
    if name in _OWN:
        return _OWN[name]
    plugin = load_plugin(name, GROUP, BaseTask, "task")
    if plugin is None:
        raise ConfigError(f"unknown task '{name}': {nearest(name, names())}")
    cls: type[BaseTask] = plugin.cls
    if not (cls.name and cls.description):
        raise plugin.error(
            f'{cls.__name__}: name or description missing: write name = "..." and description = "..." in the class'
        )
    return TaskEntry(cls.name, cls, cls.description, plugin)


def source(name: str) -> dict[str, Any] | None:
    """Where a task of a user's own came from, for the flight log; None for one of Servoid's. Raises ConfigError."""
    known = find(name)
    return None if known.plugin is None else known.plugin.source()


def load_settings(name: str, settings: dict[str, str] | None = None, robot: Robot | None = None) -> Any:
    """A task's settings, from its file or its class, with those changed that `--set key=value` gives as text.

    Speeds and lengths of Servoid's own tasks are fitted to `robot`; what is typed stays. Raises ConfigError.
    """
    known = find(name)
    base: Settings
    if known.plugin is None:
        base = load_yaml(resolve("tasks", name), known.cls.settings_type)
        base = base if robot is None else fitted(base, robot)
    else:
        try:
            base = known.cls.settings_type()
        except (TypeError, ValueError) as error:
            raise known.plugin.error(f"the defaults of {known.cls.settings_type.__name__}: {error}") from error
    typed = known.cls.settings_type.completed(settings or {})
    return override(base, typed)


def load_task(name: str, settings: dict[str, str] | None = None, dt: float = 0.02, robot: Robot | None = None) -> Task:
    """A task for one robot. `dt` is the length of a control tick [s].

    Raises ConfigError for an unknown task or setting, a value that does not parse, or what `robot` cannot do.
    """
    known = find(name)
    task = known.cls(load_settings(name, settings, robot), dt, robot)
    task.name = known.name
    return task


__all__ = [
    "BaseBehaviour", "BaseTask", "Settings", "TaskEntry",
    "beyond", "find", "load_settings", "load_task", "names", "source",
]  # fmt: skip

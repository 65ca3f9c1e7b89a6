"""Do as a person steers: with a gamepad or keys; on the operator's page by goals, sentences and skills, too."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.operator import CommandSource, Intent
from servoid.hw.contracts.task import Criterion, Episode, Trace
from servoid.hw.contracts.world import Percept
from servoid.hw.geometry import to_heading
from servoid.hw.robot.description import Robot, shipped_robot
from servoid.hw.setting import Setting
from servoid.policy.text.captions import twist_of
from servoid.policy.text.encoder import load_encoder
from servoid.stack.control.operator import Controls, open_steering
from servoid.stack.navigation.go_to_point import SpeedProfile, go_to_point
from servoid.stack.skills.skill import Skill, has_skills, load_skills
from servoid.stack.skills.words import SkillWords
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, Settings
from servoid.stack.tasks.terms import metrics as measures
from servoid.stack.tasks.text import understood

Stick = Literal["leftx", "lefty", "rightx", "righty"]


@dataclass(frozen=True)
class SteerSettings(Settings):
    device: Annotated[Literal["auto", "gamepad", "keyboard"], Setting("auto, gamepad or keyboard")] = "auto"
    forward: Annotated[float, Setting("forward, with the stick pushed all the way", "m/s", above=0, asks="forward")] = (
        0.25
    )
    backward: Annotated[float, Setting("backward, the same", "m/s", above=0, asks="backward")] = 0.1
    sideways: Annotated[float, Setting("to either side, the same", "m/s", above=0, asks="left")] = 0.1
    turning: Annotated[float, Setting("turning, the same", "rad/s", above=0, asks="turning")] = 0.8
    forward_stick: Annotated[Stick, Setting("part of the gamepad that walks forward and back")] = "lefty"
    sideways_stick: Annotated[Stick, Setting("part of it that walks sideways")] = "leftx"
    turning_stick: Annotated[Stick, Setting("part of it that turns")] = "rightx"
    arrive: Annotated[float, Setting("distance from a goal at which to stop", "m", above=0)] = 0.05
    leave: Annotated[float, Setting("distance from a goal at which to start again", "m", above=0)] = 0.1
    approach: SpeedProfile = field(default_factory=SpeedProfile)
    end_button: Annotated[Literal["a", "b", "x", "y"], Setting("button of it that ends the run")] = "b"


class Steer(BaseTask):
    name = "steer"
    description = "walk as a person steers: with a gamepad, by keys or on the page"
    settings_type = SteerSettings
    steered = True

    def __init__(self, settings: SteerSettings, dt: float, robot: Robot | None = None) -> None:
        super().__init__(settings, dt, robot)
        body = robot or shipped_robot()
        self._skills = load_skills(body) if has_skills(body) else {}
        self.performs = bool(self._skills)

    def open_source(self) -> CommandSource:
        """Find the device. Raises ConfigError where there is none."""
        s = self.settings
        controls = Controls(s.forward_stick, s.sideways_stick, s.turning_stick, s.end_button)
        return open_steering(s.device, controls)

    def steered_behaviour(self, episode: Episode, wanted: Callable[[], Intent]) -> BaseBehaviour:
        return Steered(episode, wanted, self.settings, self.top, self._skills)

    def criteria(self, trace: Trace, episode: Episode) -> list[Criterion]:
        return [
            Criterion.never("fell", trace.fallen),
            Criterion.never("ended before it began", len(trace.displacement) == 0),
        ]

    def metrics(self, trace: Trace, episode: Episode) -> dict[str, float]:
        return {
            "top_speed_mps": measures.top_speed(trace),
            "distance_m": measures.path_length(trace, self.cycle),
        }


class Steered(BaseBehaviour):
    """Goes by what is wanted now. Velocities are rounded to float32, as the flight log holds them.

    A sentence that names neither a motion nor one of the `skills` asks the robot to stand.
    """

    def __init__(
        self,
        episode: Episode,
        wanted: Callable[[], Intent],
        settings: SteerSettings,
        top: Array,
        skills: Mapping[str, Skill],
    ) -> None:
        """`top` `(3,)` are the speeds that sentences speak of."""
        super().__init__(episode)
        self._skills, self._asked = skills, 0
        # Loaded now: a tick has no time for it.
        self._words = SkillWords(load_encoder(), skills) if skills else None
        self._wanted, self._settings, self._top = wanted, settings, top
        self._ends = self._arrived = False
        self._understood: dict[str, Array | str] = {}  # velocities of sentences, and names of skills

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        wish = self._wanted()
        self._ends = wish.ends
        if wish.goal is not None:
            return self._go(to_heading(wish.goal, state))
        self._arrived = False
        if wish.skill is not None:
            again, self._asked = wish.skills != self._asked, wish.skills
            return self._perform(None if again else wish.skill)  # a tick without it: the same may be wanted once more
        if wish.text is not None:
            meant = self._meant(wish.text)
            if isinstance(meant, str):
                return self._perform(meant)
            return Instruction(meant, text=wish.text if meant.any() else None)
        s = self._settings
        forward, left, turn = wish.way
        velocity = np.array(
            [forward * (s.forward if forward > 0.0 else s.backward), left * s.sideways, turn * s.turning]
        )
        return Instruction(velocity.astype(np.float32).astype(float))

    def done(self, state: State) -> bool:
        """The person has had enough."""
        return self._ends

    def _go(self, ahead: Array) -> Instruction:
        """To a point `(2,)` m, and stand there."""
        s, distance = self._settings, float(np.linalg.norm(ahead))
        self._arrived = distance <= (s.leave if self._arrived else s.arrive)
        return Instruction(np.zeros(3) if self._arrived else go_to_point(ahead, s.approach), goal=ahead)

    def _perform(self, skill: str | None) -> Instruction:
        return Instruction(np.zeros(3), skill=skill if skill in self._skills else None)

    def _meant(self, text: str) -> Array | str:
        """The velocity `(3,)` that a sentence means, or the skill, looked up once."""
        if text not in self._understood:
            try:
                self._understood[text] = self._look_up(text)
            except ConfigError:
                self._understood[text] = np.zeros(3)
        return self._understood[text]

    def _look_up(self, text: str) -> Array | str:
        """Raises ConfigError where it is in no known words."""
        if self._words is None:
            return twist_of(understood("sentence", text), self._top)
        found = self._words.understand(text)
        return found if isinstance(found, str) else twist_of(found, self._top)


class SteeredAgain(BaseBehaviour):
    """Repeats the velocities `(ticks, 3)` of a recorded run. `ended`: whether with the last one the person ended it."""

    def __init__(self, velocities: Array, ended: bool) -> None:
        super().__init__(Episode())
        self._velocities, self._ended, self._tick = velocities, ended, 0

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        self._tick = tick
        over = tick >= len(self._velocities)
        return Instruction(velocity=np.zeros(3) if over else self._velocities[tick].astype(float))

    def done(self, state: State) -> bool:
        return self._ended and self._tick >= len(self._velocities) - 1

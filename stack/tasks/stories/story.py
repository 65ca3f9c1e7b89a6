"""Perform a story: acts one after the other, each begun when the one before it is done."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.task import Criterion, Trace
from servoid.hw.contracts.world import Scene
from servoid.hw.robot.description import Robot, shipped_robot
from servoid.policy.diffusion.prefix.key_points import KeyPoints
from servoid.stack.skills.skill import Skill, load_skills
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, drawn_pushes
from servoid.stack.tasks.stories.act import Act, drawn, load_acts
from servoid.stack.tasks.stories.condition import Conditions, first, held_ticks, moments
from servoid.stack.tasks.stories.layout import laid_out
from servoid.stack.tasks.stories.machine import Machine
from servoid.stack.tasks.stories.strike import struck_by
from servoid.stack.tasks.stories.told import StoryEpisode, StorySettings

ARM = 1.25  # of the base's height at home: a hand reaches no higher by its skill
HIP = 0.85  # of the base's height at home: a seat above that is higher than the hip


class Story(BaseTask):
    name = "story"
    description = "perform acts one after the other: sit, rise, reach, punch, kick"
    settings_type = StorySettings
    guided_by_velocity_alone = True

    def __init__(self, settings: StorySettings, dt: float, robot: Robot | None = None) -> None:
        """Raises ConfigError for an unknown act, and for things that no robot of this size can sit on or reach."""
        super().__init__(settings, dt, robot)
        self._robot = robot or shipped_robot()
        self.performs = settings.by == "skills"
        self.conditions = Conditions(self._robot)
        tall = self._robot.standing_height
        if settings.seat_height[1] > HIP * tall:
            raise ConfigError(
                f"seat_height: a seat of {settings.seat_height[1]:g} m is higher than the hip ({HIP * tall:.2f} m): "
                "nobody can sit down on it"
            )
        if settings.touch[1] > ARM * tall:
            raise ConfigError(f"touch: no hand reaches a point {settings.touch[1]:g} m up; {ARM * tall:.2f} m at most")
        self._drawn(np.random.default_rng(0))  # what cannot be is said before anything begins

    @cached_property
    def skills(self) -> dict[str, Skill]:
        return load_skills(self._robot)

    @cached_property
    def acts(self) -> dict[str, Act]:
        return load_acts(self.skills)

    def _drawn(self, rng: np.random.Generator) -> tuple[Act, ...]:
        found: list[Act] = []
        names = [name.strip() for name in self.settings.plan.split(",") if name.strip()] * self.settings.times
        if not names:
            raise ConfigError("plan: names no act: write plan=sit,rise for example")
        for name in names:
            found.append(drawn(name, found[-1] if found else None, self.acts, rng))
        return tuple(found)

    def scenario(self, rng: np.random.Generator) -> StoryEpisode:
        acts = self._drawn(rng)
        layout = laid_out(acts, self.settings.things, rng)
        point = next((layout.points[n, :2] for n, index in enumerate(layout.things) if index < 0), None)
        mark = point.copy() if self.settings.seen and point is not None else None
        scene = Scene(np.zeros((0, 3)), np.zeros((0, 4)), mark, objects=layout.objects)
        sits = any(act.done.seated for act in acts)
        s = self.settings
        return StoryEpisode(
            scene if layout.objects or mark is not None else None, acts=acts, things=layout.things,
            points=layout.points, headings=layout.headings, seated=sits,
            pushes=drawn_pushes(rng, self.seconds, s.push, s.push_every, self.ticks(s.push_every)),
        )  # fmt: skip

    def behaviour(self, episode: StoryEpisode) -> BaseBehaviour:
        return Machine(episode, self.settings, self.conditions, self.skills, self.dt)

    def criteria(self, trace: Trace, episode: StoryEpisode) -> list[Criterion]:
        """Never fallen, and all acts done."""
        done = self.done_at(trace, episode)
        missed = next((act.name for act, at in zip(episode.acts, done, strict=True) if at is None), "")
        return [
            Criterion.never("fell", trace.fallen),
            Criterion(f"acts done{f', but not {missed!r}' if missed else ''}", _count(done), least=len(episode.acts)),
        ]

    def metrics(self, trace: Trace, episode: StoryEpisode) -> dict[str, float]:
        done = self.done_at(trace, episode)
        found = {"acts_done": float(_count(done)), "acts_share": _count(done) / len(episode.acts)}
        if episode.acts[-1].sits and _count(done) >= len(done) - 1:
            found["rose_share"] = float(done[-1] is not None and not trace.fallen)
        if (told := self._struck_as_told(trace, episode, done)) is not None:
            found["struck_as_told"] = told
        if done[-1] is not None:
            found["seconds_to_done"] = (done[-1] + 1) * trace.dt
        return found

    def done_at(self, trace: Trace, episode: StoryEpisode) -> list[int | None]:
        """The tick at which each act was done, in their order; None from the first one on that was not."""
        found: list[int | None] = []
        begin = 0
        if not len(trace.yaw):
            return [None] * len(episode.acts)
        now = moments(trace, self.conditions.legs)
        for number, act in enumerate(episode.acts):
            at = None
            if not found or found[-1] is not None:
                thing = self._thing(trace, episode, number)
                held = self.conditions.hold(act, now, thing, episode.seat(number))
                at = first(held, held_ticks(act, self.dt), begin)
            found.append(at)
            begin = len(trace.yaw) if at is None else at + 1
        return found

    def _struck_as_told(self, trace: Trace, episode: StoryEpisode, done: Sequence[int | None]) -> float | None:
        """Share of bags that fell by the limb that was to strike them; None where there is none to strike."""
        strikes = [number for number, act in enumerate(episode.acts) if act.limb is not None]
        if not strikes or trace.objects is None or not len(trace.yaw):
            return None
        now, body, struck = moments(trace, self.conditions.legs), KeyPoints(self._robot, whole=True), 0
        for number in strikes:
            index = episode.things[number]
            limb = struck_by(body, now, trace.objects[:, index], np.array(episode.objects[index].size))
            struck += done[number] is not None and limb == episode.acts[number].limb
        return struck / len(strikes)

    def _thing(self, trace: Trace, episode: StoryEpisode, number: int) -> Array:
        index = episode.things[number]
        if index >= 0:
            lost = np.full((len(trace.yaw), 7), np.nan)
            return lost if trace.objects is None else trace.objects[:, index]
        return np.broadcast_to(episode.point(number, trace.objects, trace.goal), (len(trace.yaw), 7))


def _count(done: Sequence[int | None]) -> int:
    return sum(at is not None for at in done)

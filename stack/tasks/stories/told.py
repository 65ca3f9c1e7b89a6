"""What a story is drawn from, and what one is once it is drawn."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.task import Episode
from servoid.hw.contracts.world import SceneObject
from servoid.hw.geometry import headed, turned, yaw_of
from servoid.hw.setting import Range, Setting
from servoid.stack.tasks.base import Settings
from servoid.stack.tasks.stories.act import Act
from servoid.stack.tasks.stories.layout import Things


@dataclass(frozen=True)
class StorySettings(Settings):
    seconds: Annotated[float, Setting("length of an episode", "s", above=0)] = 150.0
    plan: Annotated[str, Setting("acts, one after the other, separated by commas; any: drawn")] = "sit,rise,reach,punch"
    times: Annotated[int, Setting("how often the plan is repeated", least=1)] = 1
    by: Annotated[
        Literal["skills", "words"],
        Setting(
            "skills: they perform the acts, and the policy walks; words: the policy is told a sentence and targets"
        ),
    ] = "skills"
    reach: Annotated[Range, Setting("distance of a point", "m", least=0)] = (0.28, 0.83)
    strike: Annotated[Range, Setting("distance of a bag", "m", above=0)] = (0.28, 0.41)
    sit: Annotated[Range, Setting("distance of a seat's middle", "m", above=0)] = (0.28, 0.33)
    bearing: Annotated[float, Setting("how far a thing may be off the way that the robot faces", "rad", least=0)] = (
        3.1416
    )
    least_bearing: Annotated[float, Setting("how far off it is at least", "rad", least=0)] = 0.0
    seen: Annotated[
        bool, Setting("whether the robot sees its first point, a mark on the floor: else odometry tells it, or a seat")
    ] = False
    touch: Annotated[Range, Setting("height of a point for a hand", "m", above=0)] = (0.26, 0.31)
    seat_height: Annotated[Range, Setting("height of a seat", "m", above=0)] = (0.14, 0.15)
    seat_depth: Annotated[float, Setting("of a seat, from front to back", "m", above=0)] = 0.2
    seat_width: Annotated[float, Setting("of a seat", "m", above=0)] = 0.3
    bag_height: Annotated[float, Setting("of a bag", "m", above=0)] = 0.36
    bag_width: Annotated[float, Setting("of a bag", "m", above=0)] = 0.06
    bag_mass: Annotated[float, Setting("of a bag", "kg", above=0)] = 0.1
    push: Annotated[Range, Setting("size of each push, in a random direction", "m/s", least=0)] = (0.0, 0.0)
    push_every: Annotated[float, Setting("time between pushes", "s", above=0)] = 1.0
    stale: Annotated[float, Setting("age of what is seen from which on it is not gone by", "s", above=0)] = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.least_bearing > self.bearing:
            raise ValueError(f"least_bearing: {self.least_bearing:g} is more than bearing ({self.bearing:g})")

    @property
    def things(self) -> Things:
        return Things(
            self.reach, self.strike, self.sit, (self.least_bearing, self.bearing), self.touch,
            (self.bag_width, self.bag_width, self.bag_height), self.bag_mass,
            (self.seat_depth, self.seat_width), self.seat_height,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class StoryEpisode(Episode):
    acts: tuple[Act, ...]
    things: tuple[int, ...]  # of each act: the number of its object in the scene, -1: a point
    points: Array  # (acts, 3) m in the frame that the robot starts in
    headings: Array  # (acts,) rad there, to face at a point

    @property
    def objects(self) -> tuple[SceneObject, ...]:
        return () if self.scene is None else self.scene.objects

    def seat(self, number: int) -> SceneObject | None:
        """What an act is about, where it is a seat."""
        index = self.things[number]
        return self.objects[index] if index >= 0 and self.objects[index].kind == "seat" else None

    @property
    def mark(self) -> int | None:
        """Number of the act whose point is a mark on the floor, where points can be seen: the first that has one."""
        return next((number for number, index in enumerate(self.things) if index < 0), None)

    def point(self, number: int, objects: Array | None, mark: Array | None = None) -> Array:
        """That of an act, as poses `(..., 7)`: where it was drawn, as odometry drifts as seen from what stays where it
        is, a `mark` seen at `(..., 2)` m, or a seat where `objects`, seen in poses `(..., objects, 7)`, have one."""
        facing = self.headings[number]
        drawn = np.array([*self.points[number], math.cos(facing / 2), 0.0, 0.0, math.sin(facing / 2)])
        if mark is not None and number == self.mark:
            found = np.broadcast_to(drawn, (*mark.shape[:-1], 7)).copy()
            found[..., :2] = np.where(np.isfinite(mark), mark, drawn[:2])
            return found
        seat = next((i for i, thing in enumerate(self.objects) if thing.kind == "seat"), None)
        if seat is None or objects is None:
            return drawn
        now, thing = objects[..., seat, :], self.objects[seat]
        found = np.broadcast_to(drawn, now.shape).copy()
        turn = yaw_of(now[..., 3:]) - thing.heading
        moved = turned(drawn[:2] - np.array(thing.place), turn)
        found[..., :2] = np.where(np.isfinite(now[..., :1]), now[..., :2] + moved, drawn[:2])
        found[..., 3:] = headed(found[..., 3:], np.where(np.isfinite(turn), turn, 0.0))
        return found

"""Where the things of a story are: drawn one after the other, each so far from where the act before it ends, and not in
the way between two others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.world import SceneObject
from servoid.hw.setting import Range
from servoid.stack.tasks.stories.act import PELVIS, Act

# m of a thing's middle from the ways that do not lead to it, and from other things: half of it, and of the robot.
CLEAR = {"bag": 0.19, "seat": 0.27}
IN_FRONT = 0.06  # m of the base from a seat's front edge as it rises from it
IN_FRONT_OF_BAG = 0.15  # m of the base from its middle as it strikes
_BEGINNINGS, _TRIES = 300, 40


@dataclass(frozen=True)
class Things:
    """Sizes and distances of a story's things, in m and rad."""

    reach: Range
    strike: Range
    sit: Range
    bearing: Range  # of a thing off the way that the robot faces, to either side
    touch: Range  # heights of points for hands
    bag: tuple[float, float, float]
    bag_mass: float
    seat: tuple[float, float]
    seat_height: Range


@dataclass(frozen=True)
class StoryLayout:
    objects: tuple[SceneObject, ...]
    things: tuple[int, ...]  # of each act: the number of its object, or -1
    points: Array  # (acts, 3) m: that of each act, NaN where it is about an object
    headings: Array  # (acts,) rad: that to face at it


def laid_out(acts: Sequence[Act], what: Things, rng: np.random.Generator) -> StoryLayout:
    """Draw where things are, in the frame that the robot starts in. Raises ConfigError where they find no room."""
    for _ in range(_BEGINNINGS):
        drawing = _Drawing(what, rng)
        if all(drawing.add(act) for act in acts):
            points, headings = np.array(drawing.points), np.array(drawing.headings)
            return StoryLayout(tuple(drawing.objects), tuple(drawing.things), points, headings)
    raise ConfigError(f"no room for the things of {len(acts)} acts: plan fewer, or nearer or farther ones")


class _Drawing:
    """Things so far, and the ways that lead to them."""

    def __init__(self, what: Things, rng: np.random.Generator) -> None:
        self.objects: list[SceneObject] = []
        self.things: list[int] = []
        self.points: list[Array] = []
        self.headings: list[float] = []
        self._what, self._rng = what, rng
        self._here, self._facing = np.zeros(2), 0.0
        self._ways: list[tuple[Array, Array, int]] = []  # from, to, and the object that it leads to

    def add(self, act: Act) -> bool:
        """Draw what an act is about; False where there is no room for it."""
        known = act.thing == "seat" and any(thing.kind == "seat" for thing in self.objects)
        return any(self._fits(act) for _ in range(1 if known else _TRIES))

    def _fits(self, act: Act) -> bool:
        what, objects = self._what, self.objects
        seat = next((i for i, thing in enumerate(objects) if thing.kind == "seat"), -1)
        known = act.thing == "seat" and seat >= 0  # there is one in a story
        distance = self._rng.uniform(*{"point": what.reach, "bag": what.strike, "seat": what.sit}[act.thing])
        (least, most), off = what.bearing, self._rng.uniform(-1.0, 1.0)
        turn = self._facing + math.copysign(least + (most - least) * abs(off), off)
        there = self._here + distance * np.array([math.cos(turn), math.sin(turn)])
        point, new, index = np.full(3, np.nan), list(objects), seat if known else -1
        facing = turn if act.done.faces is None else self._rng.uniform(-math.pi, math.pi)
        if act.thing == "point":
            point = np.array([*there, 0.0 if act.done.part == PELVIS else self._rng.uniform(*what.touch)])
        elif not known:
            index = len(new)
            back = turn + math.pi + self._rng.uniform(-0.5, 0.5)  # it faces the robot, about
            new.append(_object(act.thing, there, back, what, self._rng))
        if act.thing == "seat":
            there = _front(new[index])
        ways = [*self._ways, (self._here, there, index)]
        if not _free(new, ways):
            return False
        self.objects, self._ways = new, ways
        self.things.append(index)
        self.points.append(point)
        self.headings.append(facing)
        self._facing = new[index].heading if act.thing == "seat" else facing
        # It stops before a bag, which lies beyond that then.
        self._here = (
            there - IN_FRONT_OF_BAG * np.array([math.cos(turn), math.sin(turn)]) if act.thing == "bag" else there
        )
        return True


def _object(kind: str, there: Array, heading: float, what: Things, rng: np.random.Generator) -> SceneObject:
    place = (float(there[0]), float(there[1]))
    if kind == "seat":
        depth, width = what.seat
        return SceneObject("seat", place, (depth, width, float(rng.uniform(*what.seat_height))), heading=heading)
    return SceneObject("bag", place, what.bag, what.bag_mass, heading)


def _front(seat: SceneObject) -> Array:
    """Where the base is as it rises from a seat."""
    forward = np.array([math.cos(seat.heading), math.sin(seat.heading)])
    return np.array(seat.place) + (seat.size[0] / 2 + IN_FRONT) * forward


def _free(objects: Sequence[SceneObject], ways: Sequence[tuple[Array, Array, int]]) -> bool:
    """Whether no object is near another one, or near a way that leads elsewhere, which may begin at it."""
    places, room = [np.array(thing.place) for thing in objects], [CLEAR[thing.kind] for thing in objects]
    if any(
        np.linalg.norm(a - b) < max(room[i], r)
        for i, a in enumerate(places)
        for b, r in zip(places[:i], room, strict=False)
    ):
        return False
    for number, (begin, end, index) in enumerate(ways):
        at = ways[number - 1][2] if number else -1  # the object that it begins at
        for i, place in enumerate(places):
            clear = min(room[i], float(np.linalg.norm(begin - place)) - 0.01) if i == at else room[i]
            if i != index and _apart(place, begin, end) < clear:
                return False
    return True


def _apart(point: Array, begin: Array, end: Array) -> float:
    """Distance of a point from the stretch between two others."""
    way = end - begin
    share = float(np.clip((point - begin) @ way / max(float(way @ way), 1e-9), 0.0, 1.0))
    return float(np.linalg.norm(point - begin - share * way))

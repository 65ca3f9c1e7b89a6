"""What the robot is asked while data is collected: named skills, each a set of velocities to draw from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.world import Start
from servoid.hw.robot.description import Robot, Walking
from servoid.sim.truth import SimulatedTruth

Range = tuple[float, float]


@dataclass(frozen=True)
class Box:
    """Velocities to draw uniformly: m/s forward, m/s left, rad/s."""

    forward: Range = (0.0, 0.0)
    left: Range = (0.0, 0.0)
    turn: Range = (0.0, 0.0)

    def of(self, walking: Walking) -> Box:
        """A box of shares of the robot's top speeds, in m/s and rad/s, as far as the robot goes."""
        shares = np.array([self.forward, self.left, self.turn])
        asked = np.clip(shares.T * walking.scale, walking.lower, walking.upper).T
        return Box(*((float(low), float(high)) for low, high in asked))


@dataclass(frozen=True)
class Drill:
    """`text` is the dataset's task; one of the boxes is drawn, then a velocity in it. `weight`: how often."""

    name: str
    text: str
    boxes: tuple[Box, ...]
    weight: float = 1.0
    seconds: Range = (2.0, 6.0)  # that a command lasts
    lower: Range = (0.0, 0.0)  # that the base goes lower than it walks upright

    def draw(self, rng: np.random.Generator) -> Array:
        """A command `(3,)`."""
        box = self.boxes[int(rng.integers(len(self.boxes)))]
        low, high = np.transpose([box.forward, box.left, box.turn])
        return rng.uniform(low, high)


# Boxes are shares: of the top speed forward, whatever the direction, and of that of turning. The skills' numbers are
# the dataset's task indices. Turning and walking mixed weigh more: they are most of what steering to a goal asks for,
# and so does straight ahead, up to more than the expert can. Creeping covers the slow end, where a robot arrives.
SKILLS: tuple[Drill, ...] = (
    Drill("stand", "stand still", (Box(),), 2.5, (1.0, 3.0)),
    Drill("forward", "walk forward", (Box(forward=(0.1, 1.0)),), 2.5),
    Drill("slow", "walk forward slowly", (Box(forward=(0.06, 0.24)),)),
    Drill("backward", "walk backward", (Box(forward=(-0.24, -0.06)),)),
    Drill("side", "step sideways", (Box(left=(0.08, 0.24)), Box(left=(-0.24, -0.08)))),
    Drill("turn", "turn on the spot", (Box(turn=(0.2, 1.0)), Box(turn=(-1.0, -0.2))), 1.5),
    Drill("arc", "walk along an arc", (Box(forward=(0.1, 0.8), turn=(-0.8, 0.8)),), 2.0),
    Drill("diagonal", "walk diagonally", (Box((0.1, 0.3), (0.08, 0.2)), Box((0.1, 0.3), (-0.2, -0.08))), 0.8),
    Drill("reverse", "walk backward along an arc", (Box((-0.24, -0.08), turn=(-0.6, 0.6)),), 0.6),
    Drill("any", "walk and turn in any direction", (Box((-0.24, 0.6), (-0.2, 0.2), (-0.8, 0.8)),), 2.0),
    Drill("creep", "creep slowly in any direction", (Box((-0.12, 0.12), (-0.12, 0.12), (-0.2, 0.2)),)),
)
# Crouched walks, for planners that shall pass under something: slow, since the lower and faster, the sooner one falls.
# `lower` is a share of the standing height, and in the dataset they have the tasks of the same names.
CROUCHED: tuple[Drill, ...] = (
    Drill("stand", "stand still", (Box(),), 1.0, (1.0, 3.0), (0.03, 0.13)),
    Drill("slow", "walk forward slowly", (Box(forward=(0.06, 0.26)),), 4.0, lower=(0.06, 0.13)),
    Drill("forward", "walk forward", (Box(forward=(0.16, 0.4)),), 2.0, lower=(0.02, 0.09)),
    Drill("arc", "walk along an arc", (Box(forward=(0.06, 0.24), turn=(-0.5, 0.5)),), 1.5, lower=(0.04, 0.12)),
    Drill("creep", "creep slowly in any direction", (Box((-0.1, 0.1), (-0.1, 0.1)),), lower=(0.03, 0.12)),
)
FIRST_SECONDS: Range = (0.1, 0.6)  # of standing that an episode begins with: a run starts from rest

_SHARES = np.cumsum([skill.weight for skill in SKILLS]) / sum(skill.weight for skill in SKILLS)
_LOW_SHARES = np.array([drill.weight for drill in CROUCHED]) / sum(drill.weight for drill in CROUCHED)


def skills_of(robot: Robot) -> tuple[Drill, ...]:
    """The skills with what this robot is asked, in m/s and rad/s."""
    return tuple(replace(skill, boxes=tuple(box.of(robot.walking) for box in skill.boxes)) for skill in SKILLS)


def crouched_of(robot: Robot) -> tuple[Drill, ...]:
    """The crouched walks with what this robot is asked, in m/s, rad/s and m."""
    return tuple(
        replace(
            drill,
            boxes=tuple(box.of(robot.walking) for box in drill.boxes),
            lower=(drill.lower[0] * robot.standing_height, drill.lower[1] * robot.standing_height),
        )
        for drill in CROUCHED
    )


def drawn(skills: tuple[Drill, ...], rng: np.random.Generator) -> Drill:
    """One of `SKILLS`, or of the same in a robot's own terms, by their weights."""
    return skills[int(np.searchsorted(_SHARES, rng.random(), side="right"))]


class Commands:
    """The present command of each of `n` worlds, changed every few seconds, drawn from the worlds' own streams."""

    def __init__(
        self, robot: Robot, n: int, crouched: float = 0.0, always: tuple[float, float, float] | None = None
    ) -> None:
        """A share `crouched` of the commands is for a base that is lower than it walks upright. After it stood, one
        velocity is asked `always`, where it is given."""
        self._always = always
        self._rate, self._skills = robot.rate, skills_of(robot)
        self._low, self._crouched = crouched_of(robot), crouched
        self.velocity = np.zeros((n, 3))  # what is asked: m/s forward, m/s left, rad/s
        self.lower = np.zeros(n)  # and how much lower than upright, m
        self.skill = np.zeros(n, int)  # number in SKILLS
        self._left = np.zeros(n, int)  # ticks until the next change
        self._first = np.ones(n, bool)

    @property
    def columns(self) -> dict[str, Array]:
        """What a recording holds beside what is asked, `(n, size)`: nothing."""
        return {}

    def start(self, rngs: Sequence[np.random.Generator], where: Array) -> Start | None:
        """How the next episodes of the worlds `where` begin: standing."""
        return None

    def instruction(self, state: State, truth: SimulatedTruth) -> Instruction:
        """What whoever drives the worlds is told."""
        return Instruction(self.velocity, lower=self.lower)

    def fallen(self, truth: SimulatedTruth) -> Array:
        """Which worlds have fallen `(n,)`."""
        return truth.fallen

    def begin(self, ids: Array) -> None:
        """A new command is due in the worlds `ids`."""
        self._left[ids], self._first[ids] = 0, True

    def advance(self, rngs: list[np.random.Generator]) -> None:
        """Draw the commands that are due; call it once a tick, before reading `velocity`."""
        for i in np.flatnonzero(self._left == 0):
            rng = rngs[i]
            if self._crouched and not self._first[i] and rng.random() < self._crouched:
                skill = self._low[int(rng.choice(len(CROUCHED), p=_LOW_SHARES))]
                self.skill[i] = [each.name for each in SKILLS].index(skill.name)
                self.lower[i] = rng.uniform(*skill.lower)
            else:
                self.skill[i] = 0 if self._first[i] else int(np.searchsorted(_SHARES, rng.random(), side="right"))
                skill, self.lower[i] = self._skills[self.skill[i]], 0.0
            self.velocity[i] = skill.draw(rng)
            if self._always is not None and not self._first[i]:
                self.velocity[i] = self._always
            self._left[i] = round(rng.uniform(*(FIRST_SECONDS if self._first[i] else skill.seconds)) * self._rate)
            self._first[i] = False
        self._left -= 1

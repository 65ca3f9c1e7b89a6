"""What each world of a training in a closed loop is asked: an act of CLoSD's with its seat or bag, or sentences alone.

Acts are those of stories told in words, by the same state machine that a run has. One model holds a seat and a bag for
all worlds: a robot begins where the seat is as its episode was drawn, and a bag that is not asked for stands far off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Behaviour, Episode
from servoid.hw.contracts.world import Percept, Scene, SceneObject, Start, Truth
from servoid.hw.geometry import headed, turned
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import Clip
from servoid.sim.objects import pose
from servoid.sim.scene import Stage
from servoid.stack.tasks.base import BaseBehaviour
from servoid.stack.tasks.stories.story import Story
from servoid.stack.tasks.stories.told import StoryEpisode, StorySettings
from servoid.tools.learn.settings import TrackingSettings

EVERY = 4  # ticks from one look of the state machines to the next
PLANS = {"reach": 1 / 3, "sit,rise": 1 / 3, "punch": 1 / 6, "kick": 1 / 6}  # how often each is drawn, as in CLoSD
WORDS = "words"
# Where a robot is near already: it faces the bag, or has its back to the seat.
NEAR: dict[str, dict[str, Any]] = {
    "reach": {"reach": (0.05, 0.2)},
    "sit,rise": {"sit": (0.2, 0.24), "least_bearing": 3.0},
    "punch": {"strike": (0.14, 0.2), "bearing": 0.3},
    "kick": {"strike": (0.14, 0.2), "bearing": 0.3},
}
_THINGS = StorySettings(by="words", seat_height=(0.145, 0.145))
_SEAT = SceneObject("seat", (0.0, 0.0), (_THINGS.seat_depth, _THINGS.seat_width, _THINGS.seat_height[0]))
_BAG = SceneObject("bag", (50.0, 50.0), (_THINGS.bag_width, _THINGS.bag_width, _THINGS.bag_height), _THINGS.bag_mass)
SCENE = Scene(np.zeros((0, 3)), np.zeros((0, 4)), objects=(_SEAT, _BAG))  # of every world
_ASIDE = np.array([20.0, 0.0])  # m from the seat, a robot that is asked for none
_SENTENCE_SECONDS = 4.0
_KINDS = ("seat", "bag")  # in the model's order


@dataclass
class _World:
    """What one world is asked in this episode."""

    name: str
    behaviour: Behaviour
    which: list[int]  # of the model's objects, those of its own scene
    looks: int = 0
    told: Instruction = field(default_factory=lambda: Instruction(np.zeros(3), stand=True))


class _Told(BaseBehaviour):
    """One sentence after the other."""

    def __init__(self, sentences: Sequence[str], looks: int) -> None:
        super().__init__(Episode())
        self._sentences, self._looks = sentences, looks

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        return Instruction(np.zeros(3), text=self._sentences[tick // self._looks % len(self._sentences)])


class Acts:
    """What `n` worlds are asked."""

    def __init__(self, robot: Robot, n: int, settings: TrackingSettings, clips: Sequence[Clip]) -> None:
        """`clips` whose captions are told where nothing else is, those that begin and end upright."""
        self._dt, self._settings = EVERY * robot.dt, settings
        base = replace(_THINGS, seconds=settings.episode_seconds)
        self._tasks = {
            (name, near): Story(replace(base, plan=name, **(NEAR[name] if near else {})), self._dt, robot)
            for name in PLANS
            for near in (False, True)
        }
        upright = [clip for clip in clips if clip.about.begins == clip.about.ends == "upright"]
        self._sentences = [text for clip in upright for text in clip.about.captions]
        self._worlds = [_World(WORDS, BaseBehaviour(Episode()), []) for _ in range(n)]
        self.over = np.zeros(n, bool)  # done or given up

    @property
    def names(self) -> tuple[str, ...]:
        return (*PLANS, WORDS)

    def name(self, i: int) -> str:
        """What world `i` is asked."""
        return self._worlds[i].name

    @property
    def told(self) -> list[Instruction]:
        """What each world is asked now."""
        return [world.told for world in self._worlds]

    def begin(self, where: Array, rngs: Sequence[np.random.Generator]) -> Start:
        """Draw what the worlds `where` `(n,)` bool are asked, and where they begin; a row for every world."""
        n = len(self._worlds)
        position, heading = np.tile([*_ASIDE, np.nan], (n, 1)), np.zeros(n)
        bags = np.tile(pose(_BAG), (n, 1, 1))  # away, where it is not asked for
        for i in np.flatnonzero(where).tolist():
            self._worlds[i], objects = self._drawn(rngs[i])
            self.over[i] = False
            for thing in objects:
                if thing.kind == "seat":  # which stays where it is
                    heading[i] = -thing.heading
                    position[i, :2] = -turned(np.array(thing.place), heading[i])
            for thing in objects:
                if thing.kind == "bag":
                    stands = pose(thing)
                    stands[:2] = position[i, :2] + turned(stands[:2], heading[i])
                    stands[3:] = headed(stands[3:], heading[i])
                    bags[i, 0] = stands
        return Start(position=position, heading=heading, objects=bags)

    def _drawn(self, rng: np.random.Generator) -> tuple[_World, tuple[SceneObject, ...]]:
        if self._sentences and rng.random() < self._settings.words:
            looks = max(round(_SENTENCE_SECONDS / self._dt), 1)
            return _World(WORDS, _Told([str(text) for text in rng.permutation(self._sentences)], looks), []), ()
        name = str(rng.choice(list(PLANS), p=list(PLANS.values())))
        task = self._tasks[name, rng.random() < self._settings.near]
        episode: StoryEpisode = task.scenario(rng)
        return _World(name, task.behaviour(episode), [_KINDS.index(o.kind) for o in episode.objects]), episode.objects

    def look(self, state: State, truth: Truth) -> None:
        """Let every world's behaviour see its state, and its things where they are; every `EVERY` ticks."""
        for i, world in enumerate(self._worlds):
            own = State(state.time_ns, *(getattr(state, part.name)[i] for part in fields(State)[1:]))
            seen = Stage(SCENE, truth, self._dt, lambda places: None, i).look(own)
            assert seen.objects is not None
            seen = replace(seen, objects=seen.objects[world.which])
            world.told = world.behaviour.instruct(world.looks, own, seen)
            world.looks += 1
            self.over[i] |= world.behaviour.done(own)

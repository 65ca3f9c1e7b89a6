"""Takes toward random places: authored motions whose hand, foot or base goes where it was drawn, by inverse kinematics,
from standing to standing; and whether a robot that executes one brings that part there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from servoid.hw.config import ConfigError, load_yaml, nearest, resolve
from servoid.hw.contracts.body import Array
from servoid.hw.geometry import turned
from servoid.hw.robot.description import Robot
from servoid.policy.diffusion.prefix.frames import BodyMotion, Frames
from servoid.policy.diffusion.prefix.target import PLACES
from servoid.policy.motion.clip import Clip
from servoid.tools.learn.takes.executed import Executed
from servoid.tools.learn.takes.maker import Take, TakeMaker
from servoid.tools.motions.author import Author, KeyPose
from servoid.tools.motions.keyframes import AuthoredClip, Keyframe, Vector

MET = 0.04  # m that the part may be off: half of what the acts of stories allow
LATE = 0.4  # s later at most that it may be there: servos lag behind, and trackers catch up
BASE = "base"
_TRIES = 20  # places, of which one at least must be within reach


@dataclass(frozen=True)
class Move:
    frame: int  # counted from 1
    part: str  # a geom, a foot, or the base, as keyframes have them
    share: float = 1.0


@dataclass(frozen=True)
class AimedMotion:
    """Clips one after the other, the first of which goes to a place that is drawn."""

    part: str  # of `target.names`, that is there at the end
    at: int  # of this keyframe
    low: Vector
    high: Vector
    moves: tuple[Move, ...]
    clips: tuple[AuthoredClip, ...]

    def __post_init__(self) -> None:
        frames = len(self.clips[0].frames) if self.clips else 0
        if not self.moves or any(not 1 <= number <= frames for number in (self.at, *(m.frame for m in self.moves))):
            raise ValueError(f"at and moves: each needs a keyframe of the first clip, 1 to {frames}")
        if any(high < low for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError("low must not be above high")


@dataclass(frozen=True)
class AimedRecipe:
    licence: str
    motions: tuple[AimedMotion, ...]

    @property
    def captions(self) -> dict[str, tuple[str, ...]]:
        """What its clips are called, by name."""
        return {clip.name: clip.captions for motion in self.motions for clip in motion.clips}


@dataclass(frozen=True)
class AimedTake:
    take: Take
    name: str
    part: str
    begun: int  # tick at which the motion begins
    tick: int  # at which the part is to be where the take has it, seen from the base as the motion began

    def met(self, executed: Executed, frames: Frames) -> bool:
        """Whether a robot came to the take's end, and brought the part there."""
        return executed.take.ticks == self.take.ticks and self.missed(executed, frames) <= MET

    def missed(self, executed: Executed, frames: Frames) -> float:
        """m from there, of a robot that came as far, at the best tick up to `LATE` after it."""
        take, wanted = self.take, [self.begun, self.tick]
        asked = frames.motion(take.place[wanted], take.orientation[wanted], take.joints[wanted])
        late = np.arange(round(LATE * frames.robot.rate) + 1)
        done = frames.of_states(executed.raw[[self.begun, *(self.tick + late)]])
        return float(np.linalg.norm(self._seen(frames, done) - self._seen(frames, asked), axis=-1).min())

    def _seen(self, frames: Frames, motion: BodyMotion) -> Array:
        """Where the part is `(frames - 1, 3)` m, in the heading frame of the first one."""
        known, ground = frames.key_points.names, motion.place[0] * [1.0, 1.0, 0.0]
        place = motion.place if self.part in PLACES else motion.points[..., known.index(self.part), :]
        return turned(np.asarray(place)[1:] - ground, -motion.heading[0])


def load_aimed(name: str) -> AimedRecipe:
    """By the path of the file, or by its name in `configs/motions`. Raises ConfigError."""
    return load_yaml(resolve("motions", name), AimedRecipe)


class Aim:
    """Draws takes of a recipe. Raises ConfigError for a part that is not known."""

    def __init__(self, robot: Robot, recipe: AimedRecipe, maker: TakeMaker, frames: Frames) -> None:
        known = (*PLACES, *frames.key_points.ends)
        for motion in recipe.motions:
            if motion.part not in known:
                raise ConfigError(f"part: unknown '{motion.part}': {nearest(motion.part, known)}")
        self._robot, self._recipe, self._maker, self._author = robot, recipe, maker, Author(robot)

    def takes(self, count: int, rng: np.random.Generator) -> list[AimedTake]:
        """So many takes, each motion equally often. Raises ConfigError for a motion that reaches none of its places."""
        found: list[AimedTake] = []
        for number in range(count):
            motion = self._recipe.motions[number % len(self._recipe.motions)]
            reason: ConfigError | None = None
            for _ in range(_TRIES):
                try:
                    found.append(self._take(motion, rng.uniform(motion.low, motion.high)))
                    break
                except ConfigError as error:  # out of reach: another place
                    reason = error
            else:
                raise ConfigError(f"none of {_TRIES} places is within reach: {reason}")
        return found

    def _take(self, motion: AimedMotion, shift: Array) -> AimedTake:
        author, first = self._author, moved(motion, shift, list(self._robot.feet))
        pose, made, at = author.home, list[Clip](), 0
        for wanted in (first, *motion.clips[1:]):
            poses = author.poses(wanted, pose)
            made.append(author.clip(wanted, [pose, *poses], wanted.about("authored", self._recipe.licence)))
            if len(made) == 1:
                at = _reached(made[0], author, poses[motion.at - 1])
            pose = poses[-1]
        take, begun = self._maker.performed(made)
        return AimedTake(take, first.name, motion.part, begun, begun + at)


def moved(motion: AimedMotion, shift: Array, feet: Sequence[str]) -> AuthoredClip:
    """The first clip of a motion, whose parts are shifted by `(3,)` m. Raises ConfigError for a keyframe that does not
    say where such a part is."""
    frames = list(motion.clips[0].frames)
    for move in motion.moves:
        frames[move.frame - 1] = _shifted(frames[move.frame - 1], move, np.asarray(shift) * move.share, feet)
    return replace(motion.clips[0], frames=tuple(frames))


def _shifted(frame: Keyframe, move: Move, by: Array, feet: Sequence[str]) -> Keyframe:
    x, y, z = (float(value) for value in by)
    if move.part == BASE and frame.height is not None and frame.lean is not None:
        return replace(frame, height=frame.height + z, lean=(frame.lean[0] + x, frame.lean[1] + y))
    table = frame.feet if move.part in feet else frame.reach
    if move.part not in table:
        raise ConfigError(f"moves: keyframe {move.frame} does not say where '{move.part}' is")
    a, b, c = table[move.part]
    there = {**table, move.part: (a + x, b + y, c + z)}
    return replace(frame, feet=there) if move.part in feet else replace(frame, reach=there)


def _reached(clip: Clip, author: Author, pose: KeyPose) -> int:
    """The tick at which a clip comes to a pose."""
    return int(np.abs(clip.joints - author.stand(pose)[0]).max(1).argmin())

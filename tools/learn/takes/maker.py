"""Takes to learn planning from: clips, what leads from one to the next, and walks, told in words tick by tick."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.geometry import headed, multiply, turned
from servoid.hw.robot.description import Robot
from servoid.hw.robot.legs import Legs
from servoid.policy.diffusion.prefix.dataset import Sequences
from servoid.policy.diffusion.prefix.frames import Frames, heading_of
from servoid.policy.motion.clip import Clip, smooth
from servoid.policy.references.clip import BLEND_SHARE
from servoid.policy.references.gait import Gait
from servoid.policy.text.captions import MOTIONS, NAMES, motion_of
from servoid.tools.learn.collect.skills import Commands, skills_of

NEXT = -1  # told as what comes next: what leads to a motion belongs to it
_STAND = NAMES.index("stand")
_UPRIGHT = "upright"
LEAD_SECONDS = 1.0  # of standing before a walk: as long as a prefix, so that starting is learned
REACTION_SECONDS = 0.3  # at most, that whoever is told needs to begin
_PEAK = 1.875  # of a minimum-jerk blend's speed over its mean


@dataclass(frozen=True)
class Take:
    """A motion at the robot's rate, and what each tick is called."""

    place: Array  # (ticks, 3) m of the base, z above the ground
    orientation: Array  # (ticks, 4) quaternion w x y z
    joints: Array  # (ticks, n_joints) rad
    label: Array  # (ticks,) int, a number in `labels` or NEXT

    @property
    def ticks(self) -> int:
        return len(self.joints)


def labels(clips: Sequence[Clip], aimed: Mapping[str, tuple[str, ...]] | None = None) -> Mapping[str, tuple[str, ...]]:
    """What can be told, with its phrasings: the motions of walking, then the clips, then `aimed` motions that have no
    clip's name. A label is a number in it.

    Raises ConfigError for a name or a phrasing that two of them have.
    """
    told = {motion.name: motion.phrasings for motion in MOTIONS}
    named = {clip.name: clip.about.captions for clip in clips}
    for name, texts in ({**named, **(aimed or {}), **named}).items():
        if name in told:
            raise ConfigError(f"clip '{name}': a way of walking has that name: give it another one")
        for text in texts:
            if other := next((other for other, said in told.items() if text in said), None):
                raise ConfigError(
                    f"clip '{name}': '{text}' is what '{other}' is called, too, and a planner that is told so "
                    "cannot tell which: give one of them another caption"
                )
        told[name] = texts
    return told


class TakeMaker:
    """Draws takes of one robot."""

    def __init__(
        self,
        robot: Robot,
        clips: Sequence[Clip],
        rng: np.random.Generator,
        aimed: Mapping[str, tuple[str, ...]] | None = None,
    ) -> None:
        """Raises ConfigError without a clip that begins upright, or where nothing leads on from how one ends."""
        self._robot, self._rng = robot, rng
        self._clips = {clip.name: clip for clip in clips}
        self._number = {name: number for number, name in enumerate(labels(clips, aimed))}
        self._from = {
            pose: [clip.name for clip in clips if clip.about.begins == pose]
            for pose in {_UPRIGHT, *(clip.about.ends for clip in clips)}
        }
        dead = [pose for pose, names in self._from.items() if not names]
        if dead:
            raise ConfigError(f"no clip begins {dead[0]}: takes cannot go on from there")
        height, lean = Legs(robot).stand(robot.home)
        self._standing = np.array([0.0, 0.0, float(height)]), lean

    def walks(self, count: int, seconds: float) -> list[Take]:
        """Walks of the gait whose command changes as in `servoid collect`."""
        ticks, commands = self._ticks(seconds), Commands(self._robot, count)
        asked = np.zeros((ticks, count, 3))
        rngs = list(self._rng.spawn(count))
        commands.begin(np.arange(count))
        for tick in range(self._ticks(LEAD_SECONDS), ticks):
            commands.advance(rngs)
            asked[tick] = commands.velocity
        return [replace(take, label=told(take.label)) for take in self._gait(asked)]

    def clips(self, count: int, walking: float = 0.4, rates: tuple[float, float] = (0.85, 1.2)) -> list[Take]:
        """Takes of three clips each, from standing or, a share `walking` of them, from walking to a stop."""
        stops = self._gait(self._stopping(max(count, 1)))
        takes = []
        for _ in range(count):
            parts: list[Take] = []
            for _ in range(3):
                lead = stops[self._rng.integers(len(stops))]
                parts.append(lead if self._rng.random() < walking else self._stand(self._rng.uniform(0.9, 2.0)))
                parts += self._down_and_up(rates)
            takes.append(self._joined([*parts, self._stand(2.0)]))
        return takes

    def _down_and_up(self, rates: tuple[float, float]) -> list[Take]:
        """A clip from standing and, where it ends otherwise, those that lead back to standing."""
        parts: list[Take] = []
        pose = _UPRIGHT
        while not parts or pose != _UPRIGHT:
            name = str(self._rng.choice(self._from[pose]))
            clip = self._clips[name]
            parts.append(self._played(clip.at_rate(self._rng.uniform(*rates))))
            if clip.about.ends != _UPRIGHT:  # stays there for a while, which is told as what led there
                parts.append(_held(parts[-1], self._ticks(self._rng.uniform(0.5, 2.0))))
            pose = clip.about.ends
        return parts

    def performed(self, clips: Sequence[Clip]) -> tuple[Take, int]:
        """Clips one after the other, from standing to standing; and the tick at which the first one begins."""
        lead = [self._stand(self._rng.uniform(0.9, 2.0)), self._played(clips[0])]
        begun = self._joined(lead).ticks - clips[0].ticks
        return self._joined([*lead, *(self._played(clip) for clip in clips[1:]), self._stand(2.0)]), begun

    def _played(self, clip: Clip) -> Take:
        label = np.full(clip.ticks, self._number[clip.name])
        return Take(clip.root_position, clip.root_orientation, clip.joints, label)

    def _stand(self, seconds: float) -> Take:
        """Standing, whose last moments are told as what comes next: whoever is told needs a moment to begin."""
        (place, lean), ticks = self._standing, self._ticks(seconds)
        label = np.full(ticks, _STAND)
        label[ticks - self._ticks(self._rng.uniform(0.0, REACTION_SECONDS)) :] = NEXT
        joints = np.tile(self._robot.home, (ticks, 1))
        return Take(np.tile(place, (ticks, 1)), np.tile(lean, (ticks, 1)), joints, label)

    def _stopping(self, count: int) -> Array:
        """Commands `(ticks, count, 3)` of standing, walking and standing again."""
        lead, walk, stop = (self._ticks(seconds) for seconds in (LEAD_SECONDS, 2.4, 1.0))
        drills = skills_of(self._robot)[1:]  # the first one stands
        weights = np.array([drill.weight for drill in drills])
        asked = np.zeros((lead + walk + stop, count, 3))
        for world in range(count):
            drill = drills[int(self._rng.choice(len(drills), p=weights / weights.sum()))]
            asked[lead : lead + walk, world] = drill.draw(self._rng)
        return asked

    def _gait(self, asked: Array) -> list[Take]:
        """What the gait does when `asked` `(ticks, worlds, 3)`; a stop at the end is told as what comes next, and so
        are the last moments of standing before it begins."""
        robot, (ticks, worlds) = self._robot, asked.shape[:2]
        gait, legs, now = Gait(robot, (worlds,)), Legs(robot), np.zeros(1, int)
        place, yaw = np.zeros((ticks, worlds, 3)), np.zeros(worlds)
        orientation, joints = np.zeros((ticks, worlds, 4)), np.zeros((ticks, worlds, len(robot.joints)))
        at = np.zeros((worlds, 2))
        for tick in range(ticks):
            gait.command(asked[tick])
            frame = gait.frames(now)
            joints[tick] = frame.position[:, 0]
            orientation[tick] = headed(frame.root_orientation[:, 0], yaw)
            place[tick, :, :2] = at
            at = at + turned(frame.velocity[:, 0], yaw) * robot.dt
            yaw = yaw + frame.yaw_rate[:, 0] * robot.dt
            gait.advance()
        place[..., 2] = _above_soles(legs, orientation, joints)
        label = motion_of(asked, robot.walking.scale)
        still = np.cumprod((asked == 0.0).all(-1)[::-1], 0)[::-1].astype(bool) & (asked != 0.0).any((0, 2))
        label = np.where(still, NEXT, label)
        for world in range(worlds):
            first = int((asked[:, world] != 0.0).any(-1).argmax())
            label[first - min(first, self._ticks(self._rng.uniform(0.0, REACTION_SECONDS))) : first, world] = NEXT
        return [Take(place[:, i], orientation[:, i], joints[:, i], label[:, i]) for i in range(worlds)]

    def _joined(self, parts: Sequence[Take]) -> Take:
        """One after the other, each from where the last one ended, its pose going over into the next one's."""
        whole = parts[0]
        for part in parts[1:]:
            whole = self._followed(whole, part)
        return replace(whole, label=told(whole.label))

    def _followed(self, take: Take, after: Take) -> Take:
        turn = heading_of(take.orientation[-1]) - heading_of(after.orientation[0])
        moved = after.place - np.append(after.place[0, :2], 0.0)
        place = turned(moved, turn) + np.append(take.place[-1, :2], 0.0)
        orientation = headed(after.orientation, np.broadcast_to(turn, len(after.orientation)))
        # No faster than blending into a clip may be.
        step = BLEND_SHARE * self._robot.limits.joint_speed * self._robot.dt
        far = np.abs(after.joints[0] - take.joints[-1]).max()
        blend = int(np.ceil(_PEAK * far / step))
        share = smooth(np.arange(1, blend + 1) / (blend + 1.0))[:, None]

        def between(a: Array, b: Array) -> Array:
            return a + share * (b - a)

        near = orientation[0] * (1.0 if orientation[0] @ take.orientation[-1] >= 0.0 else -1.0)
        way = between(take.orientation[-1], near)
        label = np.full(blend, NEXT if after.label[0] != _STAND else take.label[-1])
        return Take(
            np.concatenate([take.place, between(take.place[-1], place[0]), place]),
            np.concatenate([take.orientation, way / np.linalg.norm(way, axis=-1, keepdims=True), orientation]),
            np.concatenate([take.joints, between(take.joints[-1], after.joints[0]), after.joints]),
            np.concatenate([take.label, label, after.label]),
        )

    def _ticks(self, seconds: float) -> int:
        return round(seconds / self._robot.dt)


def sequences(takes: Sequence[Take], frames: Frames) -> Sequences:
    """Takes as frames to learn from."""
    made = Sequences()
    for take in takes:
        made.add(frames, frames.motion(take.place, take.orientation, take.joints), take.label)
    return made


def told(label: Array) -> Array:
    """Labels `(ticks,)` with each NEXT replaced by what comes next; at the end nothing does: standing."""
    out = label.copy()
    last = _STAND
    for i in range(len(out) - 1, -1, -1):
        last = out[i] = last if out[i] == NEXT else out[i]
    return out


def _held(take: Take, ticks: int) -> Take:
    """Its last pose for so many ticks."""
    last = (np.repeat(x[-1:], ticks, 0) for x in (take.place, take.orientation, take.joints, take.label))
    return Take(*last)


def _above_soles(legs: Legs, orientation: Array, joints: Array) -> Array:
    """Heights `(...)` m of the base whose lowest sole touches the ground."""
    _, corners = legs.soles(legs.pick(joints))
    upward = np.array([1.0, -1.0, -1.0, -1.0]) * orientation
    up = multiply(multiply(upward, np.broadcast_to([0.0, 0.0, 0.0, 1.0], orientation.shape)), orientation)[..., 1:]
    return -np.einsum("...lki,...i->...lk", corners, up).min((-1, -2))

"""A motion that is made of keyframes, by the words of a panel: what each asks for, and what can be seen of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import yaml

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import Clip
from servoid.policy.motion.library import Library
from servoid.tools.motions.author import KeyPose, author
from servoid.tools.motions.checks import check
from servoid.tools.motions.editor.frames import AXES, LONGEST, SHORTEST, Poser, TimedPose, number
from servoid.tools.motions.keyframes import Authored, AuthoredClip
from servoid.tools.motions.physics import HOLD_SECONDS, Played, play

MOST_FRAMES = 60
SUFFIX = ".keyframes.yaml"
LICENCE = "Apache-2.0"


class Editor:
    """`do` takes what a panel asks. `said` is what there is to be told of it; `played` what physics made of the clip,
    until it was shown."""

    def __init__(self, robot: Robot, out: Path, *, replaces: bool = False) -> None:
        """`out` is the folder of the library that clips are saved in; `replaces` those of the same name."""
        self.robot, self.poser = robot, Poser(robot)
        self._out, self._replaces = out, replaces
        self.frames = [TimedPose(self.poser.home)]
        self.chosen = 0
        self.name, self.captions, self.licence, self.mirror_name = "my-motion", "my motion", LICENCE, ""
        self.said = ""
        self.played: Played | None = None
        self.limp: Array | None = None  # (n_joints,) rad of a limp robot, where there is one
        self.saved: list[Path] = []
        self._words: dict[str, Callable[[str], None]] = {
            "choose": self._choose,
            "add": self._add,
            "remove": self._remove,
            "home": lambda _: self._put(self.poser.home),
            "seconds": lambda text: self._retime(seconds=number("seconds", text, SHORTEST, LONGEST)),
            "hold": lambda text: self._retime(hold=number("hold", text, 0.0, LONGEST)),
            "name": self._rename,
            "captions": lambda text: setattr(self, "captions", text),
            "licence": lambda text: setattr(self, "licence", text),
            "mirrored": lambda text: setattr(self, "mirror_name", text),
            "mirror": self._mirror,
            "take": lambda text: self._take(arms_alone=text == "arms"),
            "play": self._play,
            "save": self._save,
        }

    def load(self, clip: AuthoredClip, licence: str) -> None:
        """Begin with keyframes that there are. Raises ConfigError naming the one that cannot be."""
        poses = self.poser.author.poses(clip, self.poser.home)
        self.frames = [TimedPose(pose, key.seconds, key.hold) for pose, key in zip(poses, clip.frames, strict=True)]
        self.name, self.captions, self.licence = clip.name, ", ".join(clip.captions), licence
        self.mirror_name = clip.mirrored or ""

    @property
    def frame(self) -> TimedPose:
        return self.frames[self.chosen]

    def do(self, what: str, value: str) -> None:
        """Do what is asked for. Raises ConfigError where that cannot be."""
        self.said = ""
        if what in self._words:
            self._words[what](value)
        else:
            self._put(self._changed(what, value))

    def clip(self) -> Clip:
        """The clip of the keyframes. Raises ConfigError naming the keyframe that cannot be."""
        return next(author(self._recipe(), self.robot, "keyframes made at the operator's page"))

    def _recipe(self) -> Authored:
        captions = tuple(text.strip() for text in self.captions.split(",") if text.strip())
        frames = tuple(self.poser.keyframe(frame) for frame in self.frames)
        clip = AuthoredClip(self.name, captions, frames, mirrored=self.mirror_name or None)
        return Authored(self.licence, (clip,))

    def _changed(self, what: str, value: str) -> KeyPose:
        """The pose with a part of it changed."""
        pose, poser = self.frame.pose, self.poser
        part, _, name = what.partition(" ")
        if part == "joint" and name in self.robot.names:
            return poser.with_joint(pose, name, number(name, value, -10.0, 10.0))
        if what == "height":
            return poser.with_base(pose, what, number(what, value, 0.05, 2.0))
        if part in ("tilt", "lean"):
            return poser.with_base(pose, what, number(what, value, -2.0, 2.0))
        if what == "weight":
            return poser.with_weight(pose, number(what, value, 0.0, 1.0))
        if part == "drag":
            return self._dragged(name, np.array([number(what, text, -10.0, 10.0) for text in value.split()]))
        if part == "move":
            limb, _, axis = name.partition(" ")
            handles = poser.handles(pose)
            if limb in handles and axis in AXES and axis:
                place = handles[limb].copy()
                place[AXES.index(axis)] = number(what, value, -10.0, 10.0)
                return self._dragged(limb, place)
        raise ConfigError(f"'{what}' is nothing that a keyframe has")

    def _dragged(self, limb: str, place: Array) -> KeyPose:
        if place.shape != (3,):
            raise ConfigError("a place has three numbers")
        if limb in self.poser.feet:
            return self.poser.with_foot(self.frame.pose, limb, place)
        if limb not in self.poser.hands:
            raise ConfigError(f"'{limb}' is neither a hand nor a foot of {self.robot.name}")
        pose, missed = self.poser.with_hand(self.frame.pose, limb, place)
        if missed:
            self.said = f"{limb} is {1e3 * missed:.0f} mm short of there"
        return pose

    def _put(self, pose: KeyPose) -> None:
        self.frames[self.chosen] = replace(self.frame, pose=pose)

    def _retime(self, **times: float) -> None:
        self.frames[self.chosen] = replace(self.frame, **times)  # type: ignore[arg-type]

    def _choose(self, text: str) -> None:
        self.chosen = int(number("keyframe", text, 1, len(self.frames))) - 1

    def _add(self, _: str) -> None:
        """A copy of the chosen one, behind it."""
        if len(self.frames) >= MOST_FRAMES:
            raise ConfigError(f"there are {MOST_FRAMES} keyframes: no more fit")
        self.frames.insert(self.chosen + 1, self.frame)
        self.chosen += 1

    def _remove(self, _: str) -> None:
        if len(self.frames) == 1:
            raise ConfigError("a motion has at least one keyframe")
        del self.frames[self.chosen]
        self.chosen = min(self.chosen, len(self.frames) - 1)

    def _rename(self, text: str) -> None:
        if not text or not all(letter.isalnum() or letter in "-_" for letter in text):
            raise ConfigError(f"name: '{text}' must be of letters, digits and '-'")
        self.name = text

    def _mirror(self, _: str) -> None:
        self.frames = [replace(frame, pose=self.poser.mirrored(frame.pose)) for frame in self.frames]

    def _take(self, *, arms_alone: bool) -> None:
        if self.limp is None:
            raise ConfigError("there is no limp robot: give its port with --port")
        if not np.isfinite(self.limp).all():
            raise ConfigError("not every joint of the limp robot was read yet")
        self._put(self.poser.taken(self.limp, self.frame.pose, arms_alone=arms_alone))

    def _play(self, _: str) -> None:
        clip = self.clip()
        held = np.concatenate([clip.joints, np.repeat(clip.joints[-1:], round(HOLD_SECONDS * self.robot.rate), 0)])
        self.played = played = play(held, self.robot)
        wrong = check(clip, self.robot)["wrong"]
        fallen = np.flatnonzero(played.fallen[0])
        after = f"it fell after {fallen[0] * self.robot.dt:.1f} s" if len(fallen) else "it stands at the end"
        self.said = f"{clip.ticks * self.robot.dt:.1f} s in physics, open loop: {after}" + (
            f"; beyond what a clip should have: {', '.join(wrong)}" if wrong else ""
        )

    def _save(self, _: str) -> None:
        recipe = self._recipe()
        clips = list(author(recipe, self.robot, f"keyframes of {self.name}{SUFFIX}"))
        self._out.mkdir(parents=True, exist_ok=True)
        library = Library(self.robot, self._out)
        paths = [library.add(clip, replace=self._replaces) for clip in clips]
        file = self._out / f"{self.name}{SUFFIX}"
        file.write_text(yaml.safe_dump(_plain(asdict(recipe)), sort_keys=False, default_flow_style=None, width=110))
        self.saved += [*paths, file]
        self.said = f"saved {', '.join(str(path) for path in paths)}, and its keyframes as {file}"


def _plain(values: object) -> object:
    """Without what says nothing: defaults are left out, tuples become lists."""
    if isinstance(values, dict):
        return {key: _plain(value) for key, value in values.items() if value not in (None, {}, False, "")}
    return [_plain(value) for value in values] if isinstance(values, list | tuple) else values

"""A skill: a motion that can be asked for by name, as a file of `configs/skills/` describes it."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from servoid.hw.config import CONFIGS, ConfigError, load_marked, nearest
from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import resolve
from servoid.policy.motion.clip import POSES, SUFFIX, Clip, load
from servoid.policy.motion.library import Library
from servoid.stack.log.provenance import sha256
from servoid.stack.safety.balance import Balance

UPRIGHT = "upright"
Part = Literal["feet", "hands", "knees", "trunk"]


@dataclass(frozen=True)
class After:
    """What must be true when a skill is over, beside the pose that it ends in: the robot rests, has gone no further
    than this, and did what was asked."""

    moved: float = 0.15  # m of the base over the ground
    turned: float = 0.35  # rad
    joints: float = 0.1  # rad, root mean square that the joints were off the motion

    def __post_init__(self) -> None:
        for name, value in (("moved", self.moved), ("turned", self.turned), ("joints", self.joints)):
            if value <= 0.0:
                raise ValueError(f"{name}: must be positive, not {value:g}")


@dataclass(frozen=True)
class Skill:
    """What a skill is; where it begins and ends is one of the poses of `policy.motion.clip.POSES`, or one of those more
    closely described: "sitting on a seat".

    `policy` performs it: `clip` plays the clip, open loop or with some `balance`; `tracker` follows it with feedback,
    by a network that knows clips.
    """

    about: str  # in a line, for people
    clip: str  # name in the shipped library, or a file
    phrases: tuple[str, ...]  # that ask for it; the first is shown
    held_out: tuple[str, ...] = ()  # others, by which the understanding of words is measured
    policy: Literal["clip", "tracker"] = "tracker"
    tracker: str = "tracker"  # checkpoint, where a tracker performs it
    balance: Balance | None = None  # of a clip that is played: what hips and ankles do about a base that tilts
    entry: str = UPRIGHT
    end: str = UPRIGHT
    interrupted_by: Literal["anything", "nothing"] = "nothing"  # another skill, or being asked to stop, before its end
    contacts: tuple[Part, ...] = ("feet",)  # what may touch the ground or a seat
    after: After = field(default_factory=After)
    name: str = ""  # of its file
    seconds: float = 0.0  # its clip's length

    def __post_init__(self) -> None:
        if not self.phrases or not all(text.strip() for text in (*self.phrases, *self.held_out)):
            raise ValueError("phrases: at least one is needed, and none may be empty")
        for key, pose in (("entry", self.entry), ("end", self.end)):
            if not any(pose == known or pose.startswith(f"{known} ") for known in POSES):
                raise ValueError(f"{key}: '{pose}' is none of {', '.join(POSES)}")
        if self.balance is not None and self.policy != "clip":
            raise ValueError("balance: is for policy: clip; a tracker keeps its own")
        if self.interrupted_by == "anything" and self.low:
            raise ValueError("interrupted_by: a skill that does not stay on its feet is not left half done")

    @property
    def low(self) -> bool:
        """Whether the robot is lower than one that stands, somewhere on the way."""
        return self.contacts != ("feet",) or not self.entry == self.end == UPRIGHT

    @property
    def alone(self) -> bool:
        """Whether it takes nothing but the ground: no seat, say."""
        return self.entry in POSES and self.end in POSES


def load_skills(robot: Robot, folder: Path = CONFIGS / "skills") -> dict[str, Skill]:
    """The skills of a folder, by name.

    Raises ConfigError for a clip of another robot, and, naming file, line and key, for a file that is wrong or says
    something else than its clip.
    """
    found, library = {}, Library(robot)
    for path in sorted(folder.glob("*.yaml")):
        skill, marks = load_marked(path, Skill)
        clip = load(clip_path(skill.clip, library), robot)
        for key, said, is_so in (("entry", skill.entry, clip.about.begins), ("end", skill.end, clip.about.ends)):
            if said != is_so and not said.startswith(f"{is_so} "):
                raise marks.error(key, f"'{said}', but its clip '{clip.name}' has '{is_so}'")
        found[path.stem] = replace(skill, name=path.stem, seconds=(clip.ticks - 1) * robot.dt)
    return found


def has_skills(robot: Robot, folder: Path = CONFIGS / "skills") -> bool:
    """Whether the shipped library has the motions of all skills for a robot."""
    fitting = Library(robot).fitting
    return all(load_marked(path, Skill)[0].clip in fitting for path in folder.glob("*.yaml"))


def chosen(name: str, skills: Mapping[str, Skill]) -> Skill:
    """The skill of that name. Raises ConfigError with the nearest one."""
    if name not in skills:
        raise ConfigError(f"unknown skill '{name}': {nearest(name, skills)} (servoid skills lists them)")
    return skills[name]


def clip_of(skill: Skill, robot: Robot) -> Clip:
    """The motion of a skill. Raises ConfigError."""
    return load(clip_path(skill.clip, Library(robot)), robot)


def fingerprints(robot: Robot) -> dict[str, dict[str, Any]]:
    """What each skill is, and the hashes of its clip's file and its tracker's, by name, to be compared."""
    library = Library(robot)

    def files(skill: Skill) -> dict[str, str | None]:
        clip = {"clip_sha256": sha256(clip_path(skill.clip, library))}
        return clip if skill.policy == "clip" else {**clip, "tracker_sha256": sha256(resolve(skill.tracker))}

    return {name: asdict(skill) | files(skill) for name, skill in load_skills(robot).items()}


def clip_path(clip: str, library: Library) -> Path:
    """File of a clip that is named as a skill's file names it. Raises ConfigError."""
    return Path(clip) if clip.endswith(SUFFIX) else library.path(clip)


def steps(here: str, skill: Skill, skills: Mapping[str, Skill]) -> tuple[Skill, ...]:
    """What a robot in the pose `here` performs when a skill is asked for; nothing where the skill only leads there.

    Raises ConfigError where nothing leads to the skill's entry.
    """
    return () if skill.entry != skill.end == here else (*way(here, skill.entry, skills), skill)


def way(here: str, there: str, skills: Mapping[str, Skill]) -> tuple[Skill, ...]:
    """The fewest skills that bring a robot from one pose to another; none where it is in it already.

    Raises ConfigError where no skill leads there.
    """
    ahead: deque[tuple[str, tuple[Skill, ...]]] = deque([(here, ())])
    seen = {here}
    while ahead:
        pose, done = ahead.popleft()
        if pose == there:
            return done
        for skill in skills.values():
            if skill.entry == pose and skill.end not in seen:
                seen.add(skill.end)
                ahead.append((skill.end, (*done, skill)))
    raise ConfigError(f"no skill leads from '{here}' to '{there}'")

"""Authored motions as data (`configs/motions/`): keyframes of a robot that stands on its feet."""

from __future__ import annotations

from dataclasses import dataclass, field

from servoid.hw.config import ConfigError, load_yaml, resolve
from servoid.policy.motion.clip import About
from servoid.stack.safety.balance import Balance

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Keyframe:
    """A pose, and the time that the robot takes to get there. What a keyframe does not name stays as it was.

    Lengths m, angles rad. Feet and hands are where the pose says; the base moves over them so that the weight rests on
    the feet as asked.
    """

    seconds: float  # from the keyframe before, or longer where a joint would be too fast
    hold: float = 0.0  # s, that it is held
    home: bool = False  # first, everything goes back to the home pose
    height: float | None = None  # of the base above the ground
    tilt: Vector | None = None  # roll, pitch and yaw of the base
    weight: dict[str, float] = field(default_factory=dict)  # share that a foot carries, of 1 in all
    lean: tuple[float, float] | None = None  # centre of mass forward and left of the soles' centres that carry it
    feet: dict[str, Vector] = field(default_factory=dict)  # a sole's centre, from where it stands at home
    turn: dict[str, Vector] = field(default_factory=dict)  # roll, pitch, yaw of a foot; yaw about the stance's middle
    reach: dict[str, Vector] = field(
        default_factory=dict
    )  # a body's geom in the model, such as l_hand, seen from the base
    joints: dict[str, float] = field(default_factory=dict)  # of the arms and the head

    def __post_init__(self) -> None:
        if self.seconds <= 0.0:
            raise ValueError("seconds: must be above 0")
        if self.hold < 0.0:
            raise ValueError("hold: must not be negative")
        if self.weight and (min(self.weight.values()) < 0.0 or abs(sum(self.weight.values()) - 1.0) > 1e-6):
            raise ValueError("weight: shares must not be negative, and must add up to 1")


@dataclass(frozen=True)
class JointStep:
    """Goals of joints, those of legs too, and the time that they take: nothing is solved for, and physics says where it
    leads. What a step does not name stays as it was. Joints that go on the same way pass through."""

    seconds: float  # from the step before
    joints: dict[str, float] = field(default_factory=dict)  # rad
    hold: float = 0.0  # s
    home: bool = False  # first, every joint goes back to the home pose

    def __post_init__(self) -> None:
        if self.seconds <= 0.0:
            raise ValueError("seconds: must be above 0")
        if self.hold < 0.0:
            raise ValueError("hold: must not be negative")


@dataclass(frozen=True)
class AuthoredClip:
    """Made of keyframes that keep their balance, or of steps that need not."""

    name: str
    captions: tuple[str, ...]
    frames: tuple[Keyframe, ...] = ()
    steps: tuple[JointStep, ...] = ()
    balance: Balance = field(default_factory=Balance)  # beside steps, as the skill has it that performs the clip
    begins: str = "upright"  # one of `clip.POSES`
    ends: str = "upright"
    after: str | None = None  # begins in the last pose of this clip
    loop: bool = False
    mirrored: str | None = None  # name of the clip that is made of it with left and right swapped

    def __post_init__(self) -> None:
        if bool(self.frames) == bool(self.steps):
            raise ValueError("frames, or steps: at least one is needed, and not of both")

    def about(self, source: str, licence: str) -> About:
        """Raises ConfigError where it does not say enough, or says what cannot be."""
        try:
            return About(self.captions, source, licence, self.begins, self.ends, self.loop, self.mirrored or "")
        except ValueError as error:
            raise ConfigError(f"clip '{self.name}': {error}") from None


@dataclass(frozen=True)
class Authored:
    licence: str
    clips: tuple[AuthoredClip, ...]


def load_authored(name: str) -> Authored:
    """Authored motions by the path of their file, or by its name in `configs/motions`. Raises ConfigError."""
    return load_yaml(resolve("motions", name), Authored)

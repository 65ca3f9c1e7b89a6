"""The motions that can be asked for in words, and which of them a commanded or measured velocity is.

A twist is `(..., 3)`: m/s forward, m/s left, rad/s to the left, as in `Instruction.velocity`. What is fast depends on
the robot: `top` `(3,)` are its top speeds (`Walking.scale`), and thresholds here are shares of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array

Twist = tuple[float, float, float]


@dataclass(frozen=True)
class Motion:
    """A motion with a name. `phrasings` are for training, the first being canonical; `held_out` are for evaluation.

    `typical` is a twist in the middle of those that `motion_of` calls so, as shares of the top speeds.
    """

    name: str
    typical: Twist
    phrasings: tuple[str, ...]
    held_out: tuple[str, ...]


def _both_sides(name: str, typical: Twist, phrasings: tuple[str, ...], held_out: tuple[str, ...]) -> tuple[Motion, ...]:
    """A motion to the left and its mirror image; `{}` stands for the side."""
    forward, left, turn = typical
    return tuple(
        Motion(
            name.format(side),
            (forward, sign * left, sign * turn),
            tuple(text.format(side) for text in phrasings),
            tuple(text.format(side) for text in held_out),
        )
        for side, sign in (("left", 1.0), ("right", -1.0))
    )


MOTIONS: tuple[Motion, ...] = (
    Motion(
        "stand",
        (0.0, 0.0, 0.0),
        (
            "stand still",
            "stop",
            "stop walking",
            "stay where you are",
            "do nothing and wait",
            "halt",
            "hold your position",
            "remain standing in place",
            "rest on both feet",
        ),
        ("stop moving", "wait here", "freeze", "just stand there"),
    ),
    Motion(
        "forward slowly",
        (0.16, 0.0, 0.0),
        (
            "walk forward slowly",
            "go slowly ahead",
            "creep forward",
            "take slow steps forward",
            "move ahead at a gentle pace",
            "walk straight on, carefully",
            "advance at low speed, slowly",
            "slow walk straight ahead",
        ),
        ("move forward at a slow pace", "inch ahead", "carefully walk ahead", "crawl forward"),
    ),
    Motion(
        "forward",
        (0.36, 0.0, 0.0),
        (
            "walk forward",
            "go straight ahead",
            "move forward",
            "walk ahead",
            "walk straight",
            "step forward",
            "keep walking straight on",
            "advance",
            "go on",
            "go forward at a normal pace",
        ),
        ("please walk straight ahead", "proceed forward", "march onward", "head straight on"),
    ),
    Motion(
        "forward fast",
        (0.64, 0.0, 0.0),
        (
            "walk forward fast",
            "hurry straight ahead",
            "run forward",
            "go ahead quickly",
            "take quick steps forward",
            "move forward at high speed",
            "walk briskly straight on",
            "jog ahead as fast as you can",
        ),
        ("rush forward", "walk ahead rapidly", "move ahead swiftly", "sprint forward"),
    ),
    Motion(
        "backward",
        (-0.16, 0.0, 0.0),
        (
            "walk backward",
            "go back",
            "step backwards",
            "move in reverse",
            "back up",
            "retreat",
            "walk straight back",
            "reverse a few steps",
        ),
        ("walk in reverse", "take some steps back", "back away", "move backwards please"),
    ),
    *_both_sides(
        "side-step {}",
        (0.0, 0.16, 0.0),
        (
            "side-step to the {}",
            "step {}",
            "walk {}",
            "walk sideways to the {}",
            "move to the {}",
            "strafe {}",
            "shuffle {}",
            "take steps to your {} side",
            "shift sideways, {}",
            "go {} without turning around: sidestep",
        ),
        ("sidestep {}", "move sideways to the {}", "slide to the {}", "crab walk to the {}"),
    ),
    *_both_sides(
        "turn {}",
        (0.0, 0.0, 0.6),
        (
            "turn {} on the spot",
            "turn {}",
            "rotate to the {}",
            "turn to the {} in place",
            "spin {}",
            "pivot {}",
            "face further to the {}, turning",
            "turn around to the {}",
            "rotate {} without walking",
        ),
        ("spin around to the {}", "rotate {} on the spot", "swivel to the {}", "make a {} turn in place"),
    ),
    *_both_sides(
        "arc {}",
        (0.3, 0.0, 0.4),
        (
            "walk along an arc to the {}",
            "walk forward while turning {}",
            "curve to the {}",
            "walk in a circle to the {}",
            "go forward and bear {} in a curve",
            "veer {}",
            "follow a bend to the {}",
            "turn {} as you walk ahead",
            "steer {} while walking",
            "walk and turn {}",
        ),
        ("walk in a curve to the {}", "move forward turning {}", "swerve {}", "circle {} as you go ahead"),
    ),
    *_both_sides(
        "diagonal {}",
        (0.18, 0.15, 0.0),
        (
            "walk diagonally forward to the {}",
            "go diagonally {}",
            "step forward and {} at the same time, diagonally",
            "move diagonally ahead and to the {}",
            "walk at a slant, forward and {}",
            "sidestep {} while walking forward",
            "walk forward and sideways to the {}",
            "diagonal steps to the {}",
            "go forward and {}",
        ),
        (
            "move diagonally to the {}",
            "walk obliquely {}",
            "walk ahead while stepping sideways {}",
            "step diagonally {}",
        ),
    ),
    *_both_sides(
        "backward arc {}",
        (-0.16, 0.0, 0.4),
        (
            "walk backward while turning {}",
            "back up along an arc to the {}",
            "reverse in a curve to the {}",
            "go back and turn {} as you go",
            "step backwards turning to the {}",
            "reverse and steer {}",
            "walk back around a bend to the {}",
            "curve {} walking backwards",
        ),
        ("turn {} while backing up", "reverse turning {}", "walk backwards in a curve to the {}"),
    ),
)
NAMES: tuple[str, ...] = tuple(motion.name for motion in MOTIONS)

STILL_SPEED = 0.02  # of the top speed forward and to the left, below which a twist is standing, together with
STILL_TURN = 0.05  # of the top rate of turning
SLOW, FAST = 0.24, 0.5  # of the top speed: below is slow, from there on is fast
# Radii of a path, in units of its radius at top speed while turning at the top rate:
SPOT_RADIUS = 0.2  # a turn tighter than this is on the spot
SIDE_RADIUS = 0.6  # the same when the feet go sideways, for which there is no word while turning
ARC_RADIUS = 2.0  # a turn wider than this is straight
_SECTOR = float(np.tan(np.pi / 8))  # a direction belongs to an axis within 22.5 degrees of it, else it is diagonal


def motion_of(twist: Array, top: Array) -> Array:
    """Index in `MOTIONS` of twists `(..., 3)`, `(...)` int. Every finite twist has one.

    Near zero it is standing. Otherwise the radius of the path (speed / |turning rate|) and its direction decide:
    tighter than `SPOT_RADIUS` is turning on the spot, tighter than `ARC_RADIUS` an arc forward or backward, wider is
    straight, by direction. Sideways with a turn tighter than `SIDE_RADIUS` is turning. Diagonally backward counts as
    the nearer of backward and sideways. Forward has three speeds.
    """
    forward, left, turn = np.moveaxis(np.asarray(twist, dtype=float) / top, -1, 0)
    speed, rate = np.hypot(forward, left), np.abs(turn)
    still = (np.abs(forward) < STILL_SPEED) & (np.abs(left) < STILL_SPEED) & (rate < STILL_TURN)
    ahead, aside = np.abs(forward), np.abs(left)
    sideways = np.where(forward > 0, ahead < aside * _SECTOR, ahead < aside)
    diagonal = (forward > 0) & ~sideways & (aside > ahead * _SECTOR)
    spot = speed < np.where(sideways, SIDE_RADIUS, SPOT_RADIUS) * rate
    arc = ~sideways & (speed < ARC_RADIUS * rate)
    return np.select(
        [still, spot, arc & (forward > 0), arc, sideways, diagonal, forward < 0, forward < SLOW, forward < FAST],
        [
            np.asarray(_STAND),
            _sided("turn", turn),
            _sided("arc", turn),
            _sided("backward arc", turn),
            _sided("side-step", left),
            _sided("diagonal", left),
            np.asarray(NAMES.index("backward")),
            np.asarray(NAMES.index("forward slowly")),
            np.asarray(NAMES.index("forward")),
        ],
        np.asarray(NAMES.index("forward fast")),
    )


def mirrored(index: Array | int) -> Array:
    """Indices of the motions with left and right swapped, in the shape of `index`."""
    return _MIRRORED[index]


def caption(twist: Array, top: Array) -> str:
    """The canonical phrasing of a twist `(3,)`."""
    return MOTIONS[int(motion_of(twist, top))].phrasings[0]


def twist_of(index: int, top: Array) -> Array:
    """A typical twist `(3,)` of a motion."""
    return np.array(MOTIONS[index].typical) * top


TOLERANCE = np.array([0.04, 0.04, 0.12])  # of the top speeds: drift that nobody would call another motion
PART = 0.25  # of the typical twist that a motion must reach wherever that is not zero


def followed(motion: int, mean_twist: Array, top: Array) -> bool:
    """Whether a measured mean twist `(3,)` is what the motion's phrasings ask for.

    So it is when each component that makes the motion goes the right way with at least `PART` of the typical, and a
    twist within `TOLERANCE` of the measured one has the motion's name. Raises ValueError where it is not finite.
    """
    measured = np.asarray(mean_twist, dtype=float)
    if measured.shape != (3,) or not np.isfinite(measured).all():
        raise ValueError(f"a mean twist is three finite numbers, not {mean_twist}")
    typical = twist_of(motion, top)
    asked = typical != 0
    if (measured[asked] * np.sign(typical[asked]) < PART * np.abs(typical[asked])).any():
        return False
    return bool((motion_of(measured + _NEIGHBOURS * top, top) == motion).any())


def _sided(name: str, towards: Array) -> Array:
    """Index of the motion to the left where `towards` is positive, else to the right."""
    return np.where(towards > 0, NAMES.index(f"{name} left"), NAMES.index(f"{name} right"))


def _other_side(name: str) -> str:
    head, _, side = name.rpartition(" ")
    return f"{head} {'right' if side == 'left' else 'left'}" if side in ("left", "right") else name


_STAND = NAMES.index("stand")
_MIRRORED = np.array([NAMES.index(_other_side(name)) for name in NAMES])
_GRID = np.linspace(-1, 1, 5)
_NEIGHBOURS = np.stack(np.meshgrid(_GRID, _GRID, _GRID, indexing="ij"), -1).reshape(-1, 3) * TOLERANCE

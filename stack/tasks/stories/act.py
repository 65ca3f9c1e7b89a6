"""An act of a story: what it is about, where to stand for it, what performs it and when it is done.

Each is a file of `configs/acts/`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from servoid.hw.config import ConfigError, available, load_yaml, nearest, resolve
from servoid.stack.skills.skill import Skill

KIND = "acts"  # folder of the files
ANY = "any"
STRIKE = "strike"  # with whatever
PELVIS = "pelvis"
Thing = Literal["point", "bag", "seat"]


@dataclass(frozen=True)
class Approach:
    """Where the base stands before the act, seen from the robot: the thing is so far `ahead` and so far to the left
    (`aside`). A robot that turns its `back` has the thing behind it instead, as the thing's own heading says: a seat
    faces where who sits on it looks. A seat is measured from its front edge."""

    ahead: float = 0.0  # m
    aside: float = 0.0  # m
    back: bool = False
    within: float = 0.03  # m that the base may be off
    turned: float = 0.2  # rad that it may face elsewhere

    def __post_init__(self) -> None:
        if self.within <= 0.0 or self.turned <= 0.0:
            raise ValueError("within and turned must be positive")


@dataclass(frozen=True)
class Done:
    """When an act is done. Where several are given, all must hold at once."""

    part: str | None = None  # "pelvis" over the point, or a key point ("left hand") at it
    within: float = 0.08  # m from it
    faces: float | None = None  # rad off the heading that is drawn with a point, at most
    lies: bool = False  # the bag has fallen
    seated: bool = False  # the base is over the seat, and low
    upright: bool = False  # the robot stands
    still: float = 0.0  # s for which that must hold, the base being at rest

    def __post_init__(self) -> None:
        if not (self.part or self.lies or self.seated or self.upright):
            raise ValueError("part, lies, seated or upright: at least one says when the act is done")
        if self.within <= 0.0 or self.still < 0.0:
            raise ValueError("within must be positive, and still not negative")


@dataclass(frozen=True)
class Act:
    about: str  # in a line, for people
    thing: Thing
    done: Done
    seconds: float  # from its beginning, after which it has failed
    sentence: str | None = None  # that asks a planner for it; none: as the velocity says
    lasts: float = 0.0  # s that a planner takes for that; 0: as long as the skill
    targets: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    # where parts shall be, m from the thing's middle: along its heading, to the left and up; by name
    skill: str | None = None  # that performs it; none: standing there does
    limb: str | None = None  # key point that strikes a bag ("left hand")
    approach: Approach | None = None  # none: from where the robot is
    sits: bool = False  # begins on the seat
    share: float = 0.0  # how often it is drawn, of all that may follow
    name: str = ""  # of its file

    def __post_init__(self) -> None:
        if self.seconds <= 0.0 or min(self.share, self.lasts) < 0.0:
            raise ValueError("seconds must be positive, and share and lasts not negative")


def load_acts(skills: Mapping[str, Skill]) -> dict[str, Act]:
    """The acts, by name. Raises ConfigError for a file that is wrong, or that names an unknown skill."""
    found = {}
    for name in available(KIND):
        path = resolve(KIND, name)
        act = load_yaml(path, Act)
        if act.skill is not None and act.skill not in skills:
            raise ConfigError(f"{path}: skill: '{act.skill}' is unknown: {nearest(act.skill, skills)}")
        found[name] = replace(act, name=name)
    return found


def chosen(name: str, acts: Mapping[str, Act]) -> Act:
    """The act of that name. Raises ConfigError with the nearest one."""
    if name not in acts:
        raise ConfigError(
            f"plan: unknown act '{name}': {nearest(name, acts)}; known: {', '.join(acts)}, {STRIKE}, {ANY}"
        )
    return acts[name]


def drawn(name: str, before: Act | None, acts: Mapping[str, Act], rng: np.random.Generator) -> Act:
    """The act of that name; `any`: one that may follow, by its share; "punch": with the left or the right hand;
    "strike": punch or kick.

    Raises ConfigError for an unknown one, and for one that cannot follow.
    """
    sides = [acts[key] for side in ("left", "right") if (key := f"{name}-{side}") in acts]
    if name == STRIKE:
        sides = [act for act in acts.values() if act.done.lies]
    elif name == ANY:
        sides = [act for act in acts.values() if act.share and follows(act, before)]
    if len(sides) > 1:
        shares = np.array([act.share for act in sides])
        act = sides[int(rng.choice(len(sides), p=shares / shares.sum()))]
    else:
        act = sides[0] if sides else chosen(name, acts)
    if not follows(act, before):
        where = "on the seat: let sit come before it" if act.sits else "standing: let rise come before it"
        raise ConfigError(f"plan: '{act.name}' begins {where}")
    return act


def follows(act: Act, before: Act | None) -> bool:
    """Whether an act can come after another: only what begins on the seat comes after sitting down."""
    return act.sits == (before is not None and before.done.seated)

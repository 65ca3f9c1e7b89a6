"""Recipes: which clips to make of an action file, by pages, as data (`configs/motions/`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from servoid.hw.config import ConfigError, load_yaml, resolve
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import About, Clip
from servoid.tools.motions.action_file import Page, chain, joint_goals, read_pages

AFTER_SECONDS = 0.5  # that the last goal is held, so that what it leads to is seen
SLACK = 0.01  # rad that a goal may lie beyond a joint's range: the guard's limits cut it off


@dataclass(frozen=True)
class PageClip:
    """A clip of the chain of pages that begins with `page`."""

    page: int
    name: str
    captions: tuple[str, ...]
    begins: str = "upright"  # one of `clip.POSES`
    ends: str = "upright"
    loop: bool = False
    after: str | None = None  # begins in the last pose of this clip

    def about(self, source: str, licence: str) -> About:
        """Raises ConfigError where it does not say enough, or says what cannot be."""
        try:
            return About(self.captions, source, licence, self.begins, self.ends, self.loop)
        except ValueError as error:
            raise ConfigError(f"clip '{self.name}': {error}") from None


@dataclass(frozen=True)
class Recipe:
    licence: str
    clips: tuple[PageClip, ...]


def load_recipe(name: str) -> Recipe:
    """A recipe by the path of its file, or by its name in `configs/motions`. Raises ConfigError."""
    return load_yaml(resolve("motions", name), Recipe)


def make_clips(file: Path, recipe: Recipe, robot: Robot) -> Iterator[Clip]:
    """The clips of a recipe, each played open loop in physics, where the way of the base comes from.

    Raises ConfigError, also where a goal is beyond a joint's range: another motion would be played.
    """
    pages, made = read_pages(file), dict[str, Clip]()
    for wanted in recipe.clips:
        if wanted.after is not None and wanted.after not in made:
            raise ConfigError(f"clip '{wanted.name}': after: '{wanted.after}' is not an earlier clip")
        start = robot.home if wanted.after is None else made[wanted.after].joints[-1]
        made[wanted.name] = _clip(file, wanted, chain(pages, wanted.page, file), recipe.licence, robot, start)
        yield made[wanted.name]


def _clip(file: Path, wanted: PageClip, pages: list[Page], licence: str, robot: Robot, start: Array) -> Clip:
    from servoid.tools.motions.physics import play

    about = wanted.about(f"{file.name}, pages {', '.join(str(page.number) for page in pages)}", licence)
    goals = joint_goals(pages, robot, start)
    if wanted.after is None and wanted.begins != "upright":  # nobody lies in the home pose
        goals = joint_goals(pages, robot, _first_rest(goals))
    beyond = np.maximum(robot.lower - goals, goals - robot.upper).max(0)
    if (beyond > SLACK).any():
        far = ", ".join(f"{robot.names[i]} by {beyond[i]:.2f}" for i in np.flatnonzero(beyond > SLACK))
        raise ConfigError(f"{file}: page {wanted.page} goes beyond the joint ranges of {robot.name}: {far} rad")
    held = np.concatenate([goals, np.repeat(goals[-1:], round(AFTER_SECONDS * robot.rate), 0)])
    return play(held, robot, begins=wanted.begins).as_clip(wanted.name, about)


def _first_rest(goals: Array) -> Array:
    """The pose that a motion first comes to rest in, or its last one where it never does."""
    still = np.abs(np.diff(goals, axis=0)).max(1) < 1e-6
    moving = np.flatnonzero(~still)
    rest = np.flatnonzero(still[moving[0] :]) if len(moving) else np.array([], int)
    return goals[moving[0] + rest[0]] if len(rest) else goals[-1]

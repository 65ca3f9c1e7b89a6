"""What a recording was told, with the phrasings of the walks and skills that it shows."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.hw.robot.mirror import Mirror
from servoid.policy.recording import Recording
from servoid.policy.text.captions import MOTIONS
from servoid.policy.text.told import Told, walk_clock
from servoid.stack.skills.skill import Skill, chosen, clip_of, load_skills

MIRRORED = 0.05  # rad, root mean square, up to which one clip counts as the mirror image of another


def skills_in(recording: Recording, robot: Robot) -> dict[str, Skill]:
    """The skills that a recording shows, in the order of its labels. Raises ConfigError for an unknown one."""
    known = load_skills(robot) if recording.skills else {}
    return {name: chosen(name, known) for name in recording.skills}


def told_of(recording: Recording, robot: Robot, skills: Mapping[str, Skill]) -> Told | None:
    """What a recording of `skills` was told; None: of walks, by their commands alone."""
    if recording.told is None or recording.clock is None:
        return None
    walks = Told.walks(recording.command, robot.walking.scale)
    phrasings = (*walks.phrasings, *(skill.phrases for skill in skills.values()))
    first = np.maximum.accumulate(np.where(_begun(recording), np.arange(len(recording.told)), 0))
    since = (np.arange(len(recording.told)) - first) * robot.dt
    clock = np.where(recording.told < len(MOTIONS), walk_clock(since), recording.clock)
    images = images_of({name: clip_of(skill, robot).joints for name, skill in skills.items()}, robot)
    images = np.where(images >= 0, len(MOTIONS) + images, -1)
    return Told(recording.told, clock, phrasings, np.concatenate([walks.mirrored, images]))


def _begun(recording: Recording) -> Array:
    """Rows `(rows,)` bool at which something else is told than before."""
    assert recording.told is not None
    return np.r_[True, (np.diff(recording.told) != 0) | (np.diff(recording.episode) != 0)]


def images_of(motions: Mapping[str, Array], robot: Robot) -> Array:
    """Which of some motions `(ticks, n_joints)` rad is the mirror image of each `(motions,)`; -1: none.

    It is the one of the other side, or the motion itself, and so by how it moves: a wave of the right hand is not told
    as one of the left.
    """
    mirror, names = Mirror.joints(robot), list(motions)
    found = np.full(len(names), -1)
    for i, name in enumerate(names):
        swap = {"left": "right", "right": "left"}
        image = "-".join(swap.get(part, part) for part in name.split("-"))
        if image not in motions:
            continue
        ticks = min(len(motions[name]), len(motions[image]))
        off = mirror(motions[name][:ticks]) - motions[image][:ticks]
        if np.sqrt(np.mean(off**2)) < MIRRORED:
            found[i] = names.index(image)
    return found

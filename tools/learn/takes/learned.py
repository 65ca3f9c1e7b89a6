"""What a planner learns from: windows of takes, as they were made and as trackers execute them."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import Robot
from servoid.policy.diffusion.prefix.dataset import PlanWindows, ToldSentences
from servoid.policy.diffusion.prefix.frames import Frames
from servoid.policy.motion.library import Library
from servoid.policy.recording import read_recording, source_of
from servoid.policy.text.captions import NAMES, motion_of
from servoid.policy.text.encoder import TextEncoder
from servoid.stack.control.fleet import Fleet
from servoid.stack.control.tracker import Followers
from servoid.stack.estimation.odometry import load_odometry
from servoid.tools.learn.planner_settings import PlannerTraining
from servoid.tools.learn.takes.aimed import Aim, AimedTake, load_aimed
from servoid.tools.learn.takes.executed import Executed, execute
from servoid.tools.learn.takes.maker import Take, TakeMaker, labels, sequences

WALKER = "expert"  # follows takes that walk, as in configs/policies/closd-joints.yaml
_EXECUTED = 2**30  # sets the worlds in which takes are executed apart from others of the same seed
_AIMED = 1  # and the places that are drawn


def learned_from(
    robot: Robot,
    frames: Frames,
    encoder: TextEncoder,
    settings: PlannerTraining,
    data: Path | None = None,
    tracker: str | None = None,
) -> tuple[PlanWindows, str, str]:
    """Windows of takes, what they come from, and its licence. Raises ConfigError."""
    library = Library(robot)
    clips = [library[name] for name in settings.clips or library.fitting]
    recipe = load_aimed(settings.aimed) if settings.aimed else None
    if recipe is not None and tracker is None:
        raise ConfigError("--aimed: a tracker says which places robots come to: name one with --tracker")
    captions = {} if recipe is None else recipe.captions
    told, maker = labels(clips, captions), TakeMaker(robot, clips, np.random.default_rng(settings.seed), captions)
    takes = [*maker.walks(settings.walk_takes, settings.walk_seconds), *maker.clips(settings.clip_takes)]
    made = sequences(takes, frames)
    source = f"{len(clips)} clips in {settings.clip_takes} takes, {settings.walk_takes} walks of the gait"
    licences = [settings.licence, *(clip.about.licence for clip in clips)]
    if tracker is not None:
        followed = executed_by(tracker, takes, frames, settings.seed)
        source += f", {len(followed)} of these takes as executed by {Path(tracker).name}"
        if recipe is not None:
            rng = np.random.default_rng([settings.seed, _AIMED])
            aimed = Aim(robot, recipe, maker, frames).takes(settings.aimed_takes, rng)
            done = came_to(aimed, executed_by(tracker, [each.take for each in aimed], frames, settings.seed), frames)
            for each in done:
                take = aimed[each.number].take
                made.add(frames, frames.motion(take.place, take.orientation, take.joints), take.label)
            followed += done
            source += f", {len(done)} of {len(aimed)} takes toward random places"
            licences.append(recipe.licence)
        for each in followed:
            take = each.take
            wanted = frames.motion(take.place, take.orientation, take.joints)
            made.add(frames, frames.of_states(each.raw), take.label, wanted)
    if data is not None:
        recording = read_recording(data, robot)
        source += f", {source_of(data, recording)}"
        for first, last in recording.spans:
            motion = frames.of_states(recording.raw[first:last])
            label = motion_of(recording.command[first:last], robot.walking.scale)
            made.add(frames, motion, label)
    sentences = ToldSentences(told, encoder, settings.words)
    windows = PlanWindows(made, frames, settings, sentences, settings.untold, NAMES.index("stand"), settings.root)
    return windows, source, " and ".join(dict.fromkeys(licences))


def executed_by(tracker: str, takes: Sequence[Take], frames: Frames, seed: int, worlds: int = 256) -> list[Executed]:
    """Takes as trackers execute them, so many at a time, as a closed loop does: the shipped expert where they walk.

    Raises CheckpointError where the tracker knows no clips.
    """
    robot, found = frames.robot, list[Executed]()
    for first in range(0, len(takes), worlds):
        part = takes[first : first + worlds]
        fleet = Fleet(robot, len(part), load_odometry(robot), randomise=0.5, seed=seed, tag=_EXECUTED + first)
        done = execute(part, fleet, Followers(robot, tracker, WALKER, (len(part),)), frames)
        found += [replace(each, number=first + each.number) for each in done]
    return found


def came_to(aimed: Sequence[AimedTake], executed: Sequence[Executed], frames: Frames) -> list[Executed]:
    """Those that brought their part to its place, and did not fall; says how many of each motion."""
    kept = [each for each in executed if aimed[each.number].met(each, frames)]
    of, came = Counter(each.name for each in aimed), Counter(aimed[each.number].name for each in kept)
    shares = ", ".join(f"{came[name]} of {count} {name}" for name, count in of.items())
    print(f"takes toward random places that robots come to: {shares}", file=sys.stderr)
    return kept

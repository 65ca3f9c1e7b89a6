"""What a dataset is recorded in: parts that do not depend on each other, each a fleet with a seed of its own.

Parts that are done wait in a `.parts` folder beside the dataset's, so that an interrupted recording goes on.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.control import Policy
from servoid.hw.robot.description import Robot, load_robot
from servoid.tools.learn.collect.disturbances import DisturbanceSettings
from servoid.tools.learn.collect.episode_cutter import Drilled, EpisodeCutter, RecordedEpisode
from servoid.tools.learn.collect.performances import Performances
from servoid.tools.learn.collect.skills import Commands


@dataclass(frozen=True)
class FleetRecipe:
    """How a fleet is recorded."""

    robot: str
    policy: str
    tracker: str
    skills: bool
    worlds: int
    seconds: float
    randomise: float
    noise: tuple[float, float]
    plain_odometry: bool
    threads: int
    crouched: float = 0.0
    style: str | None = None
    carry: bool = False
    velocity: tuple[float, float, float] | None = None  # that is asked all the time; None: those of the drills
    only: tuple[str, ...] = ()  # skills that are performed, without walks; none: all, and walks

    @property
    def disturbances(self) -> DisturbanceSettings:
        """Skills alone and carrying are shown undisturbed: nobody is pushed while it kicks, standing on a foot."""
        pushed = 0.0 if self.only or self.carry else DisturbanceSettings.pushed_share
        return DisturbanceSettings(scale=self.noise, pushed_share=pushed)

    def sources(self) -> dict[str, Any]:
        """Names, hashes and commits of the checkpoints that record. Raises ConfigError."""
        from servoid.policy.checkpoint import resolve

        robot = load_robot(self.robot)
        found: dict[str, Any] = {
            "policy": {"name": "gait"} if self.policy == "gait" else _source(resolve(self.policy, robot)),
            "odometry": {"name": "legs"} if self.plain_odometry else _source(resolve("odometry", robot)),
        }
        if self.style is not None:
            found["style"] = _style_source(self.style)
        return found | ({"tracker": _source(resolve(self.tracker, robot))} if self.skills else {})

    def performances(self, worlds: int) -> Performances | None:
        """What so many worlds are told, where they perform skills. Raises ConfigError."""
        from servoid.stack.skills.skill import UPRIGHT, chosen, load_skills, way

        if not self.skills:
            return None
        robot = load_robot(self.robot)
        known = load_skills(robot)
        skills = {name: skill for name, skill in known.items() if skill.alone}
        share = 0.7
        if self.only:
            skills, share = {name: chosen(name, skills) for name in self.only}, 1.0
            if not any(skill.entry == UPRIGHT for skill in skills.values()):
                raise ConfigError(f"--only {' '.join(self.only)}: none of them begins upright, as episodes do")
            for skill in skills.values():
                if skill.end != UPRIGHT:
                    way(skill.end, UPRIGHT, skills)
        return Performances(robot, skills, worlds, share, expert=self.policy, tracker=self.tracker)

    def cutter(self, seed: int) -> EpisodeCutter:
        """A fleet of that seed, to be recorded. Raises ConfigError."""
        from servoid.policy.references.style import load_style
        from servoid.sim.model import build
        from servoid.sim.worlds import Worlds
        from servoid.stack.control.carrier import Carrier
        from servoid.stack.control.fleet import Fleet
        from servoid.stack.control.styled import StyledExpert
        from servoid.stack.estimation.odometry import load_odometry
        from servoid.stack.tasks.learned.carry import Carry
        from servoid.tools.learn.collect.carrying import Carrying

        robot, shape, told = load_robot(self.robot), (self.worlds,), self.performances(self.worlds)
        policy: Policy
        script: Drilled | None = told
        count: int | Worlds = self.worlds
        if told is not None:
            policy = told
        elif self.carry:
            learned = _task_policy(self.policy, robot, shape, ("box",))
            policy, script = learned or Carrier(robot, shape, self.policy), Carrying(robot, self.worlds)
            model = build(robot, Carry(robot).scene)
            count = Worlds(robot, self.worlds, threads=self.threads, randomise=self.randomise, model=model)
        elif self.style is not None:
            policy = StyledExpert(robot, load_style(self.style, robot), self.policy, shape)
        else:
            policy = _walker(self.policy, robot, shape)
        odometry = None if self.plain_odometry else load_odometry(robot)
        fleet = Fleet(robot, count, odometry, randomise=self.randomise, seed=seed, threads=self.threads)
        script = script or Commands(robot, self.worlds, self.crouched, self.velocity)
        return EpisodeCutter(fleet, policy, self.disturbances, self.seconds, script)


@dataclass(frozen=True)
class Part:
    number: int
    seed: int
    frames: int  # at least
    how: FleetRecipe


@dataclass
class RecordingTally:
    """Episodes that began and that fell, and ticks that were walked."""

    begun: int = 0
    fell: int = 0
    walked: int = 0

    def add(self, begun: int, fell: int, walked: int) -> None:
        self.begun, self.fell, self.walked = self.begun + begun, self.fell + fell, self.walked + walked


@dataclass(frozen=True)
class RecordedPart:
    number: int
    episodes: list[RecordedEpisode]
    tally: RecordingTally = field(default_factory=RecordingTally)


def record(part: Part) -> RecordedPart:
    """Record a part in this process. Raises ConfigError."""
    cutter = part.how.cutter(part.seed)
    episodes = list(cutter.episodes(part.frames))
    return RecordedPart(part.number, episodes, RecordingTally(cutter.begun, cutter.fell, cutter.walked))


def what_records(how: FleetRecipe) -> dict[str, Any]:
    """By names, what must be the same wherever parts are recorded. Raises ConfigError."""
    from servoid.stack.log.provenance import fingerprint
    from servoid.tools.common.cluster.installed import installed

    return {**installed(), f"robot {how.robot}": fingerprint(load_robot(how.robot)), **how.sources()}


class KeptParts:
    """Parts that are done, in a folder beside the dataset's."""

    def __init__(self, out: Path, made_of: Mapping[str, Any]) -> None:
        """Raises ConfigError where the folder holds parts that were made of something else."""
        self.folder = out.with_name(out.name + ".parts")
        self._description = self.folder / "made_of.json"
        text = json.dumps(made_of, sort_keys=True)
        try:
            if self._description.is_file():
                before, now = json.loads(self._description.read_text()), json.loads(text)
                if others := [name for name in {**now, **before} if before.get(name) != now.get(name)]:
                    raise ConfigError(
                        f"{self.folder}: holds parts that were recorded with others of these: {', '.join(others)}; "
                        "go on as before, or remove that folder"
                    )
            else:
                self.folder.mkdir(parents=True, exist_ok=True)
                self._description.write_text(text)
        except (OSError, ValueError) as error:
            raise ConfigError(f"{self.folder}: parts cannot be kept there ({error})") from None

    def has(self, number: int) -> bool:
        return self._path(number).is_file()

    def add(self, part: RecordedPart) -> None:
        """Whole or not at all. Raises ConfigError."""
        arrays: dict[str, Any] = {
            f"{i}/{name}": values
            for i, episode in enumerate(part.episodes)
            for name, values in {**episode.columns, "": episode.skill}.items()
        }
        path = self._path(part.number)
        half = path.with_name(f"half-{path.name}")
        counts = np.array([part.tally.begun, part.tally.fell, part.tally.walked, len(part.episodes)])
        try:
            np.savez(half, counts=counts, **arrays)
            os.replace(half, path)
        except OSError as error:
            raise ConfigError(f"{path}: cannot be written ({error.strerror}): what was done before is kept") from None

    def get(self, number: int) -> RecordedPart:
        with np.load(self._path(number)) as kept:
            begun, fell, walked, count = map(int, kept["counts"])
            episodes: list[dict[str, Any]] = [{} for _ in range(count)]
            for key in kept.files:
                at, slash, name = key.partition("/")
                if slash:
                    episodes[int(at)][name] = kept[key]
        found = [RecordedEpisode({n: v for n, v in one.items() if n}, one[""]) for one in episodes]
        return RecordedPart(number, found, RecordingTally(begun, fell, walked))

    def remove(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, number: int) -> Path:
        return self.folder / f"part-{number:03d}.npz"


def recorded(
    part: Part, tally: RecordingTally, progress: Callable[[int, RecordingTally], None]
) -> Iterator[RecordedEpisode]:
    """Episodes of a part as they end, without keeping them; `progress` is told frames and what was walked so far."""
    cutter = part.how.cutter(part.seed)

    def told(frames: int) -> None:
        progress(frames, RecordingTally(cutter.begun, cutter.fell, cutter.walked))

    yield from cutter.episodes(part.frames, told)
    tally.add(cutter.begun, cutter.fell, cutter.walked)


def _walker(name: str, robot: Robot, shape: tuple[int, ...]) -> Policy:
    """The gait, a tracker of it, or a task policy that is asked a velocity. Raises ConfigError."""
    from servoid.stack.control.gait import GaitPolicy
    from servoid.stack.control.tracker import ExpertPolicy

    if name == "gait":
        return GaitPolicy(robot, shape)
    return _task_policy(name, robot, shape, ("velocity", "steering")) or ExpertPolicy(robot, name, shape)


def _task_policy(name: str, robot: Robot, shape: tuple[int, ...], goals: tuple[str, ...]) -> Policy | None:
    """A task policy that sees one of these goals; None for a checkpoint of another kind. Raises ConfigError for one
    that sees something else."""
    from servoid.policy.checkpoint import read_header, resolve
    from servoid.policy.priors.task_policy import KIND, TaskPolicy

    path = resolve(name, robot)
    if read_header(path)["kind"] != KIND:
        return None
    policy = TaskPolicy(robot, path, shape)
    if policy.goal not in goals:
        raise ConfigError(f"--policy {name}: is asked for a {policy.goal}, and what is collected asks for {goals[0]}")
    return policy


def _style_source(name: str) -> dict[str, str]:
    """Raises ConfigError."""
    from servoid.hw.config import resolve

    path = resolve("styles", name)
    return {"name": path.stem, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}


def _source(path: Path) -> dict[str, str]:
    from servoid.policy.checkpoint import read_header

    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return {"name": path.stem, "sha256": digest, "git_commit": str(read_header(path)["git_commit"])}

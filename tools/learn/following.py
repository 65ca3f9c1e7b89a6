"""How many sentences a diffusion model follows, in many worlds at once: walks and skills, changed in mid motion.

`python -m servoid.tools.learn.following CHECKPOINT WORLDS SECONDS` prints it by what was asked for.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction
from servoid.hw.contracts.task import Trace
from servoid.hw.robot.description import Robot, load_robot
from servoid.policy.text.captions import MOTIONS, NAMES
from servoid.sim.truth import FALL_TILT
from servoid.tools.learn.progress import counted
from servoid.tools.learn.survival import measured_fleet

EVERY = 4.0  # s between sentences


@dataclass
class Followed:
    """Sentences by what they ask for, those that were followed, and those in which the robot fell."""

    asked: dict[str, int] = field(default_factory=dict)
    done: dict[str, int] = field(default_factory=dict)
    fell: dict[str, int] = field(default_factory=dict)

    def count(self, motion: int | str, done: bool, fell: bool) -> None:
        name = NAMES[motion] if isinstance(motion, int) else motion
        for tally, by in ((self.asked, 1), (self.done, int(done)), (self.fell, int(fell))):
            tally[name] = tally.get(name, 0) + by

    def share(self, names: Mapping[str, object] | None = None) -> float:
        """Of all sentences, or of those that ask for one of `names`."""
        chosen = [name for name in self.asked if names is None or name in names]
        asked = sum(self.asked[name] for name in chosen)
        return sum(self.done[name] for name in chosen) / asked if asked else float("nan")


def sentences_followed(
    checkpoint: Path, seconds: float, worlds: int, seed: int, robot_name: str = "op3"
) -> dict[str, float]:
    """Tell a checkpoint that knows skills something else every 4 s in `worlds` worlds, half of them drawn at random.

    Returns the share `followed`, that of walks and skills, and `survival`, the share of sentences without a fall.
    """
    robot = load_robot(robot_name)
    found = follow(checkpoint, robot, seconds, worlds, seed)
    total = sum(found.asked.values())
    return {
        "followed": found.share(),
        "followed_walks": found.share(dict.fromkeys(NAMES)),
        "followed_skills": found.share({name: 0 for name in found.asked if name not in NAMES}),
        "survival": 1.0 - sum(found.fell.values()) / total,
    }


def follow(checkpoint: Path, robot: Robot, seconds: float, worlds: int, seed: int) -> Followed:
    """See `sentences_followed`. A world that falls begins anew, standing, with the next sentence."""
    from servoid.policy.checkpoint import read_header
    from servoid.policy.diffusion.model.config import check_fit
    from servoid.policy.diffusion.settings import load_settings
    from servoid.policy.text.encoder import load_encoder
    from servoid.stack.control.diffusion import diffusion_policy
    from servoid.stack.skills.telling import Teller
    from servoid.stack.skills.words import SkillWords
    from servoid.stack.tasks import load_task
    from servoid.stack.tasks.text import Text

    head = read_header(checkpoint)
    settings = load_settings("skills").fitted(check_fit(checkpoint, head, robot), head["training"])
    settings = replace(settings, checkpoint=str(checkpoint))
    policy = diffusion_policy(robot, settings, None, shape=(worlds,))
    wanted = {"about": "both", "every": str(EVERY), "seconds": str(seconds), "phrasings": "training"}
    task = load_task("text", wanted, robot.dt, robot)
    assert isinstance(task, Text)
    known = {name: task.skills[name] for name in head["skills"]}
    fleet = measured_fleet(robot, worlds, seed)
    fleet.reset(np.ones(worlds, bool))
    policy.reset(None, fleet.seeds)
    episodes = [task.scenario(rng) for rng in fleet.rngs]
    words = SkillWords(load_encoder(), known)
    phrases = {name: words.clearest(name) for name in known}
    tellers = [Teller(known, robot.dt) for _ in range(worlds)]
    every, found = round(EVERY * robot.rate), Followed()
    rows: list[tuple[Array, ...]] = []
    fell = np.zeros(worlds, bool)
    for tick in counted(len(episodes[0].motions) * every, "following"):
        number = tick // every
        for i, teller in enumerate(tellers):
            teller.tell(episodes[i].motions[number])
        told = tuple(MOTIONS[t.now].phrasings[0] if isinstance(t.now, int) else phrases[t.now] for t in tellers)
        since = np.array([teller.since for teller in tellers])
        state = fleet.observe()
        fleet.step(policy.act(state, fleet.applied, Instruction(np.zeros(3), texts=told, since=since)))
        truth = fleet.truth
        rate = -np.einsum("ij,ij->i", truth.gravity, truth.angular_velocity)
        rows.append((truth.joints.copy(), truth.velocity.copy(), rate))
        low = np.array([isinstance(t.now, str) and known[t.now].low for t in tellers])
        down = np.where(low, -truth.gravity[:, 2] < np.cos(FALL_TILT), truth.fallen)
        if down.any():
            fell |= down
            fleet.reset(down)
            policy.reset(down, fleet.seeds)
            for i in np.flatnonzero(down).tolist():
                tellers[i] = Teller(known, robot.dt)
        if (tick + 1) % every == 0:
            for i in range(worlds):
                joints, velocity, rates = (np.array([row[k][i] for row in rows]) for k in range(3))
                none = np.zeros((every, 3))
                trace = Trace(robot.dt, none, np.zeros(every), velocity, rates, none, False, joints=joints)
                motion = episodes[i].motions[number]
                found.count(motion, not fell[i] and all(task.verdicts(trace, [motion])), bool(fell[i]))
            rows, fell = [], np.zeros(worlds, bool)
    return found


def _print(found: Followed) -> None:
    for name in sorted(found.asked):
        print(f"{name:20s} {found.done[name]:3d} of {found.asked[name]:3d} followed, fell in {found.fell[name]}")
    walks = dict.fromkeys(NAMES)
    skills = {name: 0 for name in found.asked if name not in walks}
    fell, asked = sum(found.fell.values()), sum(found.asked.values())
    shares = (found.share(), found.share(walks), found.share(skills))
    print("followed {:.3f}, walks {:.3f}, skills {:.3f}".format(*shares) + f"; fell in {fell} of {asked}")


if __name__ == "__main__":
    _print(follow(Path(sys.argv[1]), load_robot(), float(sys.argv[3]), int(sys.argv[2]), 1))

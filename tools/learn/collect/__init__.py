"""Record demonstrations of the expert in simulation as a LeRobot v3.0 dataset.

Every world walks and stands under commands that change every few seconds, with pushes and with noise on its actions;
the labels are the expert's actions without the noise. An episode that ends in a fall loses its last second. Mirrored
copies are not stored, because training mirrors each window as it reads it: the same as twice the data.

With `--skills` the worlds also perform the skills of configs/skills that take nothing but the ground, each for as many
ticks, and go from any of them to any other and to walking, some in mid motion. Each tick says what was told, and how
long a skill has lasted: what a model learns from that follows sentences about skills.

The same options and the same seed make the same files.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError
from servoid.tools.common import exit_codes
from servoid.tools.common.folder_lock import locked
from servoid.tools.common.output import add_json_argument, reporting
from servoid.tools.common.parser import positive

if TYPE_CHECKING:
    from servoid.hw.robot.description import Robot
    from servoid.tools.learn.collect.disturbances import DisturbanceSettings
    from servoid.tools.learn.collect.episode_cutter import EpisodeCutter
    from servoid.tools.learn.collect.performances import Performances
    from servoid.tools.learn.dataset.schema import Feature

LICENCE = "Apache-2.0"
MIRRORING = "applied when read (servoid.policy.diffusion.dataset): each window also serves with left and right swapped"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the dataset")
    parser.add_argument(
        "--frames", type=int, default=500_000, metavar="N", help="least number of ticks to keep (default: %(default)s)"
    )
    parser.add_argument(
        "--worlds", type=int, default=256, metavar="N", help="robots side by side (default: %(default)s)"
    )
    parser.add_argument(
        "--policy",
        default="expert",
        metavar="NAME|FILE",
        help="expert, gait or a tracker's checkpoint (default: expert)",
    )
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    parser.add_argument("--skills", action="store_true", help="perform skills, too, by their tracker")
    parser.add_argument(
        "--tracker", default="tracker", metavar="NAME|FILE", help="tracker that performs skills (default: tracker)"
    )
    parser.add_argument(
        "--seconds", type=positive, default=15.0, metavar="S", help="length of an episode (default: %(default)g)"
    )
    parser.add_argument(
        "--randomise",
        type=float,
        default=0.4,
        metavar="SHARE",
        help="share of episodes on a randomised robot (default: %(default)s)",
    )
    parser.add_argument(
        "--noise",
        type=float,
        nargs=2,
        default=[0.2, 0.6],
        metavar=("LOW", "HIGH"),
        help="range of the scale of an episode's action noise (default: 0.2 0.6)",
    )
    parser.add_argument(
        "--plain-odometry", action="store_true", help="estimate without the learned correction of odometry"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: 0)")
    parser.add_argument(
        "--threads", type=int, default=0, metavar="N", help="threads of the simulation (default: all cores)"
    )
    parser.add_argument("--force", action="store_true", help="replace an existing dataset")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Collect; returns 0. Raises ConfigError."""
    with reporting(args.json) as report:
        _check(args)
        result = collect(args)
        share, minutes = result["fell_share"], result["walked_minutes"]
        report.line(
            f"{args.out}: {result['episodes']} episodes, {result['frames']} frames; {100 * share:.1f} % of "
            f"{result['begun']} episodes fell ({minutes:.0f} minutes walked), {result['seconds']:.0f} s"
        )
        if not 0.05 <= share <= 0.25 and minutes > 60:  # less walking says little
            report.line("5 to 25 % is wanted, enough to learn recovery from: change --noise")
        report.result(result)
    return exit_codes.DONE


def _check(args: argparse.Namespace) -> None:
    for name in ("frames", "worlds"):
        if getattr(args, name) < 1:
            raise ConfigError(f"--{name} must be at least 1, not {getattr(args, name)}")
    if not 0.0 <= args.randomise <= 1.0:
        raise ConfigError(f"--randomise must be between 0 and 1, not {args.randomise:g}")
    if not 0.0 <= args.noise[0] <= args.noise[1] < math.inf:
        raise ConfigError(f"--noise {args.noise[0]:g} {args.noise[1]:g}: must not be negative, the lower one first")
    if args.skills and args.policy == "gait":
        raise ConfigError("--skills goes with --policy expert or a tracker: the gait cannot walk on from a skill")
    if args.seed < 0:
        raise ConfigError(f"--seed must not be negative, not {args.seed}")


def collect(args: argparse.Namespace) -> dict[str, Any]:
    """Record a dataset into `args.out`; returns what `--json` prints. Raises ConfigError."""
    from tqdm import tqdm

    from servoid.hw.contracts.control import Policy
    from servoid.hw.robot.description import load_robot
    from servoid.policy.checkpoint import resolve
    from servoid.stack.control.fleet import Fleet
    from servoid.stack.control.gait import GaitPolicy
    from servoid.stack.control.tracker import ExpertPolicy
    from servoid.stack.estimation.odometry import load_odometry
    from servoid.stack.skills.skill import load_skills
    from servoid.tools.learn.collect.disturbances import DisturbanceSettings
    from servoid.tools.learn.collect.episode_cutter import EpisodeCutter
    from servoid.tools.learn.collect.performances import Performances
    from servoid.tools.learn.collect.skills import SKILLS
    from servoid.tools.learn.dataset.lerobot import DatasetWriter
    from servoid.tools.learn.dataset.schema import Schema

    begin = time.perf_counter()
    robot = load_robot(args.robot)
    shape = (args.worlds,)
    policy: Policy
    performances = None
    if args.skills:
        skills = {name: skill for name, skill in load_skills(robot).items() if skill.alone}
        policy = performances = Performances(robot, skills, args.worlds, expert=args.policy, tracker=args.tracker)
    else:
        policy = GaitPolicy(robot, shape) if args.policy == "gait" else ExpertPolicy(robot, args.policy, shape)
    odometry = None if args.plain_odometry else load_odometry(robot)
    sources = {
        "policy": {"name": "gait"} if args.policy == "gait" else _source(resolve(args.policy, robot)),
        "odometry": {"name": "legs"} if odometry is None else _source(resolve("odometry", robot)),
    }
    if performances is not None:
        sources["tracker"] = _source(resolve(args.tracker, robot))
    settings = DisturbanceSettings(scale=(args.noise[0], args.noise[1]))
    texts = tuple(skill.text for skill in SKILLS) if performances is None else performances.texts
    schema = Schema(robot.name, robot.rate, _features(robot, performances), texts)
    with locked(args.out), DatasetWriter(args.out, schema, args.force) as writer:
        fleet = Fleet(robot, args.worlds, odometry, randomise=args.randomise, seed=args.seed, threads=args.threads)
        cutter = EpisodeCutter(fleet, policy, settings, args.seconds, performances)
        with tqdm(total=args.frames, desc="walking", unit="frame", mininterval=1.0) as bar:

            def progress(total: int) -> None:
                bar.update(min(total, args.frames) - bar.n)
                bar.set_postfix_str(f"{cutter.fell} of {cutter.begun} fell", refresh=False)

            for episode in cutter.episodes(args.frames, progress):
                writer.add(episode.columns, episode.skill)
        result = {
            "episodes": writer.episodes,
            "frames": writer.frames,
            "begun": cutter.begun,
            "fell": cutter.fell,
            "fell_share": round(cutter.fell / cutter.begun, 4),
            "walked_minutes": round(cutter.walked * robot.dt / 60, 2),
        }
        writer.finish({"servoid.yaml": _provenance(args, robot, cutter, settings, sources, result)})
    return result | {"out": str(args.out), "seconds": round(time.perf_counter() - begin, 1)}


def _features(robot: Robot, performances: Performances | None = None) -> dict[str, Feature]:
    """The dataset's columns and the names of their numbers."""
    from servoid.policy.features import recorded_names
    from servoid.policy.recording import CLOCK, SKILLS_NOTE
    from servoid.tools.learn.dataset.schema import Feature

    notes = {
        "observation.state": {"mirroring": MIRRORING},
        "action": {"meaning": "the expert's joint targets after the limits, rad"},
        "action_applied": {"meaning": "the joint targets that ran, with noise, rad"},
        "command": {"meaning": "the velocity asked for, m/s and rad/s"},
    }
    found = {name: Feature(names, notes[name]) for name, names in recorded_names(robot).items()}
    if performances is not None:
        about = {
            "meaning": "time since the skill began that is told, s; 0 of a walk",
            SKILLS_NOTE: ", ".join(performances.names),
        }
        found[CLOCK] = Feature(("seconds",), about)
    return found


def _source(path: Path) -> dict[str, str]:
    from servoid.policy.checkpoint import read_header

    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return {"name": path.stem, "sha256": digest, "git_commit": str(read_header(path)["git_commit"])}


def _provenance(
    args: argparse.Namespace,
    robot: Robot,
    cutter: EpisodeCutter,
    settings: DisturbanceSettings,
    sources: Mapping[str, Any],
    result: Mapping[str, Any],
) -> str:
    """meta/servoid.yaml: all that is needed to record the dataset again."""
    import mujoco
    import numpy as np
    import yaml

    from servoid.policy.checkpoint import git_commit
    from servoid.tools.learn.collect.episode_cutter import FALL_SECONDS, SHORTEST_SECONDS
    from servoid.tools.learn.collect.skills import skills_of

    def plain(values: Mapping[str, Any]) -> dict[str, Any]:
        return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}

    skills = skills_of(robot)
    options = {
        name: getattr(args, name) for name in ("frames", "worlds", "seconds", "randomise", "plain_odometry", "skills")
    }
    content = {
        "licence": LICENCE,
        "git_commit": git_commit(),
        "versions": {"mujoco": mujoco.__version__, "numpy": np.__version__},
        "robot": robot.name,
        "seed": args.seed,
        "options": options,
        **sources,
        "mirroring": MIRRORING,
        "episodes": {"ticks": cutter.ticks, "dropped_before_fall": FALL_SECONDS, "shortest": SHORTEST_SECONDS},
        "commands": {
            "segment_seconds": {skill.name: list(skill.seconds) for skill in skills},
            "skills": [
                {"name": s.name, "weight": s.weight, "boxes": [plain(asdict(box)) for box in s.boxes]} for s in skills
            ],
        },
        "disturbances": plain(asdict(settings)),
        "result": dict(result),
    }
    return yaml.safe_dump(content, sort_keys=False)

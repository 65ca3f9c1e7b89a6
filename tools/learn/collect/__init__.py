"""Record demonstrations of the expert in simulation as a LeRobot v3.0 dataset.

Every world walks and stands under commands that change every few seconds, with pushes and with noise on its actions;
the labels are the expert's actions without the noise. An episode that ends in a fall loses its last second. Mirrored
copies are not stored, because training mirrors each window as it reads it: the same as twice the data.

With `--crouched` a share of the commands asks for a walk lower than upright, by up to an eighth of the standing height:
what a planner learns from that passes under a bar.

With `--style` they walk in a style of configs/styles, arms spread or crouched, say: data for a motion prior that knows
styles (`servoid train prior`), one dataset for each in a folder of its name.

With `--skills` the worlds also perform the skills of configs/skills that take nothing but the ground, each for as many
ticks, and go from any of them to any other and to walking, some in mid motion; with `--only` those that it names. Each
tick says what was told, and how long a skill has lasted: what a model learns from that follows sentences about skills.

With `--carry` each world has a box on the ground, which a script picks up and brings to a place; each tick says where
both are: data for a prior of carrying.

The same options and the same seed make the same files. With --parts the frames come from so many recordings, each with
a seed of its own and done by itself: on the machines of a Ray cluster with --ray. Those that are done wait beside the
dataset, and after an interruption the same command goes on. --append adds what another seed records to a dataset.
"""

from __future__ import annotations

import argparse
import math
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError
from servoid.tools.common import exit_codes
from servoid.tools.common.cluster import add_ray_argument, workplace
from servoid.tools.common.folder_lock import locked
from servoid.tools.common.output import add_json_argument, reporting
from servoid.tools.common.parser import positive
from servoid.tools.common.worker_pool import each

if TYPE_CHECKING:
    from servoid.hw.robot.description import Robot
    from servoid.tools.learn.collect.parts import FleetRecipe, Part, RecordingTally
    from servoid.tools.learn.collect.performances import Performances
    from servoid.tools.learn.dataset.lerobot import DatasetWriter
    from servoid.tools.learn.dataset.schema import Feature


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
        help="expert, gait, or a checkpoint of a tracker or of a task policy (default: expert)",
    )
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    parser.add_argument("--skills", action="store_true", help="perform skills, too, by their tracker")
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="SKILL", help="with --skills: these, again and again, and no walks"
    )
    parser.add_argument(
        "--tracker", default="tracker", metavar="NAME|FILE", help="tracker that performs skills (default: tracker)"
    )
    parser.add_argument(
        "--crouched",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="share of the commands that ask for a walk lower than upright (default: 0)",
    )
    parser.add_argument(
        "--velocity",
        type=float,
        nargs=3,
        metavar=("FORWARD", "LEFT", "TURN"),
        help="ask for this all the time, m/s and rad/s (default: what changes every few seconds)",
    )
    parser.add_argument(
        "--style", metavar="NAME|FILE", help="walk in this style, of configs/styles (default: as the expert walks)"
    )
    parser.add_argument("--carry", action="store_true", help="pick up boxes and bring them, by a script")
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
    parser.add_argument(
        "--parts", type=int, default=1, metavar="N", help="recordings that make up the dataset (default: 1)"
    )
    parser.add_argument(
        "--workers", type=int, default=0, metavar="N", help="parts at once (default: 1, or the cores of a cluster)"
    )
    add_ray_argument(parser)
    parser.add_argument("--force", action="store_true", help="replace an existing dataset")
    parser.add_argument("--append", action="store_true", help="add to an existing dataset")
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
    for name in ("frames", "worlds", "parts"):
        if getattr(args, name) < 1:
            raise ConfigError(f"--{name} must be at least 1, not {getattr(args, name)}")
    for name in ("randomise", "crouched"):
        if not 0.0 <= getattr(args, name) <= 1.0:
            raise ConfigError(f"--{name} must be between 0 and 1, not {getattr(args, name):g}")
    if args.crouched and args.skills:
        raise ConfigError("--crouched does not go with --skills, which are begun from walks upright: drop one of them")
    if not 0.0 <= args.noise[0] <= args.noise[1] < math.inf:
        raise ConfigError(f"--noise {args.noise[0]:g} {args.noise[1]:g}: must not be negative, the lower one first")
    if args.style is not None and (args.skills or args.crouched or args.policy == "gait"):
        raise ConfigError("--style is how the expert walks upright: drop --skills, --crouched or --policy gait")
    if args.carry and (args.skills or args.crouched or args.style is not None or args.policy == "gait"):
        raise ConfigError("--carry is what a script does: drop --skills, --crouched, --style or --policy gait")
    if args.velocity is not None and (args.skills or args.crouched or args.carry):
        raise ConfigError("--velocity is of walks alone: drop --skills, --crouched or --carry")
    if args.only and not args.skills:
        raise ConfigError("--only names skills to perform: give --skills, too")
    if args.skills and args.policy == "gait":
        raise ConfigError("--skills goes with --policy expert or a tracker: the gait cannot walk on from a skill")
    if args.workers < 0:
        raise ConfigError(f"--workers must not be negative, not {args.workers}")
    if args.ray is not None and args.parts < 2:
        raise ConfigError("--ray: one part has nothing to be spread: say in how many with --parts")
    if args.append and args.force:
        raise ConfigError("--append keeps what --force would replace: drop one of them")
    if args.seed < 0:
        raise ConfigError(f"--seed must not be negative, not {args.seed}")


def collect(args: argparse.Namespace) -> dict[str, Any]:
    """Record a dataset into `args.out`; returns what `--json` prints. Raises ConfigError."""
    from servoid.hw.robot.description import load_robot
    from servoid.tools.learn.collect.parts import FleetRecipe, RecordingTally
    from servoid.tools.learn.collect.provenance import SOURCES, earlier, provenance
    from servoid.tools.learn.collect.skills import SKILLS
    from servoid.tools.learn.dataset.lerobot import DatasetWriter
    from servoid.tools.learn.dataset.schema import Schema

    begin = time.perf_counter()
    robot = load_robot(args.robot)
    how = FleetRecipe(
        robot=args.robot,
        policy=args.policy,
        tracker=args.tracker,
        skills=args.skills,
        worlds=args.worlds,
        seconds=args.seconds,
        randomise=args.randomise,
        noise=(args.noise[0], args.noise[1]),
        plain_odometry=args.plain_odometry,
        crouched=args.crouched,
        style=args.style,
        only=tuple(args.only),
        carry=args.carry,
        velocity=None if args.velocity is None else (args.velocity[0], args.velocity[1], args.velocity[2]),
        threads=args.threads or (1 if args.workers > 1 or args.ray is not None else 0),
    )
    performances, tally = how.performances(1), RecordingTally()
    texts = tuple(skill.text for skill in SKILLS) if performances is None else performances.texts
    schema = Schema(robot.name, robot.rate, _features(robot, performances, args.carry), texts)
    with locked(args.out), DatasetWriter(args.out, schema, args.force, args.append) as writer:
        before = earlier(args, how)
        episodes, frames = writer.episodes, writer.frames
        if args.parts == 1:
            _record_one(args, how, writer, tally)
        else:
            _record_parts(args, how, writer, tally)
        result = {
            "episodes": writer.episodes - episodes,
            "frames": writer.frames - frames,
            "begun": tally.begun,
            "fell": tally.fell,
            "fell_share": round(tally.fell / tally.begun, 4),
            "walked_minutes": round(tally.walked * robot.dt / 60, 2),
        }
        writer.finish({SOURCES: provenance(args, robot, how, result, before)})
    return result | {"out": str(args.out), "seconds": round(time.perf_counter() - begin, 1)}


def _record_one(args: argparse.Namespace, how: FleetRecipe, writer: DatasetWriter, tally: RecordingTally) -> None:
    from tqdm import tqdm

    from servoid.tools.learn.collect.parts import Part, recorded

    with tqdm(total=args.frames, desc="walking", unit="frame", mininterval=1.0) as bar:

        def progress(total: int, walked: RecordingTally) -> None:
            bar.update(min(total, args.frames) - bar.n)
            bar.set_postfix_str(f"{walked.fell} of {walked.begun} fell", refresh=False)

        for episode in recorded(Part(0, args.seed, args.frames, how), tally, progress):
            writer.add(episode.columns, episode.skill)


def _record_parts(args: argparse.Namespace, how: FleetRecipe, writer: DatasetWriter, tally: RecordingTally) -> None:
    """On processes or machines, each part kept as it is done; then all of them, in order."""
    from tqdm import tqdm

    from servoid.tools.learn.collect.parts import KeptParts, record, what_records

    parts = _parts(args, how)
    made_of = {**what_records(how), "options": [args.seed, args.frames, args.parts, repr(how)]}
    kept = KeptParts(args.out, made_of)
    lacking = [part for part in parts if not kept.has(part.number)]
    if lacking:
        with (
            workplace(args.ray, partial(what_records, how), tqdm.write) as place,
            tqdm(total=args.parts, initial=args.parts - len(lacking), desc="recording", unit="part") as bar,
        ):
            workers = args.workers or (1 if place.here else place.size)
            for done in each(record, lacking, min(workers, len(lacking)), place=place):
                kept.add(done)
                bar.update()
    for part in parts:
        found = kept.get(part.number)
        tally.add(found.tally.begun, found.tally.fell, found.tally.walked)
        for episode in found.episodes:
            writer.add(episode.columns, episode.skill)
    kept.remove()


def _parts(args: argparse.Namespace, how: FleetRecipe) -> list[Part]:
    from servoid.hw.seeds import episode_seed
    from servoid.tools.learn.collect.parts import Part

    frames = math.ceil(args.frames / args.parts)
    return [Part(number, episode_seed(args.seed, number), frames, how) for number in range(args.parts)]


def _features(robot: Robot, performances: Performances | None = None, carry: bool = False) -> dict[str, Feature]:
    """The dataset's columns and the names of their numbers."""
    from servoid.policy.features import recorded_names
    from servoid.policy.recording import BOX, BOX_NAMES, CLOCK, PLACE, PLACE_NAMES, SKILLS_NOTE
    from servoid.tools.learn.collect.provenance import MIRRORING
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
    if carry:
        found[BOX] = Feature(BOX_NAMES, {"meaning": "pose of the box, heading frame from below the base, m"})
        found[PLACE] = Feature(PLACE_NAMES, {"meaning": "where the box shall be, heading frame from the base, m"})
    return found

"""The return of a robot with no body in tasks that policies learn: what the limits of the real one leave to be reached.

It glides as it is told, no faster than the robot is said to walk, forward, backward, sideways and around; then it also
gains speed no faster than the gait does; and then it also hears what is asked a step late, since a foot in the air
lands where it was going. What it walks by is what a policy is judged by: places, averaged over a cycle.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import TYPE_CHECKING

from servoid.tools.common.output import add_json_argument, reporting

if TYPE_CHECKING:
    from servoid.hw.contracts.body import Array
    from servoid.stack.tasks.learned import LearnedTask

TASKS = ("speed", "steering", "location", "dodgeball")
_QUICK = 1e6  # m/s2 and rad/s2 of what gains speed at once


@dataclass(frozen=True)
class Ideal:
    """How quick it is."""

    gains: tuple[float, float] = (_QUICK, _QUICK)  # m/s2 and rad/s2
    late: float = 0.0  # s


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    parser.add_argument("--episodes", type=int, default=400, metavar="N", help="episodes (default: %(default)s)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Print the returns; returns 0. Raises ConfigError."""
    from servoid.hw.robot.description import load_robot
    from servoid.policy.references.gait import gait_of
    from servoid.stack.tasks.learned import load_learned_task

    robot = load_robot(args.robot)
    gait = gait_of(robot)
    gains, step = (gait.acceleration[0], gait.acceleration[2]), gait.cycle / 2.0
    kinds = {"speeds": Ideal(), "speeds, gains": Ideal(gains), "speeds, gains, a step late": Ideal(gains, step)}
    seconds = {"location": 20.0, "dodgeball": 20.0}
    with reporting(args.json) as report:
        found = {
            name: [
                ideal_return(load_learned_task(name, robot), kind, args.episodes, seconds.get(name, 10.5))
                for kind in kinds.values()
            ]
            for name in TASKS
        }
        report.table(["return within", *kinds], [[name, *(f"{x:.3f}" for x in row)] for name, row in found.items()])
        report.result({name: dict(zip(kinds, row, strict=True)) for name, row in found.items()})
    return 0


def ideal_return(task: LearnedTask, ideal: Ideal, n: int, seconds: float, seed: int = 0) -> float:
    """Mean reward over `n` episodes of so many seconds, from standing."""
    import numpy as np

    from servoid.hw.geometry import turned
    from servoid.policy.references.gait import gait_of
    from servoid.stack.tasks.learned import TaskState

    walking, dt, rng = task.robot.walking, 2.0 * task.robot.dt, np.random.default_rng(seed)
    cycle = round(gait_of(task.robot).cycle / dt)
    place, yaw, velocity, turning = np.zeros((n, 2)), np.zeros(n), np.zeros((n, 2)), np.zeros(n)
    asked, heard, since, due = (np.zeros((n, task.size)), np.zeros((n, task.size)), np.zeros(n), np.zeros(n))
    listens, over, places, earned = np.zeros(n, bool), np.zeros(n, bool), np.zeros((cycle + 1, n, 2)), []
    for tick in range(round(seconds / dt)):
        for i in np.flatnonzero(tick * dt >= due):
            asked[i] = task.draw(rng, place[i])
            due[i], since[i] = tick * dt + rng.uniform(*task.every), 0.0
        listens |= since >= ideal.late
        heard = np.where((since >= ideal.late)[:, None], asked, heard)
        since += dt
        wanted, off = _wanted(task, heard, place, yaw)
        wanted, off = np.where(listens[:, None], wanted, 0.0), np.where(listens, off, 0.0)
        gain, around = ideal.gains
        brakes = np.minimum(np.sqrt(2.0 * around * np.abs(off)), np.abs(off) / dt)  # so as to stop there
        turn = np.sign(off) * np.minimum(brakes, walking.turning)
        turning = turning + np.clip(turn - turning, -around * dt, around * dt)
        yaw = yaw + turning * dt
        body = turned(wanted, -yaw)
        ahead = np.where(body[:, 0] > 0.0, walking.forward, walking.backward)
        faster = np.maximum(np.hypot(body[:, 0] / ahead, body[:, 1] / walking.sideways), 1.0)  # than an ellipse has it
        change = wanted / faster[:, None] - velocity
        size = np.maximum(np.linalg.norm(change, axis=-1, keepdims=True), 1e-9)
        velocity = velocity + change * np.minimum(1.0, gain * dt / size)
        place = place + velocity * dt
        places = np.concatenate([place[None], places[:-1]])
        mean, height, nothing = (places[0] - places[-1]) / (cycle * dt), np.zeros(n), np.zeros((n, 3))
        state = TaskState(place, yaw, mean, height, nothing, nothing, nothing, nothing)
        asked, heard = task.advance(asked, dt), task.advance(heard, dt)
        over |= task.ended(asked, state)
        earned.append(task.reward(asked, state) * ~over)
    return float(np.mean(earned))


def _wanted(task: LearnedTask, asked: Array, place: Array, yaw: Array) -> tuple[Array, Array]:
    """The velocity over the ground `(n, 2)` m/s, and by how much to turn `(n,)` rad, as a policy is told."""
    import numpy as np

    from servoid.hw.contracts.control import State
    from servoid.hw.geometry import turned

    n, nothing = len(yaw), np.zeros((len(yaw), 3))
    known = State(0, nothing, nothing, yaw, nothing, nothing, np.c_[place, np.zeros(n)], nothing, nothing, nothing)
    seen = task.seen.observe(task.instruct(asked, known), task.robot.walking)
    off = -yaw if seen.shape[1] < 4 else np.arctan2(seen[:, 3], seen[:, 2])
    return turned(seen[:, :2], yaw) * task.robot.walking.forward, (off + np.pi) % (2.0 * np.pi) - np.pi

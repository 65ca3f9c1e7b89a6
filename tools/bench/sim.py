"""Compare the speed of the batched training world with raw MuJoCo, in turn in one run, on all cores.

The training world is all that the learner waits for: physics, sensors, estimator, reference, limits, rewards, resets.
Raw is MuJoCo's own batch, from the same states and controls.
"""

from __future__ import annotations

import argparse
import os
import time

from servoid.tools.common.output import add_json_argument, reporting


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    parser.add_argument(
        "--worlds", type=int, default=512, metavar="N", help="robots side by side (default: %(default)s)"
    )
    parser.add_argument("--ticks", type=int, default=100, metavar="N", help="ticks to time (default: %(default)s)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # as in training: the worlds use the cores
    with reporting(args.json) as report:
        result = measure(args.robot, args.worlds, args.ticks)
        report.table(["figure", "value"], [[key, f"{value:.4g}"] for key, value in result.items()])
        report.result(result)
    return 0


def measure(robot_name: str, worlds: int, ticks: int) -> dict[str, float]:
    """Control steps a second of both, all worlds counted. Actions are those of an untrained policy."""
    import numpy as np
    from mujoco.batch import Batch

    from servoid.hw.robot.description import load_robot
    from servoid.policy.checkpoint import CheckpointError
    from servoid.stack.estimation.odometry import load_odometry
    from servoid.tools.learn.envs.tracking import Tracking
    from servoid.tools.learn.settings import TrackingSettings

    robot = load_robot(robot_name)
    try:
        odometry = load_odometry(robot)
    except CheckpointError:
        odometry = None  # a robot of the user's own, before its odometry is learned
    env = Tracking(robot, worlds, odometry, TrackingSettings())
    env.reset()
    source = env.fleet.worlds
    raw = Batch(source.model, worlds, 0)
    rng = np.random.default_rng(0)
    spent = {"training": 0.0, "raw": 0.0}
    for tick in range(10 + ticks):
        action = 0.2 * rng.standard_normal((worlds, len(robot.joints)))
        assert isinstance(source.batch, Batch)
        raw.state[:] = source.batch.state
        begun = time.perf_counter()
        env.step(action)
        middle = time.perf_counter()
        raw.ctrl = env.fleet.applied
        raw.step(nstep=source.substeps)
        if tick >= 10:  # the first ticks touch memory for the first time
            spent["training"] += middle - begun
            spent["raw"] += time.perf_counter() - middle
    steps = worlds * ticks
    return {
        "steps_per_s": steps / spent["training"],
        "raw_steps_per_s": steps / spent["raw"],
        "ratio": spent["raw"] / spent["training"],
        "worlds": worlds,
        "threads": raw.nthread,
    }

"""Clips followed by a tracker in physics, as a run would: its sensors, its estimator, its limits."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.world import Start
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import Clip
from servoid.policy.references.clip import ClipReference
from servoid.stack.control.fleet import Fleet
from servoid.stack.control.tracker import Tracker
from servoid.stack.estimation.odometry import load_odometry
from servoid.tools.motions.physics import CARRIES, HOLD_SECONDS, SETTLE_SECONDS, TURNS, Played

_TAG = 2**31 - 19  # no robot that is trained on is drawn from this stream


def follow(
    clip: Clip,
    robot: Robot,
    tracker: str,
    *,
    worlds: int = 1,
    randomise: float = 0.0,
    seed: int = 0,
    push: float = 0.0,
) -> Played:
    """Follow a clip in `worlds` worlds of their own robots, by the checkpoint `tracker`.

    Each is put down as the clip begins and settles in its first pose. Once a second its base is pushed by up to
    `push` [m/s], anywhere. Raises CheckpointError where the tracker does not fit.
    """
    fleet = Fleet(robot, worlds, load_odometry(robot), randomise=randomise, seed=seed, tag=_TAG, threads=1)
    policy = Tracker(robot, tracker, (worlds,), clips=True)
    reference = ClipReference(robot, [clip], (worlds,))
    first = np.tile(clip.joints[0], (worlds, 1))
    turn = np.tile(TURNS[clip.about.begins], (worlds, 1)) if clip.about.begins in TURNS else None
    fleet.reset(np.ones(worlds, bool), Start(joints=first, orientation=turn))
    for _ in range(round(SETTLE_SECONDS * robot.rate)):
        fleet.observe()
        fleet.step(first)
    reference.play(0)
    rows: dict[str, list[Array]] = {key: [] for key in ("goal", "joints", "place", "turn", "contact", "effort", "fell")}
    truth, ticks = fleet.truth, clip.ticks - 1 + round(HOLD_SECONDS * robot.rate)
    for tick in range(ticks):
        if tick % robot.rate == robot.rate // 2:
            size = np.array([rng.uniform(0.0, push) for rng in fleet.rngs])
            bearing = np.array([rng.uniform(-np.pi, np.pi) for rng in fleet.rngs])
            fleet.worlds.push(size[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], -1))
        goal = reference.frames(np.zeros(1, int)).position[:, 0]
        fleet.step(policy(fleet.observe(), fleet.applied, reference))
        reference.advance()
        for key, value in (
            ("goal", goal),
            ("joints", truth.joints),
            ("place", truth.position),
            ("turn", truth.orientation),
            ("contact", truth.foot_force > CARRIES),
            ("effort", fleet.worlds.effort),
            ("fell", truth.fallen),
        ):
            rows[key].append(np.array(value))
    place = np.stack(rows["place"], 1)
    return Played(
        goals=np.stack(rows["goal"])[:, 0],
        joints=np.stack(rows["joints"], 1),
        place=place - place[:, :1] * [1.0, 1.0, 0.0],
        orientation=np.stack(rows["turn"], 1),
        contact=np.stack(rows["contact"], 1),
        effort=np.stack(rows["effort"], 1),
        fallen=np.stack(rows["fell"], 1),
    )

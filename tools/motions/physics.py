"""Motions played open loop in physics: what happens to a robot that only follows the goals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array, Command, Mode
from servoid.hw.contracts.world import Start
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import About, Clip
from servoid.sim.truth import SimulatedTruth
from servoid.sim.worlds import Worlds
from servoid.stack.safety.limits import limit

SETTLE_SECONDS = 1.0  # in the pose that a motion begins in, before it does
HOLD_SECONDS = 1.0  # of the last goal: a robot that is about to fall has fallen by then
CARRIES = 1.0  # N on a sole that carries
# Base in the world frame, w x y z: pitched forward by a right angle, it lies on its front.
TURNS = {
    "lying on the front": (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0),
    "lying on the back": (np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0),
}


@dataclass(frozen=True)
class Played:
    """What happened in `n` worlds that were told the same goals, by the truth."""

    goals: Array  # (ticks, n_joints) rad, as the limits let them through
    joints: Array  # (n, ticks, n_joints) rad
    place: Array  # (n, ticks, 3) m of the base, from where it was when the motion began
    orientation: Array  # (n, ticks, 4) quaternion w x y z
    contact: Array  # (n, ticks, n_feet) whether each sole carries
    effort: Array  # (n, ticks, n_joints) N m
    fallen: Array  # (n, ticks) bool

    @property
    def stands(self) -> Array:
        """Whether each robot stands on its feet at the end `(n,)`."""
        return ~self.fallen[:, -1]

    def as_clip(self, name: str, about: About, world: int = 0) -> Clip:
        """The goals with the way that the base took in one of the worlds."""
        return Clip(
            name,
            self.goals,
            self.place[world],
            self.orientation[world],
            self.contact[world].astype(float),
            about,
        ).placed()


def play(
    goals: Array,
    robot: Robot,
    *,
    begins: str = "upright",
    worlds: int = 1,
    randomise: float = 0.0,
    seed: int = 0,
    corrected: Callable[[Array, SimulatedTruth], Array] | None = None,
) -> Played:
    """Play joint goals `(ticks, n_joints)` rad in `worlds` worlds of their own robots.

    The robot is put down as the motion `begins` (one of `clip.POSES`), settles in its first pose, and is then told the
    goals through the guard's limits, `corrected` by what the truth says.
    """
    many = Worlds(robot, worlds, threads=1, randomise=randomise)
    first = np.tile(goals[0], (worlds, 1))
    orientation = np.tile(TURNS[begins], (worlds, 1)) if begins in TURNS else None
    streams = [np.random.default_rng([seed, i]) for i in range(worlds)]
    many.reset(np.arange(worlds), streams, Start(joints=first, orientation=orientation))
    gain = np.ones((worlds, len(robot.joints)))
    for _ in range(round(SETTLE_SECONDS * robot.rate)):
        many.step(Command(first, gain, Mode.ACTIVE))
    rows: dict[str, list[Array]] = {key: [] for key in ("goal", "joints", "place", "turn", "contact", "effort", "fell")}
    applied, truth = first, many.truth
    for goal in goals:
        told = np.tile(goal, (worlds, 1))
        applied = limit(told if corrected is None else corrected(told, truth), applied, robot)
        many.step(Command(applied, gain, Mode.ACTIVE))
        for key, value in (
            ("goal", applied[0]),
            ("joints", truth.joints),
            ("place", truth.position),
            ("turn", truth.orientation),
            ("contact", truth.foot_force > CARRIES),
            ("effort", many.effort),
            ("fell", truth.fallen),
        ):
            rows[key].append(np.array(value))
    place = np.stack(rows["place"], 1)
    return Played(
        goals=np.stack(rows["goal"]),
        joints=np.stack(rows["joints"], 1),
        place=place - place[:, :1] * [1.0, 1.0, 0.0],
        orientation=np.stack(rows["turn"], 1),
        contact=np.stack(rows["contact"], 1),
        effort=np.stack(rows["effort"], 1),
        fallen=np.stack(rows["fell"], 1),
    )

"""Takes as a robot executes them in physics, so that what is learned from them can be tracked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Reference, State
from servoid.policy.diffusion.prefix.frames import Frames
from servoid.policy.features import raw_layout, raw_row
from servoid.policy.references.plan import PlanReference
from servoid.stack.control.fleet import Fleet
from servoid.tools.learn.progress import counted
from servoid.tools.learn.takes.maker import Take

Follow = Callable[[State, Array, Reference], Array]  # joint targets, as a tracker has them

LOST_HEIGHT = 0.06  # m of the base off the take, and
LOST_GRAVITY = 0.5  # of the unit vector along gravity, from where on a take is not followed any more
_BEFORE = 0.5  # s before that which are left out, too


@dataclass(frozen=True)
class Executed:
    """What the estimator saw at each tick, and what was to be reached by it."""

    raw: Array  # (ticks, raw size)
    take: Take
    number: int  # of the take among those that were executed


def execute(takes: Sequence[Take], fleet: Fleet, follow: Follow, frames: Frames) -> list[Executed]:
    """What the estimator saw while robots followed takes, one each.

    `follow` acts for the whole `fleet`, of as many worlds as there are takes. A take that is lost is cut before that;
    where nothing is left, it is left out.
    """
    robot, count = fleet.robot, len(takes)
    longest = max(take.ticks for take in takes)
    rows = np.stack([_rows(take, longest, frames) for take in takes])
    wanted = frames.motion(rows[..., :3], rows[..., 3:7], rows[..., 7 : 7 + len(robot.joints)])
    gravity = frames.layout.split(frames.to_relative(wanted))["gravity"]
    reference = PlanReference(robot, (count,))
    fleet.reset(np.ones(count, bool))
    reference.follow(rows)
    seen = np.zeros((longest, count, raw_layout(len(robot.joints)).size), np.float32)
    lost = np.full(count, longest)
    for tick in counted(longest, "executing takes"):
        state = fleet.observe()
        seen[tick] = raw_row(state)
        now = max(tick - 1, 0)  # the frame that was to be reached by this tick
        off = np.abs(state.displacement[:, 2] - rows[:, now, 2]) > LOST_HEIGHT
        off |= np.linalg.norm(state.gravity - gravity[:, max(now - 1, 0)], axis=-1) > LOST_GRAVITY
        lost = np.where(off & (tick < lost), tick, lost)
        fleet.step(follow(state, fleet.applied, reference))
        reference.advance()
    margin = round(_BEFORE / robot.dt)
    kept = []
    for i, take in enumerate(takes):
        ticks = take.ticks if lost[i] >= take.ticks else max(int(lost[i]) - margin, 0)
        if ticks > 1:
            by = np.maximum(np.arange(ticks) - 1, 0)  # the frame that was to be reached by each tick
            goals = Take(take.place[by], take.orientation[by], take.joints[by], take.label[:ticks])
            kept.append(Executed(seen[:ticks, i], goals, i))
    return kept


def _rows(take: Take, ticks: int, frames: Frames) -> Array:
    """Rows for a `PlanReference`, the last one repeated up to so many ticks."""
    motion = frames.motion(take.place, take.orientation, take.joints)
    rows = np.concatenate([take.place, take.orientation, take.joints, motion.contact], -1)
    return np.concatenate([rows, np.repeat(rows[-1:], ticks - len(rows), 0)])

"""The phases of a run: what the guard lets happen in each."""

from __future__ import annotations

from enum import StrEnum


class Phase(StrEnum):
    """What the guard lets happen."""

    LIMP = "limp"  # nothing is sent
    HOMING = "homing"  # going to the home pose
    READY = "ready"  # holding it, upright
    RUNNING = "running"  # following targets
    FALLEN = "fallen"  # falling, or lying: braked, until it is still
    RECOVERING = "recovering"  # following targets to get up
    STOPPING = "stopping"  # as running, of a policy that is asked to stand
    LOWERING = "lowering"  # going to a crouch, to end
    DAMPED = "damped"  # braking, then torque off
    FAULT = "fault"  # the same, for a reason that a person must look at


DOWN = {Phase.FALLEN, Phase.RECOVERING}
POWERED = {Phase.HOMING, Phase.READY, Phase.RUNNING, *DOWN, Phase.STOPPING, Phase.LOWERING}
FOLLOWING = {Phase.RUNNING, Phase.STOPPING}
ENDED = {Phase.DAMPED, Phase.FAULT}

"""Batched walkers for making data: a fleet driven by the gait or by the expert under random commands and pushes."""

from __future__ import annotations

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import ReferenceFrames
from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import resolve
from servoid.policy.mlp import Mlp
from servoid.policy.references.gait import Gait, GyroFeedback
from servoid.policy.tracker.observation import AHEAD, RESIDUAL, TrackerObservation
from servoid.stack.control.fleet import Fleet


class Walker:
    """Joint targets `(n, n_joints)` for a fleet from the gait with gyro feedback, or from a tracker on the gait."""

    def __init__(self, fleet: Fleet, tracker: Mlp | None) -> None:
        self.fleet, self._tracker = fleet, tracker
        self.gait = Gait(fleet.robot, (fleet.n,))
        self._feedback = GyroFeedback(fleet.robot)
        self._observation = TrackerObservation(fleet.robot, (fleet.n,))

    def reset(self, where: Array) -> None:
        """New episodes in the worlds `where`: stand."""
        self.gait.reset(where)
        self._observation.reset(where)

    def act(self, command: Array) -> Array:
        """Targets for the present state of the fleet under `command` `(n, 3)`."""
        self.gait.command(command)
        frames: ReferenceFrames = self.gait.frames(AHEAD)
        reference = frames.position[:, 0]
        if self._tracker is None:
            target = self._feedback(reference, self.fleet.state.angular_velocity)
        else:
            target = reference + RESIDUAL * self._tracker(
                self._observation(self.fleet.state, self.fleet.applied, frames)
            )
        self.gait.advance()
        return target


def load_tracker(robot: Robot, name: str = "expert") -> Mlp:
    """The tracker network `name` for `robot`. Raises CheckpointError."""
    return Mlp.load(resolve(name), "tracker", robot, TrackerObservation(robot).size)[0]

"""A virtual rig on the page, from beside it: `python -m servoid.tools.web.rig_view SETTINGS`, which are JSON.

It asks the rig's control socket where the robot is, and seldom how its servos are: the rig must answer its bus in time.
Stop presses the stop button of the rig's board: what controls the robot hears it.
"""

from __future__ import annotations

import json
import select
import signal
import sys
import time
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import BackendError
from servoid.hw.contracts.operator import Halt
from servoid.hw.dynamixel.imu import BUTTONS
from servoid.hw.geometry import up_vector
from servoid.hw.robot.description import Robot, load_robot
from servoid.sim.rig.process.control import Control, RigTruth
from servoid.sim.truth import SimulatedTruth
from servoid.tools.web.launch import STOPS, View, open_page
from servoid.tools.web.line.snapshot import BodyPose, RunInfo, Snapshot

FRAME_SECONDS = 1.0 / 15.0
SERVOS_EVERY = 15  # frames between two looks at the servos
PRESS_SECONDS = 0.2  # that a button is held, several reads of whoever controls the robot


class RigView:
    """Shows a rig, and presses its stop button."""

    def __init__(self, robot: Robot, control: Control) -> None:
        self._robot, self._control = robot, control
        self._truth = RigTruth(control, robot)
        self._servos: list[dict[str, Any]] = []
        self._began, self._number = time.monotonic(), 0
        self._stop = min((BUTTONS[name] for name in robot.bus.stop_buttons), default=0)

    def snapshot(self) -> Snapshot:
        """The rig as it is. Raises BackendError when it is gone."""
        truth = self._truth.fetch()
        if self._number % SERVOS_EVERY == 0:
            self._servos = self._control.servos()
        servos = self._servos
        n, on = len(servos), sum(bool(servo["torque"]) for servo in servos)
        unread = np.full(n, np.nan)
        self._number += 1
        return Snapshot(
            tick=self._number,
            time=time.monotonic() - self._began,
            phase=f"{'held' if self._truth.held else 'free'}, torque on {on} of {n}",
            position=truth.joints[0].copy(),
            target=unread,
            effort=unread,
            temperature=np.array([servo["temperature"] for servo in servos]),
            voltage=unread,
            age=np.zeros(n),
            fault=np.array([servo["error"] for servo in servos], dtype=int),
            gain=np.ones(n),
            late=0.0,
            busy=0.0,
            missed=0,
            pose=_pose(truth),
            velocity=np.array([*truth.velocity[0, :2], truth.angular_velocity[0, 2]]),
            tilt=float(np.arccos(np.clip(up_vector(truth.orientation[0])[2], -1.0, 1.0))),
        )

    def press(self, times: int) -> None:
        """Press the stop button so often."""
        for _ in range(times):
            for buttons in (self._stop, 0):
                self._control.press(buttons)
                time.sleep(PRESS_SECONDS)


def _pose(truth: SimulatedTruth) -> BodyPose:
    return BodyPose(truth.position[0].copy(), truth.orientation[0].copy(), truth.joints[0].copy())


def watch(values: dict[str, Any]) -> None:
    """Show the rig until it, or its page, is gone. Raises ConfigError where there can be no page."""
    robot = load_robot(values["robot"])
    view = RigView(robot, Control(values["control"]))
    with open_page(View(values["host"], values["port"]), values["robot"]) as page:
        print(f"page: {page.url}  ({STOPS})", file=sys.stderr, flush=True)
        title = "virtual rig (STOP presses its board's button)" if values["board"] else "virtual rig without a board"
        page.link.begin(RunInfo(values["robot"], title, "virtual", "", simulated=False, steers=False, insists=False))
        while page.link.alive:
            select.select([page.link], [], [], FRAME_SECONDS)
            if (halt := page.link.take_halt()) is not Halt.NO and values["board"]:
                view.press(int(halt))
            page.link.publish(view.snapshot())


def main() -> int:
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends with the rig
    try:
        watch(json.loads(sys.argv[1]))
    except ConfigError as error:
        print(f"no page: {error}", file=sys.stderr, flush=True)
        return 2
    except BackendError:  # the rig has ended
        return 0
    return 0


if __name__ == "__main__":
    sys.exit(main())

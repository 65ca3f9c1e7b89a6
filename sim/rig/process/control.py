"""The other end of a virtual rig's control socket: its clock, its truth and its faults, for rollouts and tests only."""

from __future__ import annotations

import json
import select
import socket
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Literal

import numpy as np

from servoid.hw.contracts.body import Array, BackendError
from servoid.hw.contracts.world import Scene, Start
from servoid.hw.robot.description import Robot, load_robot, save_robot
from servoid.sim.model import build
from servoid.sim.rig.servo.factory_state import FactoryState
from servoid.sim.scene import plain, scene_sensors
from servoid.sim.truth import SimulatedTruth

_START_SECONDS = 60.0
_ANSWER_SECONDS = 60.0


class Control:
    """A connection to a rig. Every method raises BackendError when the rig is gone or refuses."""

    def __init__(self, path: str | Path) -> None:
        self._path = str(path)
        self._stream = socket.socket(socket.AF_UNIX)
        self._stream.settimeout(_ANSWER_SECONDS)
        try:
            self._stream.connect(self._path)
        except OSError as error:
            raise BackendError(f"virtual rig at {self._path}: cannot be reached: {error.strerror}") from error
        self._file = self._stream.makefile("rb")

    def call(self, op: str, **arguments: Any) -> dict[str, Any]:
        """Send a request and wait for its answer."""
        try:
            self._stream.sendall(json.dumps({"op": op, **arguments}).encode() + b"\n")
            line = self._file.readline()
        except OSError as error:
            raise BackendError(f"virtual rig at {self._path}: does not answer: {error}") from error
        if not line:
            raise BackendError(f"virtual rig at {self._path}: has ended")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise BackendError(f"virtual rig at {self._path}: {op}: {answer['error']}")
        return answer

    def close(self) -> None:
        """Leave the rig. If this connection had locked its clock, it runs free from here."""
        self._file.close()
        self._stream.close()

    def reset(self, seed: int, *, randomise: bool = False) -> None:
        """A rig as delivered, without power, held at home. It is let go when all servos have torque."""
        self.call("reset", seed=seed, randomise=randomise)

    def hold(self) -> None:
        """Keep holding the robot when all servos have torque, until a reset."""
        self.call("hold")

    def push(self, velocity: Array) -> None:
        """Change the base's velocity by `(2,)` m/s, world frame."""
        self.call("push", velocity=np.asarray(velocity).tolist())

    def furnish(self, scene: Scene, seed: int, *, randomise: bool = False) -> None:
        """Put a scene around the robot, and reset the rig."""
        self.call("furnish", scene=plain(scene))
        self.reset(seed, randomise=randomise)

    def lay(self, start: Start) -> None:
        """Hold the robot so, and let it go so when all servos have torque, until a reset: joints, height, orientation
        and angular velocity in one row."""
        values = {name: getattr(start, name) for name in ("joints", "position", "orientation", "angular_velocity")}
        self.call("lay", **{name: None if value is None else value[0].tolist() for name, value in values.items()})

    def roll(self, places: Array) -> None:
        """Put the centres of the scene's spheres to `(m, 3)` m."""
        self.call("roll", places=np.asarray(places).tolist())

    def move(self, pose: dict[str, float]) -> None:
        """Move limp joints of the held robot by hand [rad]."""
        self.call("move", pose=pose)

    def joints(self) -> dict[str, float]:
        """Where each joint is [rad]."""
        return dict(self.call("joints")["joints"])

    def press(self, buttons: int) -> None:
        """Hold down buttons of the board; 0 lets go."""
        self.call("press", buttons=buttons)

    def inject(self, kind: str, **fault: Any) -> None:
        """Inject a fault of `servoid.sim.rig.wire.faults`, its times counted from now."""
        self.call("inject", fault={"kind": kind, **fault})

    def accepted(self) -> list[dict[str, Any]]:
        """Goals, torque and gains that servos took since the last call: time_ns, joint, register, value, position.

        Raises BackendError when it was not asked for too long and some were forgotten.
        """
        answer = self.call("accepted")
        if answer["forgotten"]:
            raise BackendError(f"virtual rig: {answer['forgotten']} accepted writes were forgotten: ask more often")
        return list(answer["accepted"])

    def lateness(self) -> str | None:
        """What a person should know of a rig in real time that was late since this was last asked; None if it was
        not."""
        text: str | None = self.call("lateness")["text"]
        return text

    def servos(self) -> list[dict[str, Any]]:
        """State of each servo, in the robot's joint order."""
        return list(self.call("servos")["servos"])

    def statistics(self) -> dict[str, Any]:
        """Faults that struck, collisions and instructions since the reset."""
        return self.call("statistics")


class LockedClock:
    """Time of a rig that stands still while the controller thinks: sleeping lets it pass."""

    def __init__(self, control: Control) -> None:
        """Raises BackendError when another connection has the rig's clock."""
        self._control = control
        self._now: int = control.call("lock")["now"]

    def now_ns(self) -> int:
        return self._now

    def sleep_until(self, time_ns: int) -> None:
        if time_ns > self._now:
            self._now = self._control.call("advance", to=int(time_ns))["now"]


class RigTruth:
    """The truth about a rig's robot, fetched on demand."""

    def __init__(self, control: Control, robot: Robot, scene: Scene | None = None) -> None:
        self._control = control
        model = build(robot, scene)
        self._arrays = {
            "qpos": np.zeros((1, model.nq)),
            "qvel": np.zeros((1, model.nv)),
            "sensordata": np.zeros((1, model.nsensordata)),
        }
        self._recent, self._scene = np.zeros((1, 1, model.nsensordata)), scene_sensors(model)
        qpos, qvel, sensors = self._arrays.values()
        self._truth = SimulatedTruth(model, robot, qpos, qvel, sensors, self._recent)
        self.held = True  # whether somebody held the robot when the truth was fetched last

    def fetch(self) -> SimulatedTruth:
        """The truth of now; a later call changes what this one returned."""
        answer = self._control.call("truth")
        self.held = bool(answer["held"])
        for name, array in self._arrays.items():
            array[0] = answer[name]
        self._recent[..., self._scene] = answer["touches"]
        return self._truth


class RigProcess:
    """A virtual rig in a process of its own. It outlives this one, if this is killed, by `linger` seconds of silence:
    long enough for whoever looks after the servos then. After that it ends and leaves nothing behind.
    """

    def __init__(
        self,
        robot: str | Path | Robot = "op3",
        *,
        clock: Literal["real", "locked"] = "locked",
        seed: int = 0,
        randomise: bool = False,
        faults: str | Path | None = None,
        factory_state: FactoryState | None = None,
        linger: float = 10.0,
    ) -> None:
        """`robot` is a name, a file, or a robot as it is. Raises BackendError with the reason if it does not start."""
        self.robot = robot if isinstance(robot, Robot) else load_robot(robot)
        self._folder = tempfile.TemporaryDirectory(prefix="servoid-rig-")
        control = str(Path(self._folder.name) / "control")
        if isinstance(robot, Robot):
            robot = Path(self._folder.name) / "robot.yaml"
            save_robot(self.robot, robot)
        command = [
            sys.executable,
            "-P",  # or a file in the present folder could stand for a module
            "-m",
            "servoid.sim.rig.process.server",
            "--robot",
            str(robot),
            "--clock",
            clock,
            "--control",
            control,
        ]
        command += ["--seed", str(seed), "--linger", str(linger), "--folder", self._folder.name]
        command += ["--randomise"] if randomise else []
        command += ["--faults", str(faults)] if faults else []
        command += [] if factory_state is None else factory_state.arguments()
        # A session of its own: Ctrl-C in the terminal is meant for the controller.
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True)
        try:
            started = self._first_line()
            if "error" in started:
                raise BackendError(f"the virtual rig did not start: {started['error']}")
            self.port: str = started["port"]
            self.control_path: str = started["control"]
            self.control = Control(self.control_path)
        except BaseException:  # Ctrl-C among them: nobody else knows of the process yet
            self._end()
            raise

    def _first_line(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        if not select.select([self.process.stdout], [], [], _START_SECONDS)[0]:
            return {"error": f"nothing was heard of it for {_START_SECONDS:g} s: what else keeps this machine busy?"}
        line = self.process.stdout.readline()
        if not line:
            return {"error": f"ended with code {self.process.wait(_START_SECONDS)}"}
        started: dict[str, Any] = json.loads(line)
        return started

    def truth(self, scene: Scene | None = None) -> RigTruth:
        """The truth about the robot, in the scene that the rig was furnished with."""
        return RigTruth(self.control, self.robot, scene)

    def close(self) -> None:
        """End the rig."""
        self.control.close()
        self._end()

    def _end(self) -> None:
        self.process.terminate()
        try:
            self.process.wait(5.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()
        self._folder.cleanup()

    def __enter__(self) -> RigProcess:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

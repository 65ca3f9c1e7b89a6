"""A live run for Foxglove's own application: the robot as a scene with moving frames, joint states, events and numbers.

It is served to this machine alone, and takes nothing from whoever looks on.
"""

from __future__ import annotations

import json
import math
import time
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.sim.drawing.shapes import Figure
from servoid.stack.safety.event import Event
from servoid.tools.web.browser.meshes import Mesh, meshes
from servoid.tools.web.line.snapshot import Snapshot

WORLD = "world"
AGAIN_SECONDS = 1.0  # between two pictures of what stands still: whoever comes late sees it, too


class LiveFoxglove:
    """Raises ConfigError where it cannot be served."""

    def __init__(self, robot: Robot, port: int) -> None:
        try:
            import foxglove
            from foxglove import channels, messages
        except ModuleNotFoundError:
            raise ConfigError("--foxglove needs the 'foxglove' extra: pip install 'servoid[foxglove]'") from None
        self._robot, self._figure, self._types = robot, Figure(robot), messages
        context = self._context = foxglove.Context()  # kept: its channels are closed with it
        try:
            self._server = foxglove.start_server(name=f"servoid {robot.name}", port=port, context=context)
        except RuntimeError as error:
            raise ConfigError(f"--foxglove {port}: {error}: choose another port") from None
        self._frames = channels.FrameTransformsChannel("/frames", context=context)
        self._scene = channels.SceneUpdateChannel("/scene", context=context)
        self._joints = channels.JointStatesChannel("/joints", context=context)
        self._events = channels.LogChannel("/events", context=context)
        self._numbers = foxglove.Channel("/tick", message_encoding="json", context=context)
        self._bodies = [self._entity(i, mesh) for i, mesh in enumerate(meshes(self._figure.shapes))]
        self._drawn = -math.inf

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self._server.port}"

    def show(self, snapshot: Snapshot, numbers: str) -> None:
        """A tick, and its `numbers` as the page has them, in JSON."""
        types, states = self._types, []
        for i, name in enumerate(self._robot.names):
            effort, position = float(snapshot.effort[i]), float(snapshot.position[i])
            states.append(types.JointState(name=name, position=position, effort=effort))
        self._joints.log(types.JointStates(joints=states))
        self._numbers.log(json.loads(numbers))
        if snapshot.pose is not None and np.isfinite([*snapshot.pose.place, *snapshot.pose.orientation]).all():
            pose = snapshot.pose
            placed = zip(
                self._figure.bodies, *self._figure.pose(pose.place, pose.orientation, pose.joints), strict=True
            )
            self._frames.log(types.FrameTransforms(transforms=[self._frame(*body) for body in placed]))
        if time.monotonic() - self._drawn > AGAIN_SECONDS:
            self._drawn = time.monotonic()
            self._scene.log(types.SceneUpdate(entities=self._bodies))

    def hear(self, event: Event) -> None:
        self._events.log(self._types.Log(level=self._types.LogLevel.Info, message=event.text, name=event.kind))

    def close(self) -> None:
        self._server.stop()

    def _frame(self, body: str, place: Array, turn: Array) -> Any:
        w, x, y, z = turn.tolist()
        return self._types.FrameTransform(
            parent_frame_id=WORLD,
            child_frame_id=body,
            translation=self._types.Vector3(x=place[0], y=place[1], z=place[2]),
            rotation=self._types.Quaternion(x=x, y=y, z=z, w=w),
        )

    def _entity(self, number: int, mesh: Mesh) -> Any:
        """A mesh that moves with its body."""
        types = self._types
        red, green, blue = (part / 255.0 for part in mesh.colour)
        triangles = types.TriangleListPrimitive(
            pose=types.Pose(position=types.Vector3(), orientation=types.Quaternion(w=1.0)),
            points=[types.Point3(x=x, y=y, z=z) for x, y, z in np.asarray(mesh.vertices, dtype=float).tolist()],
            color=types.Color(r=red, g=green, b=blue, a=1.0 if mesh.opacity is None else mesh.opacity),
            indices=[int(index) for index in np.ravel(mesh.faces)],
        )
        return types.SceneEntity(frame_id=mesh.body, id=str(number), frame_locked=True, triangles=[triangles])

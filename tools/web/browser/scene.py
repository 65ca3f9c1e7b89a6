"""The robot in 3D, by viser: the estimate, on demand the simulation's truth, and what it is asked and plans.

To follow the robot, the whole world is moved, not the camera: whoever turns the picture by hand then does so in peace.
"""

from __future__ import annotations

import contextlib
import io
import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.sim.drawing.shapes import Figure
from servoid.sim.marks import GOAL_COLOUR, PATH_COLOUR, PLAN_COLOUR, TRAIL_COLOUR
from servoid.sim.scene import PILLAR_COLOUR, PILLAR_HEIGHT, SPHERE_COLOUR
from servoid.tools.web.browser.handles import Handles
from servoid.tools.web.browser.meshes import meshes
from servoid.tools.web.line.snapshot import BodyPose, RunInfo, Snapshot

WORLD = "/world"
TRUTH_COLOUR, BESIDE_COLOUR, OPACITY = (60, 110, 220), (225, 130, 30), 0.35
CONTACT_COLOUR, BECAME_COLOUR = (40, 170, 90), (0.2, 0.35, 0.85)
FOLLOW = 0.15  # share of the way to the robot that the picture goes each frame
CELL = 0.5  # m of the floor's grid
TRAIL_STEP, TRAIL_LENGTH = 0.03, 400  # m between marks of the way, and how many there are


class Scene3D:
    """Draws into a viser server of its own, at a port of this machine. `truth_wanted` is told when somebody switches
    the truth on or off, and `dragged` where a handle was put, by its name, `(3,)` m."""

    def __init__(
        self, robot: Robot, truth_wanted: Callable[[bool], None], dragged: Callable[[str, Array], None]
    ) -> None:
        """Raises ConfigError where the robot's model cannot be compiled."""
        with contextlib.redirect_stdout(io.StringIO()):  # viser's own greeting names an address that is not the page's
            self._server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        self._robot, self._figure = robot, Figure(robot)
        self._handles = Handles(self._server, WORLD, dragged)
        self._at: Array = np.zeros(2)  # m: what the picture looks at
        self._marks: dict[str, Any] = {}
        self._drawn: dict[str, Array] = {}
        self._trail: deque[Array] = deque(maxlen=TRAIL_LENGTH)
        self._reach: float | None = None
        self._pillars: int | None = None
        server = self._server
        server.gui.configure_theme(
            control_layout="floating", control_width="small", show_logo=False, show_share_button=False
        )
        server.initial_camera.position = (0.9, -0.9, 0.55)
        server.initial_camera.look_at = (0.0, 0.0, 0.2)
        self._follows = server.gui.add_checkbox("follow", True)
        self._shows_truth = server.gui.add_checkbox("truth", False)
        self._shows_plan = server.gui.add_checkbox("plan", True)

        @self._shows_truth.on_update
        def _(event: Any) -> None:
            truth_wanted(self._shows_truth.value)
            if not self._shows_truth.value:
                self._truth.visible = False

        self._world = server.scene.add_frame(WORLD, show_axes=False)
        self._grid = server.scene.add_grid(
            f"{WORLD}/floor",
            8.0,
            8.0,
            cell_size=CELL,
            section_size=2 * CELL,
            plane_color=(236, 238, 241),
            plane_opacity=1.0,
        )
        self._robot_parts = self._add_robot("robot", None)
        self._truth = server.scene.add_frame(f"{WORLD}/truth", show_axes=False, visible=False)
        self._truth_parts = self._add_robot("truth", TRUTH_COLOUR)
        self._beside: Any = None  # drawn once something is to be compared with
        self._contacts = [self._add_contact(name) for name in robot.feet]
        up = np.array([0.0, 0.0, robot.standing_height])
        self._put(self._robot_parts, BodyPose(up, np.array([1.0, 0.0, 0.0, 0.0]), robot.home))

    @property
    def port(self) -> int:
        return int(self._server.get_port())

    def begin(self, info: RunInfo) -> None:
        """Another run: the marks of the one before go."""
        self._trail.clear()
        for name in list(self._marks):
            self._marks.pop(name).remove()
        self._drawn.clear()
        self._at = np.zeros(2)
        self._reach, self._pillars = info.reach, info.pillars
        if info.path is not None:
            self._line("path", info.path, PATH_COLOUR, 0.006)

    def show(self, snapshot: Snapshot) -> None:
        """Draw a tick."""
        with self._server.atomic():
            if (pose := snapshot.pose) is not None:
                self._put(self._robot_parts, pose)
                self._show_contact(snapshot.contact)
                self._follow(pose.place)
            shown = snapshot.truth is not None and self._shows_truth.value
            if shown and snapshot.truth is not None:
                self._put(self._truth_parts, snapshot.truth)
            if self._truth.visible != shown:
                self._truth.visible = shown
            other = None if snapshot.other is None else snapshot.other.pose
            self._show_beside(snapshot.beside if other is None else other)
            self._handles.show(snapshot.handles or {})
            self._show_marks(snapshot)

    def close(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _add_robot(self, name: str, colour: tuple[int, int, int] | None) -> list[Any]:
        """A frame for each body, with its meshes; in one `colour`, it can be seen through."""
        root, scene = f"{WORLD}/{name}", self._server.scene
        parts = [scene.add_frame(f"{root}/{body}", show_axes=False) for body in self._figure.bodies]
        for number, mesh in enumerate(meshes(self._figure.shapes)):
            scene.add_mesh_simple(
                f"{root}/{mesh.body}/{number}",
                mesh.vertices.astype(np.float32),
                mesh.faces.astype(np.uint32),
                color=mesh.colour if colour is None else colour,
                opacity=mesh.opacity if colour is None else OPACITY,
                flat_shading=True,
                cast_shadow=colour is None,
            )
        return parts

    def _add_contact(self, foot: str) -> Any:
        """A disc below a foot that carries."""
        name = f"{WORLD}/contact/{foot}"
        return self._server.scene.add_cylinder(name, 0.05, 0.002, color=CONTACT_COLOUR, opacity=0.6, visible=False)

    def _put(self, parts: list[Any], pose: BodyPose) -> None:
        if not (np.isfinite(pose.place).all() and np.isfinite(pose.orientation).all()):
            return
        positions, orientations = self._figure.pose(pose.place, pose.orientation, pose.joints)
        for part, position, orientation in zip(parts, positions, orientations, strict=True):
            part.position, part.wxyz = position, orientation

    def _show_beside(self, pose: BodyPose | None) -> None:
        if pose is not None and self._beside is None:
            self._beside = self._server.scene.add_frame(f"{WORLD}/beside", show_axes=False)
            self._beside_parts = self._add_robot("beside", BESIDE_COLOUR)
        if pose is not None:
            self._put(self._beside_parts, pose)
        if self._beside is not None and self._beside.visible != (pose is not None):
            self._beside.visible = pose is not None

    def _show_contact(self, contact: Array | None) -> None:
        for number, mark in enumerate(self._contacts):
            touches = contact is not None and bool(contact[number] > 0.5)
            if touches:
                x, y, _ = self._figure.soles[number]
                mark.position = (x, y, 0.001)
            if mark.visible != touches:
                mark.visible = touches

    def _follow(self, place: Array) -> None:
        if not self._follows.value or not np.isfinite(place).all():
            return
        self._at = self._at + FOLLOW * (place[:2] - self._at)
        self._world.position = (-self._at[0], -self._at[1], 0.0)
        self._grid.position = (*(2 * CELL * np.round(self._at / (2 * CELL))), 0.0)  # the floor has no end

    def _show_marks(self, snapshot: Snapshot) -> None:
        if snapshot.pose is not None:
            here = snapshot.pose.place[:2]
            if not self._trail or np.linalg.norm(here - self._trail[-1]) > TRAIL_STEP:
                self._trail.append(here)
                self._line("trail", np.array(self._trail), TRAIL_COLOUR, 0.005)
        if snapshot.goal is not None:
            self._goal_at(snapshot.goal)
        if snapshot.plan is not None or not self._shows_plan.value:
            self._line("plan", snapshot.plan if self._shows_plan.value else None, PLAN_COLOUR, 0.009)
        became = None if snapshot.became is None or not self._shows_plan.value else snapshot.became.places
        self._line("became", became, BECAME_COLOUR, 0.009)
        if snapshot.path is not None:
            self._line("ahead", snapshot.path if self._shows_plan.value else None, PATH_COLOUR, 0.006)
        for number, (x, y, radius) in enumerate(() if snapshot.obstacles is None else snapshot.obstacles):
            self._obstacle(number, x, y, radius)
        for number, (x, y, heading) in enumerate(() if snapshot.robots is None else snapshot.robots):
            self._teammate(number, x, y, heading)

    def _goal_at(self, goal: Array) -> None:
        if self._moved("goal", goal):
            scene, colour = self._server.scene, _rgb(GOAL_COLOUR)
            if "goal" not in self._marks:
                self._marks["goal"] = scene.add_frame(f"{WORLD}/goal", show_axes=False)
                radius = self._reach or 0.05
                scene.add_cylinder(f"{WORLD}/goal/disc", radius, 0.002, color=colour, opacity=0.4)
                scene.add_cylinder(f"{WORLD}/goal/pole", 0.005, 0.24, color=colour, position=(0.0, 0.0, 0.12))
            self._marks["goal"].position = (*goal[:2], 0.002)

    def _obstacle(self, number: int, x: float, y: float, radius: float) -> None:
        name = f"obstacle{number}"
        if name not in self._marks:
            scene = self._server.scene
            if self._rolls(number):
                self._marks[name] = scene.add_icosphere(f"{WORLD}/{name}", radius, color=_rgb(SPHERE_COLOUR))
            else:
                self._marks[name] = scene.add_cylinder(
                    f"{WORLD}/{name}", radius, PILLAR_HEIGHT, color=_rgb(PILLAR_COLOUR), opacity=0.85
                )
        if self._moved(name, np.array([x, y])):
            height = radius if self._rolls(number) else PILLAR_HEIGHT / 2
            self._marks[name].position = (x, y, height)

    def _rolls(self, number: int) -> bool:
        return self._pillars is not None and number >= self._pillars

    def _teammate(self, number: int, x: float, y: float, heading: float) -> None:
        """Another robot: of its joints nothing is known, so it is a block that shows where it looks."""
        name, height = f"teammate{number}", self._robot.standing_height
        if name not in self._marks:
            scene = self._server.scene
            self._marks[name] = scene.add_box(
                f"{WORLD}/{name}", color=_rgb(PILLAR_COLOUR), dimensions=(0.1, 0.2, height)
            )
            scene.add_box(
                f"{WORLD}/{name}/front",
                color=_rgb(PLAN_COLOUR),
                dimensions=(0.02, 0.08, 0.05),
                position=(0.06, 0.0, height / 3),
            )
        self._marks[name].position = (x, y, height / 2)
        self._marks[name].wxyz = (math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2))

    def _line(self, name: str, points: Array | None, colour: tuple[float, ...], thickness: float) -> None:
        """A line on the floor through points `(n, 2)` m; None takes it away."""
        if points is None or len(points) < 2 or not np.isfinite(points).all():
            if points is None and name in self._marks:
                self._marks.pop(name).remove()
            return
        raised = np.column_stack([points, np.full(len(points), 0.006)])
        segments = np.stack([raised[:-1], raised[1:]], axis=1).astype(np.float32)
        if name in self._marks:
            self._marks[name].points = segments
        else:
            self._marks[name] = self._server.scene.add_line_segments(
                f"{WORLD}/{name}", segments, colors=_rgb(colour), thickness=thickness
            )

    def _moved(self, name: str, place: Array) -> bool:
        """Whether something is elsewhere than it was drawn."""
        if name in self._drawn and np.linalg.norm(place[:2] - self._drawn[name]) < 1e-3:
            return False
        self._drawn[name] = np.array(place[:2], dtype=float)
        return True


def _rgb(colour: tuple[float, ...]) -> tuple[int, int, int]:
    return (round(255 * colour[0]), round(255 * colour[1]), round(255 * colour[2]))

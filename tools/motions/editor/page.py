"""Keyframes on the operator's page: sliders, hands and feet that are dragged in the picture, and a try in physics."""

from __future__ import annotations

import select
import time
from collections.abc import Callable

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array, BackendError
from servoid.hw.contracts.operator import Halt
from servoid.tools.motions.editor.editor import Editor
from servoid.tools.motions.editor.frames import AXES, BASE, ROOM
from servoid.tools.web.line.link import PageLink
from servoid.tools.web.line.panel import Button, Buttons, Entry, Item, Panel, Paragraph, Slider
from servoid.tools.web.line.snapshot import BodyPose, RunInfo, Snapshot

FRAME_SECONDS = 1.0 / 30.0
APART = 0.45  # m to the left, that a limp robot is shown
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


class KeyframePage:
    """Joins an editor and a page. `limp` reads the joints `(n_joints,)` rad of a limp robot, where there is one: it
    takes a while, and raises BackendError once the robot is silent."""

    def __init__(self, link: PageLink, editor: Editor, robot: str, limp: Callable[[], Array] | None = None) -> None:
        self._link, self._editor, self._limp = link, editor, limp
        self._played = 0.0  # s of what physics made, that were shown
        self._tick, self._began = 0, time.monotonic()
        link.begin(RunInfo(robot, "keyframes", "", "", simulated=False, insists=False))
        self.show()

    def run(self) -> None:
        """Until there is no page any more."""
        before = time.monotonic()
        while self._link.alive:
            if self._limp is None:
                select.select([self._link], [], [], FRAME_SECONDS)
            now = time.monotonic()
            self.look(now - before)
            before = now

    def look(self, seconds: float = 0.0) -> None:
        """Heed what people ask, and show what comes of it, after so long."""
        editor, changed = self._editor, self._read()
        for request in self._link.take_actions():
            changed = True
            try:
                editor.do(request.what, request.value)
            except ConfigError as error:
                editor.said = str(error)
        if self._link.take_halt() is not Halt.NO:
            editor.played, changed = None, True
        if editor.played is not None:
            self._play(seconds)
        elif changed:
            self._played = 0.0
            self.show()

    def show(self) -> None:
        """The chosen keyframe, as it stands, and the panel."""
        editor = self._editor
        joints, place, turn = editor.poser.solved(editor.frame.pose)
        self._publish(BodyPose(place, turn, joints), "keyframe", editor.poser.handles(editor.frame.pose))
        self._link.show(Panel(f"Keyframes of {editor.name}", self._items()))

    def _read(self) -> bool:
        """Read the limp robot; whether something new is to be shown."""
        if self._limp is None:
            return False
        try:
            self._editor.limp = self._limp()
        except BackendError as error:
            self._editor.said, self._editor.limp, self._limp = str(error), None, None
        return True

    def _play(self, seconds: float) -> None:
        played, rate = self._editor.played, self._editor.robot.rate
        assert played is not None
        row = min(int(self._played * rate), len(played.goals) - 1)
        if self._played == 0.0:
            self._link.show(Panel(f"Keyframes of {self._editor.name}", self._items()))
        self._publish(BodyPose(played.place[0, row], played.orientation[0, row], played.joints[0, row]), "playing")
        self._played += seconds
        if self._played * rate >= len(played.goals):
            self._editor.played, self._played = None, 0.0
            self.show()

    def _items(self) -> tuple[Item, ...]:
        editor = self._editor
        frame, poser = editor.frame, editor.poser
        pose, handles = frame.pose, poser.handles(frame.pose)
        numbers = [
            Button("choose", str(i), str(i), on=i == editor.chosen + 1) for i in range(1, len(editor.frames) + 1)
        ]
        words = [("add", "Add a copy"), ("remove", "Remove"), ("home", "Home pose"), ("mirror", "Mirror the motion")]
        taking = (Button("take", "Take the limp robot's pose"), Button("take", "Take its arms", "arms"))
        height = float(poser.home.height)
        base = {f"tilt {axis}": pose.tilt[i] for i, axis in enumerate(("roll", "pitch", "yaw"))}
        base |= {f"lean {axis}": pose.lean[i] for i, axis in enumerate(("forward", "left"))}
        limbs = [("foot", name) for name in poser.feet] + [("hand", name) for name in poser.hands]
        home = poser.handles(poser.home)
        joints = [(poser.robot.joints[i], float(pose.joints[i])) for i in poser.free]
        return (
            *([Paragraph(editor.said)] if editor.said else []),
            Buttons(tuple(numbers)),
            Buttons(tuple(Button(do, label) for do, label in words) + (taking if editor.limp is not None else ())),
            Entry("seconds", "seconds to get there", f"{frame.seconds:g}"),
            Entry("hold", "seconds to stay", f"{frame.hold:g}"),
            Buttons((Button("play", "Play in physics"), Button("save", "Save"))),
            *(Slider(f"joint {joint.name}", joint.name, *joint.range, value) for joint, value in joints),
            *(
                Slider(f"move {name} {axis}", f"{name} {what if what not in name else ''} {axis}", low, high, value)
                for what, name in limbs
                for axis, value, middle in zip(AXES, handles[name].tolist(), home[name].tolist(), strict=True)
                for low, high in [(middle - ROOM[what] * (what == "hand" or axis != "z"), middle + ROOM[what])]
            ),
            Slider("height", "height of the base", 0.5 * height, 1.1 * height, float(pose.height)),
            *(Slider(name, name, -BASE[name], BASE[name], float(value)) for name, value in base.items()),
            Slider("weight", f"weight on the {poser.feet[0]} foot", 0.0, 1.0, float(pose.weight[0])),
            Entry("name", "name of the clip", editor.name),
            Entry("captions", "captions, with commas", editor.captions),
            Entry("licence", "licence", editor.licence),
            Entry("mirrored", "name of its mirror image", editor.mirror_name),
        )

    def _publish(self, pose: BodyPose, phase: str, handles: dict[str, Array] | None = None) -> None:
        self._tick += 1
        limp, n = self._editor.limp, len(pose.joints)
        unread = np.full(n, np.nan)
        beside = None
        if limp is not None:
            height = np.array([0.0, APART, self._editor.robot.standing_height])
            beside = BodyPose(height, UPRIGHT, np.nan_to_num(limp))
        self._link.publish(
            Snapshot(
                tick=self._tick,
                time=time.monotonic() - self._began,
                phase=phase,
                position=pose.joints,
                target=unread,
                effort=unread,
                temperature=unread,
                voltage=unread,
                age=np.zeros(n),
                fault=np.zeros(n, int),
                gain=np.ones(n),
                late=0.0,
                busy=0.0,
                missed=0,
                pose=pose,
                beside=beside,
                handles=handles,
            )
        )

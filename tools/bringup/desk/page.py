"""The operator's page as the desk of a verb: it prints there, asks there, and joints are jogged by a slider."""

from __future__ import annotations

import io
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from itertools import count

import numpy as np

from servoid.hw.contracts.body import Array, Observation
from servoid.hw.contracts.operator import Halt
from servoid.hw.robot.description import Robot
from servoid.stack.runtime.operator import Operator
from servoid.tools.bringup.desk.jogging import IDLE_SECONDS, SPAN, Source, Wish
from servoid.tools.bringup.desk.terminal import Desk
from servoid.tools.common.output import Report
from servoid.tools.common.prompt import Cancelled
from servoid.tools.web.line.link import PageLink
from servoid.tools.web.line.panel import Button, Buttons, Choice, Item, Panel, Paragraph, Question, Slider, Table
from servoid.tools.web.line.snapshot import BodyPose, Snapshot

FRAME_SECONDS = 1.0 / 30.0
LINES = 60  # that the page keeps of what a verb prints
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
APART = 0.45  # m to the left of the robot, that the reference pose is shown


class PageReport(Report):
    """Prints on the page. `changed` is called for each line."""

    def __init__(self, changed: Callable[[], None]) -> None:
        super().__init__(False, io.StringIO())
        self.items: list[Paragraph | Table] = []
        self._changed = changed

    def line(self, text: str = "") -> None:
        last = self.items[-1] if self.items else None
        if isinstance(last, Paragraph):
            self.items[-1] = Paragraph("\n".join(f"{last.text}\n{text}".splitlines()[-LINES:]))
        else:
            self.items.append(Paragraph(text))
        self._changed()

    def table(self, head: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
        self.items.append(Table(tuple(head), tuple(tuple(str(cell) for cell in row) for row in rows)))
        self._changed()

    def clear(self) -> None:
        self.items.clear()
        self.has_result = False


class PageDesk(Desk):
    """`controls` are the items on top of the panel; `settings` what was chosen there; `wanted` the verb that was asked
    for and has not begun, or "end"."""

    report: PageReport

    def __init__(self, link: PageLink, robot: Robot, controls: Callable[[], tuple[Item, ...]]) -> None:
        super().__init__(PageReport(self.show))
        self._link, self._robot, self._controls = link, robot, controls
        self.operator = Operator(link)
        self.listeners = (link,)
        self.settings: dict[str, str] = {}
        self.wanted: str | None = None
        self.title = ""
        self._question: Question | None = None
        self._slider: Slider | None = None
        self._answers: list[str] = []
        self._numbers = count(1)
        self._tick, self._began, self._drawn = 0, time.monotonic(), -math.inf

    def show(self) -> None:
        """Bring the panel up to date."""
        asked = tuple(item for item in (self._question, self._slider) if item is not None)
        self._link.show(Panel(self.title, (*self._controls(), *asked, *self.report.items)))

    def gather(self) -> None:
        """Take up what was asked for on the panel."""
        for request in self._link.take_actions():
            if request.what == "verb":
                self.wanted = request.value
            elif request.what == "answer":
                self._answers.append(request.value)
            else:
                self.settings[request.what] = request.value
                self.show()

    def heed(self) -> None:
        """Raise Cancelled where somebody wants what is done now to end, or the page is gone."""
        self.gather()
        if not self._link.alive:
            raise Cancelled("cancelled: the page has ended")
        if self._link.read().halt is not Halt.NO:
            raise Cancelled("stopped at the page")
        if self.wanted is not None:
            raise Cancelled("ended at the page")

    def confirm(self, text: str, remedy: str = "") -> None:
        question = self._question = Question(next(self._numbers), text)
        self._answers.clear()
        self.show()
        try:
            while not (ended := {f"yes {question.number}", f"no {question.number}"} & set(self._answers)):
                time.sleep(FRAME_SECONDS)
                self.heed()
        finally:
            self._question = None
            self.show()
        if f"no {question.number}" in ended:
            raise Cancelled("cancelled at the page")

    def progress(self, text: str) -> None:
        self.report.line(text)
        self.heed()

    def check_keys(self) -> None:
        """There is a slider."""

    def keys(self) -> AbstractContextManager[Source]:
        return self._pushed()

    @contextmanager
    def _pushed(self) -> Iterator[Source]:
        joint = self.settings.get("joint", "the joint")
        self._slider = Slider("jog", f"{joint} (let go: it stays)", -1.0, 1.0, 0.0, springs=True)
        self.wanted = None
        self.show()
        try:
            yield _Pushed(self)
        finally:
            self._slider = None
            self.show()

    def show_limp(self, joints: Array, reference: Array | None = None) -> None:
        self.heed()
        self._publish(joints, reference=reference)

    def show_read(self, observation: Observation) -> None:
        self.heed()
        self._publish(observation.position, observation)

    def redraws(self, show: Callable[[Report, bool], None]) -> Callable[[], None]:
        def redraw() -> None:
            table = PageReport(lambda: None)
            show(table, False)
            self.report.items = table.items
            self.show()

        return redraw

    def _publish(self, joints: Array, seen: Observation | None = None, reference: Array | None = None) -> None:
        """A picture of a robot that nothing drives, not more often than one is due."""
        now = time.monotonic()
        if now - self._drawn < FRAME_SECONDS:
            return
        self._drawn, self._tick = now, self._tick + 1
        n = len(joints)
        unread = np.full(n, np.nan)
        height = np.array([0.0, 0.0, self._robot.standing_height])
        beside = None if reference is None else BodyPose(height + np.array([0.0, APART, 0.0]), UPRIGHT, reference)
        self._link.publish(
            Snapshot(
                tick=self._tick,
                time=now - self._began,
                phase="reading",
                position=joints,
                target=unread if reference is None else reference,
                effort=unread if seen is None else seen.effort,
                temperature=unread if seen is None else seen.temperature,
                voltage=unread if seen is None else seen.voltage,
                age=np.zeros(n) if seen is None else seen.age,
                fault=np.zeros(n, int) if seen is None else seen.fault,
                gain=np.ones(n),
                late=0.0,
                busy=0.0,
                missed=0,
                pose=BodyPose(height, UPRIGHT, np.nan_to_num(joints)),
                beside=beside,
            )
        )


class _Pushed:
    """The slider as a source of wishes: it counts while its person is heard."""

    def __init__(self, desk: PageDesk) -> None:
        self._desk, self._used = desk, 0.0

    def wish(self, seconds: float, angle: float) -> Wish:
        """How far the slider is pushed. A minute without a push, another verb or the end of the page: the end."""
        desk, operator = self._desk, self._desk.operator
        assert operator is not None
        desk.gather()
        rate = 0.0 if operator.silent else float(operator.intent.way[0])
        if rate:
            self._used = seconds
        if desk.wanted is not None or seconds - self._used >= IDLE_SECONDS:
            return Wish.END
        return Wish(rate)


def verbs(running: str | None, joints: Sequence[str], joint: str, pose: str) -> tuple[Item, ...]:
    """The controls of bring-up: its verbs, and what they are to work on."""
    buttons = [
        *(("scan", "Scan"), ("check", "Check"), ("fix", "Check and fix"), ("calibrate", "Calibrate"), ("jog", "Jog")),
        *(("watch", "Watch"), ("end", "End")),
    ]
    return (
        Buttons(tuple(Button("verb", label, name, on=name == running) for name, label in buttons)),
        Choice("joint", f"joint to jog by {SPAN:g} rad", tuple(joints), joint),
        Choice("pose", "calibrate in the pose", ("zero", "home"), pose),
    )

"""Bring-up at the operator's page: the verbs of the terminal, their refusals, and a slider that lets go."""

from __future__ import annotations

import argparse
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from page_line import Line
from waiting import until

from servoid.hw.robot.description import load_robot
from servoid.sim.rig.process.control import RigProcess
from servoid.tools.bringup import calibrate, check, jog
from servoid.tools.bringup.desk.jogging import SPEED
from servoid.tools.bringup.session import Session
from servoid.tools.web.line.snapshot import RunInfo, Snapshot

ROBOT = load_robot()
KNEE = ROBOT.names.index("l_knee")


class Page:
    """A session, and the test as whoever is at its page. Verbs are those of a virtual rig."""

    def __init__(self, module: Any, verb: str, *words: str) -> None:
        parser = argparse.ArgumentParser()
        module.add_arguments(parser)
        self.line = Line()
        args = parser.parse_args([*words, "--port", "virtual", "--view"])
        self.session = Session(self.line.link, args, ROBOT, verb)
        self.panel: dict[str, Any] = {"items": []}
        self.shown: list[Snapshot] = []
        self.ends: list[tuple[str, str]] = []
        self._thread = threading.Thread(target=self.session.run)
        self._thread.start()

    def look(self) -> None:
        for kind, value in self.line.told():
            if kind == "panel":
                self.panel = value  # type: ignore[assignment]
            elif kind == "end":
                self.ends.append(value)  # type: ignore[arg-type]
            elif isinstance(value, Snapshot):
                self.shown.append(value)
            else:
                assert isinstance(value, RunInfo)

    def wait(self, seen: Any) -> None:
        def looked() -> bool:
            self.look()
            return bool(seen())

        until(looked)

    def item(self, kind: str) -> dict[str, Any] | None:
        self.look()
        return next((item for item in self.panel["items"] if item["is"] == kind), None)

    @property
    def text(self) -> str:
        return "\n".join(item["text"] for item in self.panel["items"] if item["is"] == "paragraph")

    def do(self, what: str, value: str) -> None:
        self.line.ask("do", what=what, value=value)

    def close(self) -> None:
        self.line.page.close()
        self._thread.join()


@pytest.fixture
def opened(rig: RigProcess) -> Iterator[Any]:
    pages: list[Page] = []

    def open_(*words: Any) -> Page:
        pages.append(Page(*words))
        return pages[-1]

    yield open_
    for page in pages:
        page.close()


def test_the_page_says_what_the_terminal_says_and_does_the_next_verb(
    rig: RigProcess, opened: Any, bringup: Any
) -> None:
    from test_bringup_scan import write

    write(rig, 14, drive_mode=1)
    _, answer, err = bringup("check", "--port", "virtual")
    assert [difference["register"] for difference in answer["differences"]]
    page = opened(check, "check")
    page.wait(lambda: page.ends)
    assert page.ends == [("failed", "")]
    assert page.text.strip() == "\n".join(err.splitlines()).strip()
    page.do("verb", "fix")
    page.wait(lambda: len(page.ends) == 2)
    assert page.ends[1] == ("done", "")
    assert "read back: 0 differ" in page.text
    write(rig, 14, torque_enable=1)
    page.do("verb", "calibrate")
    page.wait(lambda: len(page.ends) == 3)
    outcome, text = page.ends[2]
    assert outcome == "error"
    assert "l_knee has torque on: end the program that drives it" in text


@pytest.mark.slow
def test_a_slider_moves_one_joint_while_it_is_held_and_somebody_is_heard(rig: RigProcess, opened: Any) -> None:
    from test_bringup_jog import goals, torque

    page = opened(jog, "jog", "l_knee")
    page.wait(lambda: page.item("question"))
    page.do("answer", "yes 7")  # to another question
    page.do("answer", f"yes {page.item('question')['number']}")
    page.wait(lambda: page.item("slider"))
    assert page.item("slider")["springs"]
    page.wait(lambda: page.shown and page.shown[-1].phase == "running")
    page.line.ask("beat", way=(0.5, 0.0, 0.0))
    began = float(page.shown[-1].target[KNEE])
    page.wait(lambda: page.shown[-1].target[KNEE] > began + 0.05)
    page.line.now += 10**9  # nobody is heard any more: it stays
    page.wait(lambda: page.shown[-1].target[KNEE] == page.shown[-5].target[KNEE])
    page.line.now += 2 * 10**9  # and torque goes off
    page.wait(lambda: page.ends)
    assert torque(rig) == 0
    sent = goals(rig)
    assert np.ptp(np.delete(sent, KNEE, axis=0), axis=1).max() < 0.002, "another joint was sent somewhere else"
    assert np.ptp(sent[KNEE]) > 0.05
    assert np.abs(np.diff(sent[KNEE])).max() <= 0.5 * SPEED * ROBOT.dt * 2 + 0.002
    assert "torque is off" in page.text


def test_calibration_shows_the_limp_robot_beside_the_reference_and_stops_at_the_page(
    rig: RigProcess, opened: Any
) -> None:
    page = opened(calibrate, "calibrate", "--keep-directions", "--pose", "home")
    page.wait(lambda: page.ends)
    assert page.ends == [("done", "")]
    assert "head_pan" in str(page.item("table"))
    seen = page.shown[-1]
    assert seen.beside is not None
    np.testing.assert_allclose(seen.beside.joints, ROBOT.home)
    np.testing.assert_allclose(seen.pose.joints, ROBOT.home, atol=0.02)
    page.do("verb", "watch")
    page.wait(lambda: page.shown[-1].voltage[KNEE] > 10.0)
    page.wait(lambda: "bus: " in page.text)
    page.line.ask("stop")
    page.wait(lambda: len(page.ends) == 2)

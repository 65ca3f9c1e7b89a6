"""The page in a real browser: Chromium without a window, WebGL in software. The loop is the test, but for one run."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from waiting import until

from servoid.hw.contracts.operator import Halt
from servoid.hw.robot.description import load_robot
from servoid.policy.motion.library import Library
from servoid.stack.safety.event import Event
from servoid.tools.motions.editor.editor import Editor
from servoid.tools.motions.editor.page import KeyframePage
from servoid.tools.web.launch import OpenPage, View, open_page
from servoid.tools.web.line.panel import Panel, Question, Slider
from servoid.tools.web.line.snapshot import BodyPose, RunInfo, Snapshot

pytestmark = pytest.mark.slow

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install 'servoid[test]'")
if CHROMIUM is None:
    pytest.skip("no chromium on this machine: apt-get install chromium", allow_module_level=True)

ROBOT = load_robot()
N = len(ROBOT.names)
KNEE = ROBOT.names.index("l_knee")
INFO = RunInfo("op3", "steer", "sim", "gait", simulated=True, insists=False)  # the signal would be for this test
UPRIGHT = BodyPose(np.array([0.0, 0.0, ROBOT.standing_height]), np.array([1.0, 0.0, 0.0, 0.0]), ROBOT.home)
TICK = Snapshot(
    tick=1, time=1.0, phase="running", position=ROBOT.home, target=ROBOT.home, effort=np.zeros(N),
    temperature=np.full(N, 30.0), voltage=np.full(N, 12.0), age=np.zeros(N), fault=np.zeros(N, int), gain=np.ones(N),
    late=0.1, busy=2.0, missed=0, pose=UPRIGHT, velocity=np.zeros(3), tilt=0.0, contact=np.ones(2), asked=np.zeros(3),
)  # fmt: skip


@pytest.fixture(scope="module")
def playwright() -> Iterator[Any]:
    with sync_api.sync_playwright() as started:
        yield started


@pytest.fixture(scope="module")
def browser(playwright: Any) -> Iterator[Any]:
    gl = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    started = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *gl])
    yield started
    started.close()


@pytest.fixture(scope="module")
def page_of_a_run() -> Iterator[OpenPage]:
    with open_page(View(port=0), "op3", [{"name": "walk", "description": "walk about"}]) as page:
        yield page


@pytest.fixture
def page(page_of_a_run: OpenPage) -> OpenPage:
    """A page of a run that has just begun, of which nothing is asked."""
    page_of_a_run.link.take("start")
    page_of_a_run.link.take_halt()
    page_of_a_run.link.begin(INFO)
    page_of_a_run.link.publish(TICK)
    return page_of_a_run


@pytest.fixture
def opened(browser: Any) -> Iterator[Callable[..., Any]]:
    """Opens the page in a browser of its own, by default without the picture, which a busy machine draws slowly."""
    contexts = []

    def open_(url: str, picture: bool = False) -> Any:
        contexts.append(browser.new_context(viewport={"width": 1400, "height": 1000}, bypass_csp=True))
        tab = contexts[-1].new_page()
        tab.set_default_timeout(100_000)
        tab.goto(url + ("#picture" if picture else "#flat"))
        tab.wait_for_function(f"document.querySelectorAll('#joints tbody tr').length == {N}")
        return tab

    yield open_
    for context in contexts:
        context.close()


def says(tab: Any, where: str, text: str) -> None:
    """Wait until an element of the page contains a text."""
    tab.wait_for_function("([at, text]) => document.querySelector(at).textContent.includes(text)", arg=[where, text])


def take_control(tab: Any) -> None:
    tab.click("#control")
    says(tab, "#control", "Give up control")


def again(act: Callable[[], object], happened: Callable[[], object]) -> None:
    """Do something until it has an effect: what a busy machine delivers too late is not heeded."""
    for _ in range(20):
        act()
        for _ in range(50):
            if happened():
                return
            threading.Event().wait(0.02)
    raise AssertionError("it had no effect")


def test_numbers_events_and_the_picture_are_of_the_robot(page: OpenPage, opened: Callable[..., Any]) -> None:
    tab = opened(page.url, picture=True)
    tab.frame_locator("#view").locator("canvas").first.wait_for()  # viser draws
    hot, bent = TICK.temperature.copy(), TICK.position.copy()
    hot[KNEE], bent[KNEE] = 200.0, ROBOT.home[KNEE] + 0.011
    events = (
        Event(2, 1.5, "temperature", "l_knee", "l_knee is at 200 C: let it cool"),
        Event(2, 1.5, "phase", None, "x"),
    )
    page.link.publish(replace(TICK, tick=2, phase="lowering", temperature=hot, position=bent, events=events))
    row = f"#joints tbody tr:nth-child({KNEE + 1})"
    says(tab, row, f"{bent[KNEE]:.3f}")
    says(tab, f"{row} .over", "200")
    says(tab, "#phase", "lowering")
    says(tab, "#banner", "l_knee is at 200 C")
    says(tab, "#events", "1.50 s  l_knee is at 200 C")
    page.link.end("stopped", "The guard stopped the run.")
    says(tab, "#phase", "stopped")


def test_a_person_steers_by_keys_a_click_and_a_sentence(page: OpenPage, opened: Callable[..., Any]) -> None:
    link = page.link
    tab = opened(page.url)
    tab.keyboard.down("w")  # without control nobody steers
    says(tab, "#control", "Take control")
    assert not link.read().way.any()
    take_control(tab)
    until(lambda: link.read().way.tolist() == [0.6, 0.0, 0.0])
    tab.keyboard.up("w")
    tab.keyboard.down("ArrowLeft")
    until(lambda: link.read().way.tolist() == [0.0, 0.0, 0.6])
    tab.keyboard.up("ArrowLeft")
    until(lambda: not link.read().way.any())
    again(lambda: tab.click("#map", position={"x": 150, "y": 50}), lambda: link.read().goal is not None)
    goal = link.read().goal
    assert goal is not None
    np.testing.assert_allclose(goal, [1.0, 0.0], atol=0.02)
    tab.fill("#sentence", "turn left")
    again(lambda: tab.click("#say button"), lambda: link.read().text == "turn left")
    tab.fill("#settings", "vx=0.1 seconds=5")
    requests: list[Any] = []
    again(lambda: tab.click("#start button"), lambda: requests.append(link.take("start")) or requests[-1])
    assert (requests[-1].task, requests[-1].set) == ("walk", {"vx": "0.1", "seconds": "5"})


def test_who_closes_the_browser_is_not_heard_any_more(page: OpenPage, opened: Callable[..., Any]) -> None:
    tab = opened(page.url)
    take_control(tab)
    until(lambda: page.link.read().age < 0.3)
    tab.close()
    until(lambda: page.link.read().age > 2.0)


def test_of_two_browsers_one_is_in_control_and_the_other_may_stop(page: OpenPage, opened: Callable[..., Any]) -> None:
    one, other = opened(page.url), opened(page.url)
    take_control(one)
    says(other, "#control", "Somebody else is in control")
    other.keyboard.press(" ")
    until(lambda: page.link.read().halt is Halt.ORDERLY)
    one.focus("#sentence")
    one.keyboard.press("Escape")
    one.click("#off")
    until(lambda: page.link.read().halt is Halt.AT_ONCE)


def test_a_page_for_other_machines_is_closed_without_its_token(browser: Any, opened: Callable[..., Any]) -> None:
    with open_page(View("0.0.0.0", 0), "op3") as page:
        url = page.url.replace("0.0.0.0", "127.0.0.1")
        token = url.rstrip("/").rsplit("/", 1)[1]
        tab = browser.new_page()
        for wrong in (url.replace(f"{token}/", ""), url.replace(token, "x" * len(token)), url.replace(token, "viser")):
            answer = tab.goto(wrong)
            assert answer is not None
            assert answer.status == 403
        tab.close()
        page.link.begin(INFO)
        page.link.publish(TICK)
        tab = opened(url)
        take_control(tab)
        tab.click("#stop")
        until(lambda: page.link.read().halt is Halt.ORDERLY)
    says(tab, "#banner", "has ended")


def test_space_stops_a_run_and_a_killed_page_leaves_it_alone(opened: Callable[..., Any], tmp_path: Path) -> None:
    def start(*words: str) -> tuple[subprocess.Popen[str], str]:
        line = [sys.executable, "-m", "servoid.tools.cli", "run", "walk", "--policy", "gait", *words]
        process = subprocess.Popen(
            [*line, "--view", "--view-port", "0"], stdout=subprocess.PIPE, text=True, cwd=tmp_path
        )
        assert process.stdout is not None
        return process, process.stdout.readline().split()[1]

    run, url = start("--seconds", "600", "--set", "vx=0.1")
    with run:
        tab = opened(url)
        says(tab, "#phase", "running")
        knee = f"document.querySelector('#joints tbody tr:nth-child({KNEE + 1})').cells[1].textContent"
        tab.wait_for_function(f"before => {knee} != before", arg=tab.evaluate(knee))
        tab.keyboard.press(" ")
        said = run.communicate()[0]
    assert run.returncode == 130
    assert "a person asked to stop" in said
    run, _ = start("--seconds", "1")
    with run:
        children = Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()
        pages = [pid for pid in children if "browser.process" in Path(f"/proc/{pid}/cmdline").read_text()]
        os.kill(int(pages[0]), signal.SIGKILL)
        run.communicate()
    assert run.returncode in (0, 1)


def slide(tab: Any, what: str, value: float, *, held: bool = False) -> None:
    """Push a slider of the panel; one that is `held` is not let go."""
    script = """([what, value, held]) => {
      const slider = document.querySelector(`#panel [data-do="${what}"]`);
      slider.value = value;
      slider.dispatchEvent(new Event("input"));
      if (!held) slider.dispatchEvent(new Event("change"));
    }"""
    tab.evaluate(script, [what, value, held])


def test_skills_panels_and_a_soft_start(page: OpenPage, opened: Callable[..., Any]) -> None:
    link = page.link
    link.begin(replace(INFO, skills=("wave", "kick-left")))
    tab = opened(page.url)
    take_control(tab)
    tab.fill("#gain", "0.8")
    tab.uncheck("#record")
    requests: list[Any] = []
    again(lambda: tab.click("#start button"), lambda: requests.append(link.take("start")) or requests[-1])
    assert (requests[-1].gain, requests[-1].on) == (0.8, False)
    again(lambda: tab.click("#skills button:has-text('kick left')"), lambda: link.read().skill == "kick-left")
    link.show(Panel("jog", (Slider("jog", "l_knee", -1.0, 1.0, 0.0, springs=True), Question(3, "Support the robot"))))
    says(tab, "#panel", "Support the robot")
    slide(tab, "jog", 0.5, held=True)
    until(lambda: link.read().way.tolist() == [0.5, 0.0, 0.0])
    tab.evaluate("document.querySelector('#panel [data-do=jog]').dispatchEvent(new Event('pointerup'))")
    until(lambda: not link.read().way.any())
    actions: list[str] = []
    again(
        lambda: tab.click("#panel [data-do=yes]"),
        lambda: actions.extend(a.value for a in link.take_actions()) or actions,
    )
    assert actions[0] == "yes 3"
    link.show(None)
    tab.wait_for_function("document.querySelector('#panel').hidden")


def test_a_wave_is_made_in_the_browser_and_is_a_clip(opened: Callable[..., Any], tmp_path: Path) -> None:
    editor = Editor(ROBOT, tmp_path)
    with open_page(View(port=0), "op3") as page:
        program = threading.Thread(target=KeyframePage(page.link, editor, "op3").run)
        program.start()
        tab = opened(page.url)
        take_control(tab)

        def press(what: str, happened: Callable[[], object]) -> None:
            again(lambda: tab.click(f"#panel [data-do={what}]"), happened)

        elbow = ROBOT.names.index("r_el")
        for number, angle in enumerate((0.6, -0.2, 0.6), 1):
            press("add", lambda number=number: len(editor.frames) > number)
            again(
                lambda angle=angle: slide(tab, "joint r_el", angle),
                lambda angle=angle: abs(editor.frame.pose.joints[elbow] - angle) < 0.02,
            )
        again(
            lambda: slide(tab, "joint r_sho_pitch", 0.8),
            lambda: abs(editor.frame.pose.joints[ROBOT.names.index("r_sho_pitch")] - 0.8) < 0.02,
        )
        tab.fill("#panel [data-do=name]", "browser-wave")
        tab.keyboard.press("Tab")
        until(lambda: editor.name == "browser-wave")
        press("play", lambda: "in physics, open loop: it stands at the end" in editor.said)
        until(lambda: editor.played is None)
        tab.click("#panel [data-do=save]")
        until(lambda: editor.saved)
    program.join()
    assert np.ptp(Library(ROBOT, tmp_path)["browser-wave"].joints[:, elbow]) > 0.6


def test_a_browser_without_webgl_has_all_but_the_picture(page: OpenPage, playwright: Any) -> None:
    flags = ["--no-sandbox", "--disable-3d-apis", "--disable-gpu"]
    started = playwright.chromium.launch(executable_path=CHROMIUM, args=flags)
    try:
        tab = started.new_page(viewport={"width": 1400, "height": 1000}, bypass_csp=True)
        tab.set_default_timeout(100_000)
        tab.goto(page.url)
        says(tab, "#flat-why", "it has no WebGL")
        says(tab, "#phase", "running")
        tab.click("#stop")
        until(lambda: page.link.read().halt is Halt.ORDERLY)
    finally:
        started.close()

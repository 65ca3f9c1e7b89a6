"""The page in a real browser: Debian's Chromium, without a window, its WebGL in software."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from waiting import until

pytestmark = pytest.mark.slow

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install 'servoid[test]'")
if CHROMIUM is None:
    pytest.skip("no chromium on this machine: apt-get install chromium", allow_module_level=True)


class Command:
    """A `servoid` command that runs, with a page."""

    def __init__(self, folder: Path, *words: str) -> None:
        self.log = folder / f"{len(list(folder.glob('*.mcap')))}.mcap"
        line = [sys.executable, "-m", "servoid.tools.cli", *words, "--view-port", "0"]
        if words[0] == "run":
            line += ["--record", str(self.log)]
        self.process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=folder)
        self.said = ""
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        until(lambda: "page: http" in self.said or self.process.poll() is not None, "no page came up")
        assert "page: http" in self.said, self.said
        self.url = self.said.split("page: ")[1].split()[0]

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.said += line

    def end(self) -> int:
        """Wait for it; its exit code."""
        code = self.process.wait()
        self._reader.join()
        return code

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._reader.join()
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture
def command(tmp_path: Path) -> Iterator[Any]:
    begun: list[Command] = []

    def start(*words: str) -> Command:
        begun.append(Command(tmp_path, *words))
        return begun[-1]

    yield start
    for one in begun:
        one.close()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        gl = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *gl])
        yield started
        started.close()


def opened(browser: Any, url: str, picture: bool = False) -> Any:
    """A page that shows numbers; with the picture in 3D, which a busy machine without a graphics card draws slowly."""
    page = browser.new_page(viewport={"width": 1400, "height": 1000}, bypass_csp=True)
    page.set_default_timeout(60_000)
    page.goto(url if picture else url + "#flat")
    page.wait_for_function("document.querySelectorAll('#joints tbody tr').length == 20")
    return page


def phase(page: Any, *wanted: str) -> None:
    page.wait_for_function("wanted => wanted.includes(document.querySelector('#phase').textContent)", arg=list(wanted))


def test_who_opens_the_page_sees_the_robot_move_and_stops_it_by_space(browser: Any, command: Any) -> None:
    run = command("run", "walk", "--policy", "gait", "--seconds", "600", "--set", "vx=0.1", "--view")
    page = opened(browser, run.url, picture=True)
    frame = page.frame_locator("#view")
    frame.locator("canvas").first.wait_for()  # viser draws
    phase(page, "running")
    knee = "() => document.querySelectorAll('#joints tbody tr')[11].cells[1].textContent"
    before = page.evaluate(knee)
    page.wait_for_function(f"before => ({knee})() != before", arg=before)
    page.keyboard.press("Space")
    phase(page, "stopping", "lowering", "damped", "interrupted")
    assert run.end() == 130
    assert "a person asked to stop" in run.said
    page.wait_for_function("document.querySelector('#banner').textContent.includes('person')")
    page.close()


def test_a_person_steers_by_keys_sets_a_goal_and_says_a_sentence(browser: Any, command: Any) -> None:
    run = command("run", "steer", "--policy", "gait", "--seconds", "600", "--view")
    page = opened(browser, run.url)
    phase(page, "running")
    page.keyboard.down("w")  # without control nobody steers
    page.click("#control")
    page.wait_for_function("document.querySelector('#control').textContent == 'Give up control'")
    asked = "() => document.querySelector('#asked').textContent"
    page.wait_for_function(f"() => ({asked})().includes('+0.15')")  # 0.6 of 0.25 m/s
    page.keyboard.up("w")
    page.wait_for_function(f"() => ({asked})().includes('+0.00 +0.00')")
    page.click("#map", position={"x": 150, "y": 20})
    page.wait_for_function(f"() => ({asked})().includes('goal')")
    page.fill("#sentence", "turn left")
    page.click("#say button")
    page.wait_for_function(f"() => ({asked})().includes('turn left')")
    page.click("#end")
    assert run.end() == 0
    page.close()


def test_a_browser_that_is_gone_lets_the_robot_rest_and_be_lowered(browser: Any, command: Any) -> None:
    run = command("run", "steer", "--policy", "gait", "--seconds", "600", "--view")
    page = opened(browser, run.url)
    phase(page, "running")
    page.click("#control")
    page.wait_for_function("document.querySelector('#control').textContent == 'Give up control'")
    page.keyboard.down("w")
    page.wait_for_function("document.querySelector('#asked').textContent.includes('+0.15')")
    page.close()
    assert run.end() == 4
    assert "not heard for 0.3 s: resting" in run.said
    assert "not heard for 2 s" in run.said


def test_of_two_browsers_one_is_in_control_and_the_other_may_stop(browser: Any, command: Any) -> None:
    run = command("run", "steer", "--policy", "gait", "--seconds", "600", "--view")
    one, other = opened(browser, run.url), opened(browser, run.url)
    phase(one, "running")
    one.click("#control")
    other.wait_for_function("document.querySelector('#control').textContent == 'Somebody else is in control'")
    other.click("#control")
    other.wait_for_function("document.querySelector('#answer').textContent.includes('somebody else')")
    other.click("#stop")
    assert run.end() == 130
    one.close()
    other.close()


def test_a_page_for_other_machines_is_closed_without_its_token(browser: Any, command: Any) -> None:
    run = command("run", "walk", "--policy", "gait", "--seconds", "600", "--view", "--view-host", "0.0.0.0")
    token = run.url.rstrip("/").rsplit("/", 1)[1]
    assert len(token) > 15
    page = browser.new_page()
    for wrong in (run.url.replace(token, ""), run.url.replace(token, token[:-1] + "?"), run.url + "../viser/"):
        answer = page.goto(wrong.replace("0.0.0.0", "127.0.0.1"))
        assert answer.status == 403
    page.close()
    page = opened(browser, run.url.replace("0.0.0.0", "127.0.0.1"))
    phase(page, "running")
    page.click("#stop")
    assert run.end() == 130
    page.close()


def test_a_page_that_is_killed_leaves_the_run_alone(command: Any) -> None:
    run = command("run", "walk", "--policy", "gait", "--seconds", "2", "--view")
    children = Path(f"/proc/{run.process.pid}/task/{run.process.pid}/children").read_text().split()
    pages = [pid for pid in children if "browser.process" in Path(f"/proc/{pid}/cmdline").read_text()]
    assert len(pages) == 1
    os.kill(int(pages[0]), signal.SIGKILL)
    assert run.end() in (0, 1)
    assert "traceback" not in run.said.lower()

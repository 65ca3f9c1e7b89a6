"""Make the pictures of the page that are in docs/: `python -m servoid.tools.web.screenshots docs [NAME ...]`.

It needs Chromium and playwright, both of which `make test` installs. The robot walks on while a slow machine draws.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from servoid.hw.config import ConfigError

SIZE = {"width": 1400, "height": 980}
WEBGL = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
DRAW_SECONDS = 8.0  # that software needs for a first picture on two busy cores
PATIENCE = 300.0  # s
WALK = ("goal", "--set", "x=40", "--policy", "gait")


@contextmanager
def command(*words: str) -> Iterator[str]:
    """A `servoid` command with a page, at any free port: the page's address. Raises ConfigError where none comes up."""
    line = [str(Path(sys.executable).with_name("servoid")), *words, "--view-port", "0"]
    process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    said = ""
    try:
        for text in process.stdout:
            said += text
            if text.startswith("page: "):
                yield text.split()[1]
                return
        raise ConfigError(f"no page came up: {said}")
    finally:
        process.terminate()
        process.communicate()


Take = Callable[[Any, Path, Path], None]  # browser, file of the picture, folder for other files


def main(folder: Path, names: Sequence[str] = ()) -> None:
    """Make the pictures of those names, by default all. Raises ConfigError for an unknown one."""
    from playwright.sync_api import sync_playwright

    for name in names:
        if name not in PICTURES:
            raise ConfigError(f"no picture '{name}': known are {', '.join(PICTURES)}")
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        raise ConfigError("no chromium on this machine: apt-get install chromium")
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as at:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(WEBGL))
        for name in names or PICTURES:
            PICTURES[name](browser, folder / f"page-{name}.png", Path(at))
        browser.close()


def _run(browser: Any, picture: Path, at: Path) -> None:
    with command("run", *WALK, "--set", "y=2", "--seconds", "600", "--view", "--record", str(at / "run.mcap")) as url:
        page = _open(browser, url)
        page.wait_for_function("document.querySelector('#phase').textContent == 'running'")
        page.wait_for_timeout(1e3 * DRAW_SECONDS)
        page.screenshot(path=picture)
        page.close()


def _view(browser: Any, picture: Path, at: Path) -> None:
    with command("view", str(_logged(at, 1))) as url:
        _shown(browser, url, picture)


def _two(browser: Any, picture: Path, at: Path) -> None:
    with command("view", str(_logged(at, 1)), str(_logged(at, 2))) as url:
        _shown(browser, url, picture)


def _operate(browser: Any, picture: Path, at: Path) -> None:
    with command("operate", "--policy", "gait", "--logs", str(at)) as url:
        page = _open(browser, url)
        _take_control(page)
        page.screenshot(path=picture)
        page.close()


def _virtual(browser: Any, picture: Path, at: Path) -> None:
    with command("virtual", "--view", "--powered") as url:
        _shown(browser, url, picture)


def _bringup(browser: Any, picture: Path, at: Path) -> None:
    """A robot that is calibrated: it stands beside its reference pose."""
    with command("bringup", "calibrate", "--port", "virtual", "--pose", "home", "--view") as url:
        page = _open(browser, url)
        page.wait_for_function("document.querySelector('#panel table tbody tr')")
        page.wait_for_timeout(1e3 * DRAW_SECONDS)
        page.screenshot(path=picture)
        page.close()


def _keyframes(browser: Any, picture: Path, at: Path) -> None:
    with command("motions", "keyframes", "authored", "--clip", "punch-right", "--out", str(at)) as url:
        page = _open(browser, url)
        _take_control(page)
        page.click("#panel button[data-value='2']")
        page.wait_for_timeout(1e3 * DRAW_SECONDS)
        page.screenshot(path=picture)
        page.close()


PICTURES: dict[str, Take] = {
    "run": _run,
    "view": _view,
    "two": _two,
    "operate": _operate,
    "virtual": _virtual,
    "bringup": _bringup,
    "keyframes": _keyframes,
}


def _logged(at: Path, seed: int) -> Path:
    """The log of a short walk, made once."""
    log = at / f"{seed}.mcap"
    if not log.exists():
        line = [str(Path(sys.executable).with_name("servoid")), "run", *WALK, "--seconds", "8", "--seed", str(seed)]
        subprocess.run(
            [*line, "--set", f"y={3 * seed - 4}", "--record", str(log)], stdout=subprocess.DEVNULL, check=False
        )
    return log


def _take_control(page: Any) -> None:
    page.click("#control")
    page.wait_for_function("document.querySelector('#control').textContent == 'Give up control'")


def _shown(browser: Any, url: str, picture: Path) -> None:
    page = _open(browser, url)
    page.wait_for_timeout(1e3 * DRAW_SECONDS)
    page.screenshot(path=picture)
    page.close()


def _open(browser: Any, url: str) -> Any:
    """A page that keeps its picture, however slowly it is drawn."""
    page = browser.new_page(viewport=SIZE, bypass_csp=True)
    page.set_default_timeout(1e3 * PATIENCE)
    page.goto(url + "#picture")
    page.wait_for_function("document.querySelector('#robot').textContent")
    page.frame_locator("#view").locator(".mantine-Notification-closeButton").click()  # that it draws in software
    return page


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])

"""Make the pictures of the page that are in docs/: `python -m servoid.tools.web.screenshots docs`.

It needs Chromium and playwright, both of which `make test` installs. The robot walks on while a slow machine draws.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from servoid.hw.config import ConfigError

SIZE = {"width": 1400, "height": 980}
WEBGL = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
DRAW_SECONDS = 8.0  # that software needs for a first picture on two busy cores
PATIENCE = 120.0  # s


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


def main(folder: Path) -> None:
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as at:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(WEBGL))
        log = str(Path(at) / "run.mcap")
        walk = ["goal", "--set", "x=40", "--set", "y=2", "--policy", "gait", "--seconds", "600"]
        with command("run", *walk, "--view", "--record", log) as url:
            page = _open(browser, url)
            page.wait_for_function("document.querySelector('#phase').textContent == 'running'")
            page.wait_for_timeout(1e3 * DRAW_SECONDS)
            page.screenshot(path=folder / "page-run.png")
            page.close()
        with command("view", log) as url:
            page = _open(browser, url)
            page.wait_for_timeout(1e3 * DRAW_SECONDS)
            page.screenshot(path=folder / "page-view.png")
            page.close()
        with command("operate", "--policy", "gait", "--logs", at) as url:
            page = _open(browser, url)
            page.click("#control")
            page.wait_for_function("document.querySelector('#control').textContent == 'Give up control'")
            page.screenshot(path=folder / "page-operate.png")
            page.close()
        with command("virtual", "--view", "--powered") as url:
            page = _open(browser, url)
            page.wait_for_timeout(1e3 * DRAW_SECONDS)
            page.screenshot(path=folder / "page-virtual.png")
            page.close()
        browser.close()


def _open(browser: Any, url: str) -> Any:
    """A page that keeps its picture, however slowly it is drawn."""
    page = browser.new_page(viewport=SIZE, bypass_csp=True)
    page.set_default_timeout(1e3 * PATIENCE)
    page.goto(url + "#picture")
    page.wait_for_function("document.querySelector('#robot').textContent")
    page.frame_locator("#view").locator(".mantine-Notification-closeButton").click()  # that it draws in software
    return page


if __name__ == "__main__":
    main(Path(sys.argv[1]))

"""docs/new-task.md, done to the letter in a folder of its own: its files are written, its commands are typed."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from servoid.stack.tasks.terms.weights import Weights

ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "docs" / "new-task.md").read_text()


def block(language: str) -> str:
    (text,) = re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    return text


def servoid(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "servoid", *arguments], cwd=folder, capture_output=True, text=True)


@pytest.mark.slow
def test_what_the_page_says_works_in_a_fresh_folder(tmp_path: Path) -> None:
    (file,) = re.findall(r"Write this into a file `(.*?)`", PAGE)
    (tmp_path / file).write_text(block("python"))
    told = []
    for line in block("sh").splitlines():
        program, *arguments = shlex.split(line)
        assert program == "servoid"
        done = servoid(tmp_path, *arguments)
        assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
        told.append(done.stdout)
    explained, ran, replayed, rolled = told
    assert "come_back.py:ComeBack: walk to a point ahead and come back" in explained
    assert re.search(r"distance +0\.6 +m +distance of the point to walk", explained)
    assert "goal met" in ran
    assert re.search(r"farthest_m: 0\.\d+", ran)
    assert "identical over" in replayed
    assert "not as it was recorded" not in replayed
    assert re.search(r"success_rate +1", rolled)
    (tmp_path / file).write_text(block("python") + "\n# Another one, which does the same.\n")
    (tmp_path / "elsewhere").mkdir()
    replayed = servoid(tmp_path / "elsewhere", "replay", "../there.mcap").stdout
    assert "not as it was recorded: the task's file" in replayed
    assert "identical over" in replayed


def test_every_weight_of_the_cost_is_on_the_page() -> None:
    for name in Weights.__dataclass_fields__:
        assert f"`{name}`" in PAGE

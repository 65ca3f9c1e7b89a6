"""Classes of a user's own: found by file or by entry point, and errors that name the file and the line."""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path

import pytest

from servoid.hw.config import ConfigError
from servoid.hw.plugins import Portable, import_file, load_plugin
from servoid.hw.setting import Setting

GROUP = "servoid.tests"


def load(name: str) -> object:
    plugin = load_plugin(name, GROUP, Setting, "setting")
    assert plugin is not None
    return plugin.cls


GOOD = "from servoid.hw.setting import Setting\n\n\nclass Mine(Setting):\n    pass\n"


def test_a_class_is_found_in_a_file_by_its_name_or_as_the_only_one(tmp_path: Path) -> None:
    file = tmp_path / "return.py"  # which no module could be called
    file.write_text(GOOD)
    assert load(f"{file}:Mine") is load(str(file))
    plugin = load_plugin(str(file), GROUP, Setting, "setting")
    assert plugin is not None
    assert (plugin.file, plugin.line) == (file, 4)
    source = plugin.source()
    assert source["class"] == "Mine"
    assert len(source["sha256"]) == 64


def test_a_file_may_use_its_neighbours_and_hides_no_module(tmp_path: Path) -> None:
    (tmp_path / "neighbour_of_mine.py").write_text("TEXT = 'here'\n")
    file = tmp_path / "json.py"
    file.write_text(f"from neighbour_of_mine import TEXT\nimport argparse\n{GOOD}")
    load(f"{file}:Mine")
    import json

    assert json.loads("1") == 1


@pytest.mark.parametrize(
    ("content", "name", "words"),
    [
        (GOOD, "mine.py:Mien", r"mine\.py:1: there is no class 'Mien'; did you mean 'Mine'\?"),
        (GOOD, "mien.py:Mine", r"mien\.py: no such file; did you mean 'mine\.py'\?"),
        (GOOD.replace("(Setting)", ""), "mine.py:Mine", r"mine\.py:4: .*Mine: not a setting: extend servoid\.hw\.set"),
        ("Mine = 3\n", "mine.py:Mine", r"mine\.py:1: .*Mine: not a setting"),
        ("", "mine.py", r"mine\.py:1: has no setting class: write mine\.py:CLASS"),
        (f"{GOOD}class Too(Mine):\n    pass\n", "mine.py", r"has 2 setting classes \(Mine, Too\): write"),
        ("x = 1\ny = x / 0\n", "mine.py:Mine", r"mine\.py:2: ZeroDivisionError: division by zero"),
        ("def f():\n    return {}['a']\n\n\nf()\n", "mine.py:Mine", r"mine\.py:2: KeyError: 'a'"),
        ("x = 1\nclass Mine(:\n", "mine.py:Mine", r"mine\.py:2: SyntaxError: invalid syntax"),
        ("import no_such_module\n", "mine.py:Mine", r"mine\.py:1: ModuleNotFoundError: No module named 'no_such"),
        ("import sys\nsys.exit(3)\n", "mine.py:Mine", r"mine\.py:2: SystemExit: 3"),
    ],
)
def test_what_cannot_be_used_names_file_and_line(tmp_path: Path, content: str, name: str, words: str) -> None:
    (tmp_path / "mine.py").write_text(content)
    with pytest.raises(ConfigError, match=words) as refused:
        load(str(tmp_path / name))
    assert str(tmp_path) in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


def test_what_was_mended_is_read_anew(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("1 / 0\n")
    with pytest.raises(ConfigError):
        load(str(file))
    file.write_text(GOOD)
    load(f"{file}:Mine")


def test_an_object_of_it_reaches_another_process(tmp_path: Path) -> None:
    """A planner's process is given the cost of a task that it has never heard of."""
    file = tmp_path / "mine.py"
    file.write_text(f"{GOOD}\n    def answer(self) -> int:\n        return 42\n")
    carried = tmp_path / "carried"
    carried.write_bytes(pickle.dumps(Portable(import_file(file).Mine("text"))))
    code = f"import pickle; print(pickle.load(open({str(carried)!r}, 'rb')).answer())"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "42"


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installed package with two entry points, one of which is broken."""
    info = tmp_path / "foreign-1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: foreign\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\nmine = foreign_mine:Mine\nbroken = foreign_mine:Gone\n")
    (tmp_path / "foreign_mine.py").write_text(GOOD)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def test_a_class_is_found_by_the_entry_point_of_an_installed_package(package: Path) -> None:
    plugin = load_plugin("mine", GROUP, Setting, "setting")
    assert plugin is not None
    assert plugin.source()["package"] == "foreign 1.2"
    assert (plugin.file, plugin.line) == (package / "foreign_mine.py", 4)
    assert load_plugin("other", GROUP, Setting, "setting") is None
    with pytest.raises(ConfigError, match=r"entry point 'broken = foreign_mine:Gone' of foreign 1\.2"):
        load("broken")

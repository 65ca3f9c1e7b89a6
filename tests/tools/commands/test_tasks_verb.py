"""`servoid tasks`: a line for each task, and every setting of one."""

from __future__ import annotations

import json
from argparse import Namespace
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest

from servoid.hw.config import ConfigError
from servoid.stack.tasks import load_settings, names
from servoid.tools.commands import tasks


def show(capsys: pytest.CaptureFixture[str], task: str | None = None, as_json: bool = False) -> str:
    assert tasks.main(Namespace(task=task, json=as_json)) == 0
    return capsys.readouterr().out


def keys(settings: Any, prefix: str = "") -> set[str]:
    found = set()
    for f in fields(settings):
        value = getattr(settings, f.name)
        found |= keys(value, f"{prefix}{f.name}.") if is_dataclass(value) else {prefix + f.name}
    return found


def test_tasks_are_listed_one_line_each_in_eighty_columns(capsys: pytest.CaptureFixture[str]) -> None:
    lines = show(capsys).splitlines()
    assert [line.split()[0] for line in lines[: len(names())]] == list(names())
    assert len(lines) == len(names()) + 2
    assert max(len(line) for line in lines) <= 80


@pytest.mark.parametrize("name", names())
def test_every_setting_is_explained_in_eighty_columns(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    (described,) = json.loads(show(capsys, name, as_json=True))["tasks"]
    rows = {row["key"]: row for row in described["settings"]}
    assert rows.keys() == keys(load_settings(name))
    assert [key for key, row in rows.items() if not row["text"]] == []
    typed = {key: row["value"] for key, row in rows.items() if row["value"]}
    assert load_settings(name, typed) == load_settings(name), "a value is not shown as it is typed"
    lines = show(capsys, name).splitlines()
    assert max(len(line) for line in lines) <= 80
    assert {line.split()[0] for line in lines if line.startswith("  ") and line[2] != " "} >= rows.keys()


def test_a_task_that_cannot_be_loaded_does_not_hide_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    info = tmp_path / "foreign-1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: foreign\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(
        "[servoid.tasks]\nrest = foreign_rest:Rest\nbroken = foreign_gone:Gone\nwalk = foreign_rest:Rest\n"
    )
    (tmp_path / "foreign_rest.py").write_text(
        "from servoid.stack.tasks.stand import Stand\n\n\nclass Rest(Stand):\n    name = description = 'rest'\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    listed = {line.split()[0]: line for line in show(capsys).splitlines() if line}
    assert listed["rest"].endswith("rest")
    assert "No module named 'foreign_gone'" in listed["broken"]
    assert "velocity" in listed["walk"], "Servoid's own hides a namesake"
    (described,) = json.loads(show(capsys, "rest", as_json=True))["tasks"]
    assert described["source"]["package"] == "foreign 1.2"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("class Mine(BaseTask):\n    pass\n", r"mine\.py:2: Mine: name or description missing: write name = "),
        ("class Mine:\n    pass\n", r"mine\.py:2: .*not a task: extend servoid\.stack\.tasks\.base\.BaseTask"),
        (
            "class S(Settings):\n    def __init__(self, distance): ...\n\n\nclass Mine(BaseTask):\n"
            "    name = description = 'mine'\n    settings_type = S\n",
            r"mine\.py:6: the defaults of S: .*missing 1 required positional argument: 'distance'",
        ),
    ],
)
def test_a_class_that_is_no_task_is_refused_with_file_and_line(tmp_path: Path, content: str, words: str) -> None:
    (tmp_path / "mine.py").write_text(f"from servoid.stack.tasks import BaseTask, Settings\n{content}")
    with pytest.raises(ConfigError, match=words):
        tasks.describe(str(tmp_path / "mine.py:Mine"))

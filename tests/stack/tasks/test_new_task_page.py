"""The example of docs/new-task.md, as a reader would type it in."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path
from types import ModuleType

import pytest

import servoid.hw.config
import servoid.stack.tasks
from servoid.stack.runtime.run import RunSettings, run
from servoid.stack.tasks.guidance import Weights
from servoid.tools.commands.tasks import describe

ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "docs" / "new-task.md").read_text()


def block(language: str) -> str:
    (text,) = re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    return text


@pytest.fixture
def written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The example in place: its module, its file of settings, its line in the table."""
    configs = tmp_path / "configs"
    shutil.copytree(servoid.hw.config.CONFIGS, configs)
    (configs / "tasks" / "return.yaml").write_text(block("yaml"))
    monkeypatch.setattr(servoid.hw.config, "CONFIGS", configs)
    module = ModuleType("return_task")
    monkeypatch.setitem(sys.modules, "return_task", module)
    exec(compile("from __future__ import annotations\n" + block("python"), "new-task.md", "exec"), module.__dict__)
    monkeypatch.setitem(servoid.stack.tasks._TASKS, "return", (module.Return, module.Return.description))
    return module


def test_the_example_walks_there_and_back(written: ModuleType) -> None:
    described = describe("return")
    assert described["description"] == "walk to a point ahead and come back"
    assert {row["key"]: row["value"] for row in described["settings"]}["distance"] == "0.6"
    result = run(RunSettings("return", policy="gait", set={"distance": "0.3"}))
    assert result.outcome == "succeeded"
    assert 0.15 < result.metrics["farthest_m"] < 0.7


def test_every_weight_of_the_cost_is_on_the_page() -> None:
    for name in Weights.__dataclass_fields__:
        assert f"`{name}`" in PAGE

"""No value that can be typed is an internal error: each verb with odd values for each of its options.

All that would take long is refused at its beginning, so that what is seen is what happens before.
"""

from __future__ import annotations

import os
import subprocess
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NoReturn

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from servoid.hw.config import ConfigError
from servoid.sim.rig.process.control import RigProcess
from servoid.sim.rig.process.server import Server
from servoid.sim.worlds import Worlds
from servoid.stack.log.format import FORMAT
from servoid.stack.log.recorder import Recorder
from servoid.stack.runtime.run import Run
from servoid.tools.cli import VERBS, main, parser_of
from servoid.tools.common.worker_pool import Worker
from servoid.tools.learn.takes.maker import TakeMaker

ODD = (
    "", ".", "..", "/", "-1", "0", "1", "nan", "1e999", "1e-320", "folder", "folder/", "missing", "missing.yaml",
    "missing/missing.mp4", "binary", "binary/x", "text.yaml", "list.yaml", "binary.safetensors", "a.py:B", "a.py",
    "/dev/null", "a,b", ",", "=", "x=", "~", "%s", "{}", "\n", "\x1b[2J", "*", "x" * 300, "x" * 5000, "ä", "--",
    os.fsdecode(b"\xff\xfe"), os.fsdecode(b"\xff.yaml"),
)  # fmt: skip
# What a verb cannot do without. The others have no such arguments, or take the port of a virtual rig.
NEEDED = {
    "run": "walk", "rollout": "walk --workers 1", "replay": "a.mcap", "export": "a.mcap --csv", "plot": "a.mcap",
    "evaluate": "papers --rows uniphys/goal-near --workers 1", "collect": "--out o", "completion": "bash",
    "train tracker": "--out o", "train odometry": "--policy gait", "train latent": "--data d --out o",
    "train diffusion": "--data d --out o", "train planner": "--out o",
    "train prior": "--data d --out o", "train policy": "--task speed --prior prior --out o",
    "motions import": "a.mcap --name n --caption c --licence MIT --out lib",
    "motions list": "--library lib", "motions play": "k --library lib", "motions check": "k --library lib",
    "motions author": "authored --out o", "motions keyframes": "--out o",
    "motions retarget": "a.bvh --licence MIT --out o",
    "motions film": "k --library lib --out o",
    "motions mirror": "k --library lib --out o",
    "motions blend": "k l --name n --library lib --out o",
    "bringup setup": "l_knee --port virtual", "bringup jog": "l_knee --port virtual",
}  # fmt: skip
HERE = ("doctor", "bench policy", "bench clients", "bench fuzz")  # measure in this process, at once
COMMANDS = {f"{name} {n}".strip(): v for name, verb in VERBS.items() for n, v in (verb.verbs or {"": verb}).items()}


def refused(*_: object, **__: object) -> NoReturn:
    raise ConfigError("here the work would begin")


@pytest.fixture(autouse=True)
def nothing_begins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for owner, name in ((Run, "connect"), (Worker, "__init__"), (RigProcess, "__init__"), (Server, "serve"),
                        (Worlds, "__init__"), (TakeMaker, "__init__"), (BaseProcess, "start"),
                        (subprocess.Popen, "__init__")):  # fmt: skip
        monkeypatch.setattr(owner, name, refused)
    monkeypatch.setattr("servoid.stack.log.provenance.git_commit", lambda: "unknown")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "binary").write_bytes(bytes(range(256)))
    (tmp_path / "binary.safetensors").write_bytes(bytes(range(256)))
    (tmp_path / "text.yaml").write_text("a: 1\n")
    (tmp_path / "list.yaml").write_text("- 1\n")
    Recorder.create(tmp_path / "a.mcap", {"format": FORMAT}, wait=True).close({})


def lines(name: str) -> st.SearchStrategy[list[str]]:
    """Command lines of a verb with an odd value for one of its arguments."""
    needed = NEEDED.get(name, "--port virtual" if name.startswith("bringup") else "").split()
    actions = [action for action in parser_of("servoid", COMMANDS[name])._actions if action.dest != "help"]
    places = [action for action in actions if not action.option_strings]

    def with_value(drawn: tuple[Any, str]) -> list[str]:
        action, value = drawn
        words = list(needed)
        if not action.option_strings:
            at = places.index(action)
            return [*words[:at], value, *words[at + 1 :]]
        option = action.option_strings[-1]
        if option in words:
            del words[words.index(option) : words.index(option) + 2]
        return [*words, option] if action.nargs == 0 else [*words, f"{option}={value}"]

    typed = st.characters(blacklist_categories=["Cs"], blacklist_characters="\0")
    values = st.sampled_from(ODD) | st.text(typed, max_size=8)
    return st.tuples(st.sampled_from(actions), values).map(with_value)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in HERE])
@settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_no_odd_value_is_an_internal_error(name: str, data: st.DataObject, capsys: pytest.CaptureFixture[str]) -> None:
    words = data.draw(lines(name))
    code = main([*name.split(), *words])
    said = capsys.readouterr().err
    assert code in (0, 1, 2, 3, 4), said
    assert "internal error" not in said
    assert "Traceback" not in said

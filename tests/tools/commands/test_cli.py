"""The `servoid` command as a person meets it: quick help, one-line errors, exit codes, one line of JSON."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import BackendError
from servoid.tools import cli
from servoid.tools.common.output import reporting, to_json
from servoid.tools.common.parser import Parser, add_set_argument, settings


def servoid(*args: str, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "servoid", *args], capture_output=True, text=True, **options)


def test_help_loads_nothing_that_is_slow_to_load() -> None:
    code = (
        "import sys, servoid.tools.cli; code = servoid.tools.cli.main(['--help']); "
        "heavy = ('torch', 'mujoco', 'servoid.stack', 'servoid.sim', 'servoid.policy'); "
        "tools = sorted(m for m in sys.modules if m.startswith('servoid.tools.')); "
        "print(code, [m for m in heavy if m in sys.modules], *(m.split('.')[-1] for m in tools), file=sys.stderr)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stderr.strip() == "0 [] cli common exit_codes output parser"
    for verb in cli.VERBS:
        assert verb in result.stdout


def test_help_of_every_verb_fits_80_columns(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    words = [[]]
    for name, verb in cli.VERBS.items():
        words += [[name], *([name, sub] for sub in verb.verbs or ())]
    for line in words:
        assert cli.main([*line, "--help"]) == 0
        shown = capsys.readouterr().out
        assert [row for row in shown.splitlines() if len(row) > 80] == [], line


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["tsaks"], "servoid: unknown command 'tsaks'; did you mean 'tasks'?"),
        (["xyzzy"], "servoid: unknown command 'xyzzy'; known: tasks, doctor, run"),
        (["train", "trackr"], "servoid train: unknown command 'trackr'; did you mean 'tracker'?"),
        (["tasks", "--jsno"], "servoid tasks: unknown option '--jsno'; did you mean '--json'?"),
        (["tasks", "goal", "walk"], "servoid tasks: unknown argument 'walk'"),
        (["tasks", "gaol"], "servoid: unknown task 'gaol': did you mean 'goal'?"),
        (["--jason"], "servoid: unknown option '--jason'"),
        (["rollout", "walk", "--robot=--"], "servoid rollout: argument --robot: '--' is no value"),
        (["bench"], "servoid bench: command missing; known: text-to-motion, sim, policy, guidance, ideal, loop"),
        ([], "servoid: command missing; known: tasks"),
    ],
)
def test_usage_errors_are_one_line_and_code_2(argv: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(argv) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(words)
    assert captured.err.count("\n") == 1
    assert captured.out == ""


@pytest.fixture
def verb(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Any], int]], None]:
    """Put a function in place of the `tasks` verb."""

    def install(function: Callable[[Any], int]) -> None:
        module = ModuleType("tools.fake")
        module.add_arguments = lambda parser: parser.add_argument("--json", action="store_true")  # type: ignore[attr-defined]
        module.main = function  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "tools.fake", module)
        monkeypatch.setitem(cli.VERBS, "tasks", cli.Verb("fake", "tools.fake"))

    return install


def raises(error: BaseException) -> Callable[[Any], int]:
    def main(args: Any) -> int:
        with reporting(args.json):
            raise error

    return main


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (ConfigError("robot.yaml:3: rate: must be positive"), 2, "servoid: robot.yaml:3: rate: must be positive"),
        (BackendError("/dev/ttyUSB0: no such port"), 3, "servoid: /dev/ttyUSB0: no such port"),
        (KeyboardInterrupt(), 130, "servoid: interrupted"),
        (ZeroDivisionError("a\nb"), 70, "servoid: internal error: ZeroDivisionError: a b (SERVOID_DEBUG=1"),
        (OSError(36, "File name too long", "x" * 5000), 2, "servoid: xxx"),
        (PermissionError(13, "Permission denied", "/root/a"), 2, "servoid: /root/a: Permission denied: choose another"),
        (BrokenPipeError("planner"), 70, "servoid: internal error: BrokenPipeError: planner"),
        (ModuleNotFoundError("No module named 'av'", name="av"), 2, "servoid: this needs the 'video' extra"),
        (ModuleNotFoundError("No module named 'hw.x'", name="hw.x"), 70, "servoid: internal error"),
    ],
)
def test_exceptions_end_with_their_exit_code(
    error: BaseException, code: int, line: str, verb: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    verb(raises(error))
    assert cli.main(["tasks"]) == code
    captured = capsys.readouterr()
    assert captured.err.startswith(line)
    assert captured.err.count("\n") == 1

    assert cli.main(["tasks", "--json"]) == code
    answer = json.loads(capsys.readouterr().out)
    assert answer["exit_code"] == code
    assert line.removeprefix("servoid: ") in answer["error"]


def test_debug_shows_where(verb: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SERVOID_DEBUG", "1")
    verb(raises(ZeroDivisionError("x")))
    assert cli.main(["tasks"]) == 70
    assert "Traceback" in capsys.readouterr().err


def test_exit_code_of_a_verb_is_passed_on(verb: Any) -> None:
    verb(lambda args: 4)
    assert cli.main(["tasks"]) == 4


def test_json_is_the_only_thing_on_stdout() -> None:
    """Whatever prints meanwhile: Python, a C library, or a child process."""
    code = """if True:
        import os, subprocess, sys
        from servoid.tools.common.output import reporting
        with reporting(True) as report:
            report.line("line")
            print("print")
            os.write(1, b"library\\n")
            subprocess.run(["echo", "child"], check=True)
            report.result({"a": 1})
        print("after")
    """
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout == '{"a": 1}\nafter\n'
    assert {"line", "print", "library", "child"} <= set(result.stderr.split())


@pytest.mark.parametrize(
    "words",
    [
        "rollout walk --episodes 0",
        "rollout walk --workers -1",
        "rollout walk --seed -1",
        "rollout walk --backend dynamixel",
        "run walk --seed -1",
        "evaluate papers --minutes -1",
        "evaluate papers --seed -1",
        "evaluate papers --rows nothing/*",
        "virtual --clock locked",
        "virtual --seed -1",
        "bench bus --cycles 0",
        "bench bus --baud 9600",
        "bench faults --seeds 0",
        "bench faults --fault nothing",
        "bench fuzz --streams 0",
        "bench fuzz --seed -1",
        "bench interrupt --times 0",
        "bench kill --kills -1",
        "bench soak --share 2",
        "bench soak --seed -1",
    ],
)
def test_a_bad_argument_is_answered_in_json_too(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A script that reads the answer would else find nothing, and a seed below zero was an internal error."""
    assert cli.main([*words.split(), "--json"]) == 2
    (line,) = capsys.readouterr().out.splitlines()
    answer = json.loads(line)
    assert answer["exit_code"] == 2
    assert "internal" not in answer["error"]


def test_json_is_standard_json() -> None:
    import numpy as np

    values = {"nan": float("nan"), "array": np.array([1.0, np.inf]), "count": np.int64(3), "flag": np.bool_(True)}
    assert json.loads(to_json(values)) == {"nan": None, "array": [1.0, None], "count": 3, "flag": True}


@pytest.mark.slow
def test_tasks_lists_every_setting() -> None:
    result = servoid("tasks", "--json", check=True)
    assert result.stdout.count("\n") == 1
    tasks = {task["name"]: task for task in json.loads(result.stdout)["tasks"]}
    assert {"stand", "walk", "goal"} <= tasks.keys()
    walk = {row["key"]: row["value"] for row in tasks["walk"]["settings"]}
    assert walk["vx"] == "-0.1:0.3"
    assert walk["cost.velocity"] == "1"
    # What is listed can be typed as it is.
    from servoid.stack.tasks import load_settings

    assert load_settings("walk", walk) == load_settings("walk")
    assert "yaw_rate" in servoid("tasks", "walk", check=True).stdout


def test_a_reader_that_leaves_is_no_error() -> None:
    """`servoid tasks | head -1` must not end in a traceback."""
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as closed:
        result = subprocess.run(
            [sys.executable, "-m", "servoid", "tasks"], stdout=closed, stderr=subprocess.PIPE, text=True
        )
    assert result.returncode == 141
    assert result.stderr == ""


def test_settings_are_read_in_pairs() -> None:
    parser = Parser(prog="x")
    add_set_argument(parser)
    assert settings(parser.parse_args(["--set", "vx=0.6", "--set", "a=b=c"])) == {"vx": "0.6", "a": "b=c"}
    for argv in (["--set", "vx"], ["--set", "=3"], ["--set", "a=1", "--set", "a=2"]):
        with pytest.raises(ConfigError, match="--set"):
            settings(parser.parse_args(argv))

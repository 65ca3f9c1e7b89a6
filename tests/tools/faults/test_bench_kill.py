"""`servoid bench kill` and `bench interrupt`, a few of each: a real run on a rig in real time ends with torque off."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from servoid.tools.cli import main
from servoid.tools.faults.controller import Controller
from servoid.tools.faults.kill import _last, summarise

TRIES = 3  # in real time a machine that is busy enough has the guard stop any run, Ctrl-C or not

SAID = """\
 running  tilt  1.2 deg  tick 1.3 ms, p99 22.2
  0.00 s  not enough rights for a steady loop
  1.62 s  l_knee: 81 degrees C
stopped by the guard after 1.0 s
      velocity_error_mps: nan
              distance_m: 0.084
51 ticks, 0 missed, late p50 0.00 ms, p99 0.00 ms
     log: run.mcap
"""

# A run that ends by the Ctrl-C, and its guardian, which does its work after that.
RUN = """#!{python}
import pathlib, signal, subprocess, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # who starts tests in the background has it ignored
work = "import sys, time; time.sleep(1.0); print('servoid guardian: torque is off', file=sys.stderr)"
subprocess.Popen([sys.executable, "-c", work, "guardian.py"], start_new_session=True)
print({said!r}, file=sys.stderr, flush=True)
pathlib.Path({ready!r}).touch()
try:
    time.sleep(60.0)
except KeyboardInterrupt:
    sys.exit(130)
"""


def figures(words: list[str], capfd: pytest.CaptureFixture[str]) -> dict[str, Any]:
    code = main([*words, "--json"])
    out, err = capfd.readouterr()
    assert code == 0, err
    values: dict[str, Any] = json.loads(out)
    return values


@pytest.mark.slow
def test_a_controller_that_is_killed_leaves_no_torque_and_a_log(capfd: pytest.CaptureFixture[str]) -> None:
    """By the rig's own record: the guardian after it braked, and with it killed too, the watchdog. One that does
    nothing within the second that the bench gives it is counted as never."""
    values = figures(["bench", "kill", "--kills", "2", "--unguarded", "1"], capfd)
    assert values["runs"] == values["all_damped"] == values["all_off"] == 2
    assert values["unguarded_runs"] == values["unguarded_all_stopped"] == 1
    assert values["logs_read"] == 3
    assert 0.0 < values["median_ms"] <= values["worst_ms"]
    assert values["unguarded_worst_ms"] > 0.0


def test_servos_that_never_went_off_are_counted_and_have_a_bound() -> None:
    """The worst time would else be none at all, as if nothing was the matter."""
    rows = [
        {"guarded": True, "damped": True, "off": True, "ms": 60.0, "walking": True, "log": True},
        {"guarded": True, "damped": False, "off": False, "ms": _last({0: 40.0}, 2), "walking": True, "log": True},
        {"guarded": False, "stopped": False, "ms": _last({}, 2), "walking": True, "log": True},
    ]
    values = summarise(rows, 0)
    assert (values["never_off"], values["worst_ms"]) == (1, 1000.0)
    assert (values["unguarded_never_stopped"], values["unguarded_worst_ms"]) == (1, 1000.0)
    assert _last({0: 40.0, 1: 60.02}, 2) == 60.0


@pytest.mark.slow
def test_ctrl_c_ends_with_torque_off_that_all_servos_acknowledged(capfd: pytest.CaptureFixture[str]) -> None:
    for _ in range(TRIES):
        values = figures(["bench", "interrupt", "--times", "2"], capfd)
        assert values["runs"] == values["all_off"] == 2
        assert values["guardian_needed"] == 0
        assert values["void"] == values["void_all_off"]
        assert set(values["other_codes"]) <= {4}, "on a busy machine the guard may have stopped it a moment before"
        if not values["other_codes"]:
            break
    assert values["acknowledged"] + values["late"] == 2
    assert values["acknowledged"] >= 1, "only the run that is interrupted twice may be too late to say so"


@pytest.mark.slow
def test_an_interrupted_run_is_judged_after_its_guardian(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Or what the guardian had to do would not be seen. The last words are how it ended, without the figures."""
    program, ready = tmp_path / "run", tmp_path / "ready"
    program.write_text(RUN.format(python=sys.executable, said=SAID, ready=str(ready)))
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    rig: Any = SimpleNamespace(port="none", control=SimpleNamespace(call=lambda verb: {"now": 7}))
    with Controller(rig, tmp_path / "run.mcap") as controller:
        assert controller.wait_for(lambda control: ready.exists())
        assert controller.last_words() == "1.62 s  l_knee: 81 degrees C; stopped by the guard after 1.0 s"
        assert controller.interrupt() == 7
        assert controller.wait() == 130
        assert controller.last_words() == "stopped by the guard after 1.0 s; servoid guardian: torque is off"
        assert controller.interrupt() == 7, "it has ended, and no guardian is left"


def test_what_cannot_be_counted_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "kill", "--kills", "-1"]) == 2
    assert main(["bench", "interrupt", "--times", "0"]) == 2
    assert "both must be at least 1" in capsys.readouterr().err

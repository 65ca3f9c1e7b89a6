"""`servoid bench faults`: a small campaign, and that its judges see what must be seen."""

from __future__ import annotations

import json

import pytest

from servoid.hw.robot.description import load_robot
from servoid.sim.rig.wire.faults import EXPECTED
from servoid.stack.safety.guard import LOWER_SECONDS, REST_SECONDS
from servoid.tools.cli import main
from servoid.tools.common.worker_pool import Lost
from servoid.tools.faults.campaign import QUICK, lost, summarise
from servoid.tools.faults.trial import Trial, Verdict, unsafe_goals

ROBOT = load_robot()
KNEE = ROBOT.names.index("l_knee")
TICK_NS = 20_000_000


def goal(tick: float, position: float, register: str = "goal_position", value: int = 0) -> dict[str, object]:
    return {
        "time_ns": round(tick * TICK_NS), "joint": KNEE, "register": register, "value": value, "position": position
    }  # fmt: skip


ON = goal(0, 0.0, "torque_enable", 1)


@pytest.mark.slow
def test_a_quick_campaign_goes_as_declared(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["bench", "faults", "--quick", "--seeds", "1", "--workers", "1", "--deadline", "600", "--json"]
    assert main(command) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["problems"] == []
    assert set(result["per_fault"]) == set(QUICK)
    absorbed = sum(EXPECTED[kind].value == "absorbed" for kind in QUICK)
    wanted = {"runs": len(QUICK), "ended_running": absorbed, "ended_damped": len(QUICK) - absorbed}
    wanted |= {"unsafe_goals": 0, "unnamed_faults": 0, "hangs": 0, "deaths": 0, "falls": 0}
    assert {key: result[key] for key in wanted} == wanted
    assert 1 <= result["worst_detection_ticks"] <= 10
    for kind, found in result["per_fault"].items():
        orderly = REST_SECONDS + LOWER_SECONDS if EXPECTED[kind].value == "named" else 0.0
        assert (found["worst_off_seconds"] or 0.0) <= 0.5 + orderly, kind


def test_goals_are_judged_by_range_and_by_speed() -> None:
    step = ROBOT.limits.joint_speed * ROBOT.dt
    assert unsafe_goals(ROBOT, [ON, goal(1, 0.5), goal(2, 0.5 + step), goal(4, 0.5 + 3 * step)]) == []
    (far,) = unsafe_goals(ROBOT, [ON, goal(1, ROBOT.upper[KNEE] + 0.01)])
    assert "l_knee" in far
    assert "outside its range" in far
    (fast,) = unsafe_goals(ROBOT, [ON, goal(1, 0.5), goal(2, 0.5 - 1.1 * step)])
    assert "from the one before" in fast
    off = goal(3, 0.0, "torque_enable", 0)
    assert unsafe_goals(ROBOT, [ON, off, goal(4, 0.5), goal(5, 1.5)]) == [], "it drives nothing"


def test_the_summary_counts_what_was_not_named_what_hung_and_what_died() -> None:
    late = Verdict("dead", 1, "fatal", named=True, detection_ticks=11, ended="damped", problems=["late"])
    good = Verdict("dead", 2, "fatal", named=True, detection_ticks=3, ended="damped", off_seconds=0.4)
    calm = Verdict("drop", 1, "absorbed")
    stuck = lost(Trial("drop", 2), Lost("hung", "did not end within 1 s", TimeoutError()))
    gone = lost(Trial("dead", 3), Lost("died", "exit code -11", RuntimeError()))
    result = summarise([late, good, calm, stuck, gone])
    assert (result["unnamed_faults"], result["ended_running"], result["ended_damped"]) == (1, 1, 2)
    assert (result["hangs"], result["deaths"]) == (1, 1)
    assert result["worst_detection_ticks"] == 11
    assert result["per_fault"]["drop"]["hangs"] == 1
    assert "--fault dead --first 1: late" in result["problems"]
    assert "--fault dead --first 3: exit code -11" in result["problems"]


def test_an_unknown_fault_is_answered_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "faults", "--fault", "ded"]) == 2
    assert "dead" in capsys.readouterr().err

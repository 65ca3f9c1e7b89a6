from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from waiting import until

from servoid.hw.contracts.control import Instruction, Plan, PlanRequest
from servoid.stack.control.planning.planner import InlinePlanner, PlannerError, ProcessPlanner


def request(tick: int, seed: int = 0) -> PlanRequest:
    seeds = np.array(seed)
    return PlanRequest(tick, np.zeros((4, 53)), np.zeros((4, 20)), Instruction(np.zeros(3)), seeds=seeds)


def answer(asked: PlanRequest, seconds: float = 0.0, fail_at: int = -1) -> Plan:
    """A plan whose actions tell who asked; slow or failing where told to."""
    time.sleep(seconds)
    if asked.tick == fail_at:
        raise ValueError("the cost went wrong")
    return Plan(asked.tick, np.full((16, 20), 1000.0 * asked.seeds + asked.tick), asked.states, np.zeros((16, 2)), 0.0)


def build(seconds: float = 0.0, fail_at: int = -1) -> Callable[[PlanRequest], Plan]:
    return partial(answer, seconds=seconds, fail_at=fail_at)


def answer_gated(asked: PlanRequest, planned: Path, gate: Path) -> Plan:
    """Notes what is asked in `planned`, and plans when there is a file `gate`."""
    with planned.open("a") as file:
        file.write(f"{asked.tick}\n")
    until(gate.exists)
    return answer(asked)


def build_gated(planned: Path, gate: Path) -> Callable[[PlanRequest], Plan]:
    return partial(answer_gated, planned=planned, gate=gate)


def build_badly() -> Callable[[PlanRequest], Plan]:
    raise FileNotFoundError("no such weights")


def ask(planner: ProcessPlanner, tick: int) -> Plan | None:
    planner.submit(request(tick))
    return planner.collect(tick, wait=True)


def until_ready(planner: ProcessPlanner, tick: int) -> Plan:
    found: list[Plan] = []
    until(lambda: found.extend(filter(None, [planner.collect(tick, wait=False)])) or found)
    return found[0]


def test_inline_and_process_planners_answer_alike() -> None:
    inline, process = InlinePlanner(build()), ProcessPlanner(build)
    try:
        for seed in (1, 2):
            for planner in (inline, process):
                planner.reset()
                planner.submit(request(8, seed))
            plans = [planner.collect(8, wait=True) for planner in (inline, process)]
            assert [plan.actions[0, 0] for plan in plans if plan] == [1000 * seed + 8] * 2
            assert inline.collect(8, wait=True) is None  # once
            assert process.collect(8, wait=True) is None
    finally:
        process.close()


def test_a_slow_planner_never_blocks_and_plans_only_the_newest_of_what_waits(tmp_path: Path) -> None:
    planned, gate = tmp_path / "planned", tmp_path / "gate"
    planner = ProcessPlanner(partial(build_gated, planned, gate))
    try:
        for tick in (0, 4, 8):
            planner.submit(request(tick))  # whoever waits for a plan does so for ever
            assert planner.collect(tick, wait=False) is None
        planner.submit(request(12))
        gate.touch()
        assert until_ready(planner, 12).tick == 12
        assert planned.read_text().split() == ["0", "12"]  # 4 and 8 were not wanted any more
    finally:
        planner.close()


def test_a_plan_of_the_episode_before_is_not_handed_out() -> None:
    planner = ProcessPlanner(partial(build, seconds=0.3))
    try:
        planner.reset()
        planner.submit(request(0, 1))
        planner.reset()
        planner.submit(request(0, 2))
        plan = planner.collect(0, wait=True)
        assert plan is not None
        assert plan.actions[0, 0] == 2000
    finally:
        planner.close()


def test_an_exception_in_the_process_is_reported_with_its_reason() -> None:
    planner = ProcessPlanner(partial(build, fail_at=4))
    try:
        planner.submit(request(4))
        with pytest.raises(PlannerError, match="the cost went wrong"):
            planner.collect(4, wait=True)
        with pytest.raises(PlannerError, match="ended with code 0"):
            ask(planner, 8)
    finally:
        planner.close()


def test_a_killed_process_is_reported_and_not_waited_for() -> None:
    planner = ProcessPlanner(partial(build, seconds=0.2))
    try:
        planner.submit(request(0))
        pid = planner._process.pid
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
        with pytest.raises(PlannerError, match="killed by signal 9"):
            planner.collect(0, wait=True)
    finally:
        planner.close()


def test_a_planner_that_cannot_start_says_why() -> None:
    with pytest.raises(PlannerError, match="no such weights"):
        ProcessPlanner(build_badly)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_the_group_leaves_the_process_to_the_loop(number: signal.Signals) -> None:
    planner = ProcessPlanner(build)
    try:
        pid = planner._process.pid
        assert pid is not None
        os.kill(pid, number)
        planner.submit(request(0))
        assert planner.collect(0, wait=True) is not None
    finally:
        planner.close()


def test_the_process_dies_with_its_parent() -> None:
    code = """
        import os, sys, time
        from functools import partial
        sys.path[:0] = sys.argv[1].split(os.pathsep)
        from test_planner import build
        from servoid.stack.control.planning.planner import ProcessPlanner
        if __name__ == "__main__":
            planner = ProcessPlanner(partial(build, seconds=0.0))
            print(planner._process.pid, flush=True)
            time.sleep(60)
    """
    parent = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code), os.pathsep.join(sys.path)], stdout=subprocess.PIPE, text=True
    )
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    assert alive(child)
    parent.kill()
    parent.wait()
    parent.stdout.close()
    until(lambda: not alive(child))


@pytest.mark.parametrize("seconds", [0.0, 3600.0])
def test_a_program_that_forgets_to_close_ends_all_the_same(seconds: float) -> None:
    """Idle or in the middle of a plan: multiprocessing's own end is a SIGTERM, which the process does not heed."""
    code = """
        import os, sys
        from functools import partial
        sys.path[:0] = sys.argv[1].split(os.pathsep)
        from test_planner import build, request
        from servoid.stack.control.planning.planner import ProcessPlanner
        if __name__ == "__main__":
            planner = ProcessPlanner(partial(build, seconds=float(sys.argv[2])))
            planner.submit(request(0))
    """
    command = [sys.executable, "-c", textwrap.dedent(code), os.pathsep.join(sys.path), str(seconds)]
    assert subprocess.run(command).returncode == 0


def alive(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False

"""Action files: pages, chains and timing as the firmware has them, from small files made for it."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.tools.motions.action_file import UNIT, chain, joint_goals, read_pages

ROBOT = load_robot()
KNEE = ROBOT.names.index("l_knee")
TICK = 2 * np.pi / 4096
NO_GOAL = 0x4000


def page(
    *steps: tuple[dict[int, int], int, int],
    name: str = "move",
    speed: int = 32,
    acceleration: int = 8,
    next: int = 0,
    repeat: int = 1,
    schedule: int = 10,
) -> bytes:
    """A page of steps `(goals by ID, time, pause)`, with the right checksum."""
    raw = bytearray(512)
    raw[: len(name)] = name.encode()
    raw[15], raw[16], raw[20], raw[22], raw[24], raw[25] = repeat, schedule, len(steps), speed, acceleration, next
    for i, (goals, time, pause) in enumerate(steps[:7]):
        words = [goals.get(id, NO_GOAL) for id in range(31)]
        raw[64 * (i + 1) : 64 * (i + 2)] = struct.pack("<31H", *words) + bytes((pause, time))
    raw[31] = (0xFF - sum(raw)) & 0xFF
    return bytes(raw)


def file(folder: Path, pages: dict[int, bytes]) -> Path:
    path = folder / "motion.bin"
    path.write_bytes(b"".join(pages.get(i, bytes(512)) for i in range(256)))
    return path


def knee(folder: Path, *steps: tuple[int, int, int], **options: int) -> np.ndarray:
    """Goals of the knee, from its centre on, for steps `(encoder ticks, time, pause)`."""
    path = file(folder, {7: page(*[({14: goal}, time, pause) for goal, time, pause in steps], **options)})
    return joint_goals(chain(read_pages(path), 7, path), ROBOT, np.zeros(20))[:, KNEE]


def test_a_step_takes_its_time_and_ends_at_its_goal(tmp_path: Path) -> None:
    goals = knee(tmp_path, (2048 + 400, 100, 0))
    assert len(goals) == int(100 * UNIT / ROBOT.dt) + 1
    assert goals[0] == 0.0
    assert goals[-1] == pytest.approx(400 * TICK)
    speed = np.diff(goals) / ROBOT.dt
    assert speed[5:-5] == pytest.approx(400 * TICK / (92 * UNIT), rel=1e-6), "it keeps one speed between"
    assert speed[0] < speed[5]
    assert speed[-1] < speed[-5]


def test_it_passes_through_a_goal_on_its_way_and_stops_where_it_turns_back_or_waits(tmp_path: Path) -> None:
    onward = np.diff(knee(tmp_path, (2148, 50, 0), (2248, 50, 0)))
    assert onward[18:22].min() > 0.8 * onward.max(), "no stop between two steps of one direction"
    back = knee(tmp_path, (2148, 50, 0), (2048, 50, 0))
    assert abs(np.diff(back)[19:21]).max() < 0.5 * abs(np.diff(back)).max()
    assert back.max() == pytest.approx(100 * TICK, rel=0.01)
    waited = knee(tmp_path, (2148, 50, 25), (2248, 50, 0))
    assert np.ptp(waited[20:30]) < 1e-9
    assert len(waited) == int(125 * UNIT / ROBOT.dt) + 1


def test_the_pages_speed_stretches_times_and_shortens_pauses(tmp_path: Path) -> None:
    """48 plays times one and a half as long and pauses two thirds."""
    assert len(knee(tmp_path, (2148, 100, 30), speed=48)) == int(170 * UNIT / ROBOT.dt) + 1


def test_a_page_repeats_and_goes_on_with_the_next(tmp_path: Path) -> None:
    pages = {
        7: page(({14: 2148}, 50, 0), ({14: 2048}, 50, 0), repeat=3, next=9),
        9: page(({13: 1948}, 50, 0), name="other"),
    }
    path = file(tmp_path, pages)
    followed = chain(read_pages(path), 7, path)
    assert [p.name for p in followed] == ["move", "other"]
    goals = joint_goals(followed, ROBOT, np.zeros(20))
    assert len(goals) == int(350 * UNIT / ROBOT.dt) + 1
    assert goals[-1, KNEE] == pytest.approx(0.0, abs=1e-9)
    assert goals[-1, ROBOT.names.index("r_knee")] == pytest.approx(-100 * TICK)
    others = np.delete(goals, [KNEE, ROBOT.names.index("r_knee")], axis=1)
    assert not others.any(), "a joint without a goal stays where it is"


@pytest.mark.parametrize(
    ("pages", "said"),
    [
        ({7: page(({14: 2148}, 50, 0), next=8)}, "page 8, which page 7 goes on with, is empty; pages with a motion: 7"),
        (
            {7: page(({14: 1}, 5, 0), next=8), 8: page(({14: 1}, 5, 0), next=7)},
            "the pages from 7 on loop at page 7, so the motion never ends",
        ),
        ({7: page(({14: 1}, 5, 0))[:-1] + b"\x01"}, "page 7: its checksum is wrong"),
        ({7: page(({14: 1}, 5, 0), schedule=0)}, "page 7: its steps are timed by speed"),
        ({7: page(({14: 1}, 5, 0), speed=0)}, "page 7: its play speed is 0"),
        ({7: page(*[({14: 1}, 5, 0)] * 8)}, "page 7: has 8 steps, but only 7 fit"),
        ({}, "none of its pages holds a motion"),
    ],
)
def test_a_file_that_is_wrong_says_where(tmp_path: Path, pages: dict[int, bytes], said: str) -> None:
    path = file(tmp_path, pages)
    with pytest.raises(ConfigError, match=f"motion.bin: .*{said}"):
        chain(read_pages(path), 7, path)


def test_a_file_that_is_cut_or_missing_is_refused(tmp_path: Path) -> None:
    path = file(tmp_path, {7: page(({14: 1}, 5, 0))})
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ConfigError, match="has 131071 bytes instead of 131072: cut off, or not an action file"):
        read_pages(path)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_pages(tmp_path / "none.bin")

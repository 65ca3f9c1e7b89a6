"""Motions of people on the robot: `servoid motions retarget`. The motions here are made up, walking on the spot."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.policy.motion.library import Library
from servoid.tools.cli import main
from servoid.tools.motions.checks import check, sole_corners
from servoid.tools.motions.human.key_points import read
from servoid.tools.motions.standing import Standing

ROBOT = load_robot()
TOLD = ("--name", "made", "--caption", "made for a test", "--licence", "CC0-1.0")
ROTATIONS = "3 Zrotation Xrotation Yrotation"
LEG = [("Thigh", "0 0 0"), ("Shin", "0 -42 0"), ("Foot", "0 -42 0")]
ARM = [("Shldr", "0 45 0"), ("ForeArm", "0 -28 0"), ("Hand", "0 -26 0")]


def joint(name: str, offset: str, inside: str, channels: str = ROTATIONS) -> str:
    return f"JOINT {name} {{ OFFSET {offset} CHANNELS {channels} {inside} }}\n"


def chain(links: list[tuple[str, str]], mark: str, first: str, end: str) -> str:
    text = f"End Site {{ OFFSET {end} }}"
    for name, offset in reversed(links[1:]):
        text = joint(mark + name, offset, text)
    return joint(mark + links[0][0], first, text)


def bvh(tmp_path: Path, *, up: str = "y", channels: str = ROTATIONS, frames: int = 90, lift: float = 35.0) -> Path:
    """A person of 84 cm of leg, at 60 frames a second, that lifts the right foot once by bending hip and knee."""
    limbs = "".join(
        chain(LEG, m, f"{9 * s} 0 0", "0 -5 13") + chain(ARM, m, f"{18 * s} 45 0", "0 -8 0")
        for m, s in (("l", 1), ("r", -1))
    )
    root = "6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
    text = (
        f"ROOT hip {{ OFFSET 0 0 0 CHANNELS {root}\n{joint('neck', '0 50 0', 'End Site { OFFSET 0 20 0 }')}{limbs}}}\n"
    )
    text = text.replace(ROTATIONS, channels)
    names = [word for i, word in enumerate(text.split()) if text.split()[i - 1] in ("JOINT", "ROOT")]
    each = int(channels.split()[0])
    rows = np.zeros((frames, 6 + each * (len(names) - 1)))
    rows[:, 1] = 89.0
    bend = lift * np.sin(np.pi * np.clip((np.arange(frames) - 30) / 30, 0.0, 1.0)) ** 2
    if channels == ROTATIONS:
        for name, share in (("rThigh", -1.0), ("rShin", 2.0), ("rFoot", -1.0)):
            rows[:, 6 + 3 * (names.index(name) - 1) + 1] = share * bend
    if up != "y":  # the same body, its offsets and channels turned onto other axes
        order = {"z": (1, 2, 0), "x": (2, 0, 1)}[up]
        text = turned_offsets(text, order)
    path = tmp_path / "made.bvh"
    lines = "\n".join(" ".join(f"{number:.5f}" for number in row) for row in rows)
    path.write_text(f"HIERARCHY\n{text}MOTION\nFrames: {frames}\nFrame Time: 0.0166667\n{lines}\n")
    return path


def turned_offsets(text: str, order: tuple[int, int, int]) -> str:
    """Axis i of before is axis `order[i]` now."""
    words = text.split()
    for i, word in enumerate(words):
        if word == "OFFSET":
            old = words[i + 1 : i + 4]
            for axis in range(3):
                words[i + 1 + order[axis]] = old[axis]
        elif word[:1] in "XYZ" and word[1:] in ("position", "rotation"):
            words[i] = "XYZ"[order["XYZ".index(word[0])]] + word[1:]
    return " ".join(words) + "\n"


def deepmimic(tmp_path: Path, numbers: int = 44) -> Path:
    turn = [1.0, 0.0, 0.0, 0.0]
    frame = [1 / 30, 0.0, 0.89, 0.0, *turn, *turn, *turn, *turn, 0.0, *turn, *turn, 0.0, *turn, 0.0, *turn, *turn, 0.0]
    path = tmp_path / "made.txt"
    path.write_text(json.dumps({"Loop": "none", "Frames": [frame[:numbers]] * 20}))
    return path


@pytest.mark.slow
def test_a_lifted_foot_is_lifted_and_the_other_stands_still_flat_on_the_ground(tmp_path: Path) -> None:
    pytest.importorskip("mink")
    assert main(["motions", "retarget", str(bvh(tmp_path)), *TOLD, "--out", str(tmp_path / "lib")]) == 0
    clip = Library(ROBOT, tmp_path / "lib")["made"]
    assert check(clip, ROBOT)["wrong"] == []
    corners = sole_corners(clip, ROBOT, Standing(ROBOT).held(clip))
    assert corners[:, 0, :, 2] == pytest.approx(0.0, abs=2e-3)
    assert corners[:, 1, :, 2].max() > 0.015
    assert clip.contact[:, 0].all()
    assert not clip.contact[:, 1].all()
    assert clip.about.source == "made.bvh, retargeted"


@pytest.mark.parametrize("up", ["y", "z"])
def test_either_axis_may_be_up(tmp_path: Path, up: str) -> None:
    motion = read(bvh(tmp_path, up=up))
    assert motion.leg == pytest.approx(84.0)
    assert motion.points["neck"][0] - motion.points["hips"][0] == pytest.approx([0.0, 0.0, 50.0], abs=1e-6)
    assert motion.points["left_hip"][0, 1] > motion.points["right_hip"][0, 1]
    assert motion.stands().mean(0) == pytest.approx([1.0, 0.7], abs=0.2)


def test_deepmimics_humanoid_stands_as_tall_as_it_is(tmp_path: Path) -> None:
    motion = read(deepmimic(tmp_path))
    assert motion.leg == pytest.approx(0.8314, abs=1e-3)
    assert motion.points["left_ankle"][0] == pytest.approx([0.0, 0.0849, 0.0586], abs=1e-3)


def test_what_is_no_motion_of_a_person_is_refused(tmp_path: Path) -> None:
    def refused(path: Path, said: str) -> None:
        with pytest.raises(ConfigError, match=said):
            read(path)

    refused(
        bvh(tmp_path, channels="3 Xposition Yposition Zposition").rename(tmp_path / "p.bvh"), "has no rotation channels"
    )
    refused(bvh(tmp_path, up="x"), "which axis is up is not known")
    whole = bvh(tmp_path).read_text()
    cut = tmp_path / "cut.bvh"
    cut.write_text(whole[: len(whole) // 2])
    refused(cut, "cut off: it says 90 frames, but holds")
    cut.write_text(whole[:200])
    refused(cut, "not a BVH file, or cut off")
    cut.write_text(whole.replace("rShin", "rPart"))
    refused(cut, "no joint for 'right knee'; it has hip, neck")
    refused(deepmimic(tmp_path, 43), "frame 1 has 43 numbers, and DeepMimic's humanoid 44")
    (tmp_path / "made.txt").write_text('{"Frames": [')
    refused(tmp_path / "made.txt", "not a clip of DeepMimic, or cut off")
    refused(tmp_path / "none.bvh", "cannot be read")
    refused(tmp_path / "made.fbx", "not a human motion")


def test_the_command_says_what_is_wrong_with_what_it_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = str(bvh(tmp_path)), str(tmp_path / "lib")
    assert main(["motions", "retarget", path, *TOLD, "--out", out, "--to", "9"]) == 2
    assert "--from 0 --to 9: must be within the 1.50 s" in capsys.readouterr().err
    assert main(["motions", "retarget", path, *TOLD, "--out", out, "--pace", "0"]) == 2
    assert "--pace 0: must be between" in capsys.readouterr().err

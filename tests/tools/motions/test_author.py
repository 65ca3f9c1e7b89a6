"""Clips out of keyframes: `servoid motions author`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servoid.hw.config import ConfigError, load_yaml
from servoid.hw.robot.description import load_robot
from servoid.policy.motion.clip import Clip
from servoid.policy.motion.library import Library
from servoid.tools.cli import main
from servoid.tools.motions.author import author
from servoid.tools.motions.checks import check
from servoid.tools.motions.keyframes import Authored, load_authored
from servoid.tools.motions.physics import play
from servoid.tools.motions.standing import Standing

ROBOT = load_robot()
HEAD = "licence: Apache-2.0\nclips:\n  - name: made\n    captions: [made for a test]\n    frames:\n"


def recipe(tmp_path: Path, *frames: str) -> Authored:
    path = tmp_path / "made.yaml"
    path.write_text(HEAD + "".join(f"      - {{{frame}}}\n" for frame in frames))
    return load_yaml(path, Authored)


def made(tmp_path: Path, *frames: str) -> Clip:
    (clip,) = author(recipe(tmp_path, *frames), ROBOT, "a test")
    return clip


def test_a_crouch_begins_and_ends_at_home_reaches_its_height_and_keeps_its_soles_still(tmp_path: Path) -> None:
    clip = made(tmp_path, "seconds: 0.8, height: 0.2, hold: 0.2", "seconds: 0.8, home: true")
    assert clip.joints[[0, -1]] == pytest.approx(np.stack([ROBOT.home] * 2), abs=1e-3)
    assert clip.root_position[:, 2].min() == pytest.approx(0.2, abs=1e-4)
    assert check(clip, ROBOT)["wrong"] == []
    played = play(clip.joints, ROBOT)
    assert played.stands.all()
    assert played.place[0, :, 2] == pytest.approx(clip.root_position[:, 2], abs=0.012)  # the servos lag


def test_goals_hold_a_robot_on_one_foot_though_its_servos_give(tmp_path: Path) -> None:
    clip = made(
        tmp_path,
        "seconds: 0.8, weight: {left: 1}, lean: [-0.01, 0], height: 0.245",
        "seconds: 0.4, feet: {right: [0, 0, 0.03]}, hold: 0.6",
    )
    assert clip.contact[[0, -1]].tolist() == [[1.0, 1.0], [1.0, 0.0]]
    assert check(clip, ROBOT)["wrong"] == []
    played = play(clip.joints, ROBOT)
    assert played.stands.all()
    assert not played.contact[0, -1, 1]


def test_a_hand_reaches_where_it_is_told_to(tmp_path: Path) -> None:
    clip = made(tmp_path, "seconds: 1, reach: {r_hand: [0.15, -0.08, 0.1]}")
    standing = Standing(ROBOT)
    assert standing.statics.place("r_hand", standing.held(clip)[-1]) == pytest.approx([0.15, -0.08, 0.1], abs=3e-3)


def test_a_keyframe_that_asks_too_much_speed_takes_longer(tmp_path: Path) -> None:
    clip = made(tmp_path, "seconds: 0.1, joints: {head_pan: 1.5}")
    assert np.abs(np.diff(clip.joints, axis=0)).max() <= ROBOT.limits.joint_speed * ROBOT.dt
    assert clip.joints[-1, 0] == pytest.approx(1.5, abs=0.01)


@pytest.mark.parametrize(
    ("frame", "said"),
    [
        ("seconds: 1, height: 0.4", "keyframe 1: the .* foot is .* mm out of reach"),
        ("seconds: 1, reach: {r_hand: [0.5, 0, 0]}", "keyframe 1: reach.r_hand: .* mm out of reach"),
        ("seconds: 1, reach: {r_hnd: [0.1, 0, 0]}", "reach.r_hnd: no such geom: did you mean 'r_hand'"),
        ("seconds: 1, joints: {l_knee: 1}", "joints.l_knee: is a leg's"),
        ("seconds: 1, joints: {head_pan: 2}", "keyframe 1: head_pan goes .* beyond its range"),
        ("seconds: 1, feet: {lft: [0, 0, 0]}", "unknown 'lft': did you mean 'left'"),
        ("seconds: 1, weight: {left: 0.7}", "weight: shares must not be negative, and must add up to 1"),
        ("seconds: 1, feet: {left: [0, 0, 0.03]}", "keyframe 1: the left foot leaves .* 50% of the weight on it"),
        ("seconds: 0", "seconds: must be above 0"),
        ("seconds: 1, hight: 0.2", "unknown key; did you mean 'height'"),
    ],
)
def test_a_keyframe_that_cannot_be_is_refused_with_what_is_wrong(tmp_path: Path, frame: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        made(tmp_path, frame)


def test_the_command_writes_the_clip_and_its_mirror(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "made.yaml"
    path.write_text(HEAD.replace("made for a test", "look left") + "      - {seconds: 0.5, joints: {head_pan: 0.5}}\n")
    path.write_text(path.read_text().replace("    frames", "    mirrored: mirrored\n    frames"))
    assert main(["motions", "author", str(path), "--out", str(tmp_path / "lib")]) == 0
    library = Library(ROBOT, tmp_path / "lib")
    assert library.names == ("made", "mirrored")
    assert library["mirrored"].about.captions == ("look right",)
    assert library["mirrored"].joints[-1, 0] == pytest.approx(-library["made"].joints[-1, 0], abs=1e-3)
    assert main(["motions", "author", str(path), "--clip", "mad", "--out", str(tmp_path / "lib")]) == 2
    assert "did you mean 'made'" in capsys.readouterr().err


def test_shipped_clips_are_those_that_their_keyframes_make() -> None:
    authored, library = load_authored("authored"), Library(ROBOT)
    (nod,) = (clip for clip in authored.clips if clip.name == "nod")
    (clip,) = author(Authored(authored.licence, (nod,)), ROBOT, "a test")
    assert library["nod"].joints == pytest.approx(clip.joints, abs=2e-3)
    assert library["nod"].about.captions == nod.captions

"""Clips keep what they are through files, mirrors, rates and blends, and are refused where they do not fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_clips import ABOUT, walking_in_a_circle

from servoid.hw.config import ConfigError
from servoid.hw.geometry import yaw_of
from servoid.hw.robot.description import load_robot
from servoid.policy import checkpoint
from servoid.policy.motion.clip import About, Clip, load, other_side, read_about, save, velocities
from servoid.policy.motion.library import Library, find

ROBOT = load_robot()
CLIP = walking_in_a_circle(ROBOT)


def same(one: Clip, other: Clip, atol: float = 1e-12) -> None:
    for name in ("joints", "root_position", "root_orientation", "contact"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=atol, err_msg=name)


def test_a_file_holds_the_clip_and_says_what_it_is(tmp_path: Path) -> None:
    path = tmp_path / "circle.safetensors"
    save(CLIP, path, ROBOT)
    same(load(path, ROBOT), CLIP, atol=1e-6)
    name, about, head = read_about(path)
    assert (name, about) == ("circle", ABOUT)
    assert (head["kind"], head["robot"], head["rate"], head["licence"]) == ("clip", "op3", 50, "Apache-2.0")
    same(find(str(path), ROBOT), CLIP, atol=1e-6)


@pytest.mark.parametrize(
    ("robot", "said"),
    [
        (replace(ROBOT, rate=100), "made for 50 ticks a second, but op3 runs at 100"),
        (replace(ROBOT, joints=ROBOT.joints[1:] + ROBOT.joints[:1]), "entry 0 is head_pan, but head_tilt is needed"),
        (replace(ROBOT, joints=ROBOT.joints[:-1]), "20 entries, 19 needed; not known here: r_ank_roll"),
        (replace(ROBOT, feet=dict(reversed(ROBOT.feet.items()))), r"its feet are \['left', 'right'\]"),
    ],
)
def test_a_clip_of_another_robot_or_rate_is_refused(tmp_path: Path, robot: object, said: str) -> None:
    path = tmp_path / "circle.safetensors"
    save(CLIP, path, ROBOT)
    with pytest.raises(ConfigError, match=rf"circle\.safetensors: .*{said}"):
        load(path, robot)  # type: ignore[arg-type]


def test_another_kind_of_file_or_a_cut_one_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="holds a tracker network, but a clip network is needed"):
        load(checkpoint.resolve("expert"), ROBOT)
    path = tmp_path / "circle.safetensors"
    save(CLIP, path, ROBOT)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(ConfigError, match="a truncated one"):
        load(path, ROBOT)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"joints": CLIP.joints[:1]}, "a clip of 1 frames is no motion"),
        ({"contact": CLIP.contact[:-1]}, "contact has 50 frames, and joints 51"),
        ({"root_position": np.full_like(CLIP.root_position, np.nan)}, "not finite"),
    ],
)
def test_frames_that_are_no_motion_are_refused(changes: dict[str, np.ndarray], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        replace(CLIP, **changes)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"captions": ()}, "captions: at least one"),
        ({"captions": ("walk", " ")}, "none may be empty"),
        ({"licence": ""}, "who may use it"),
        ({"begins": "hanging"}, "begins: 'hanging' is none of upright"),
    ],
)
def test_a_clip_without_words_or_a_licence_is_refused(values: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        replace(ABOUT, **values)  # type: ignore[arg-type]


def test_the_mirror_of_the_mirror_is_the_clip() -> None:
    mirrored = CLIP.mirrored(ROBOT, "circle-right")
    assert mirrored.about.captions == ("wave the right hand",)
    assert yaw_of(mirrored.root_orientation)[-1] == pytest.approx(-0.5)
    assert mirrored.root_position[-1, 1] == pytest.approx(-CLIP.root_position[-1, 1])
    left, right = (ROBOT.names.index(name) for name in ("l_knee", "r_knee"))
    np.testing.assert_allclose(mirrored.joints[:, right], -CLIP.joints[:, left])
    same(mirrored.mirrored(ROBOT, "circle"), CLIP)


def test_words_of_a_side_are_swapped_and_others_are_not() -> None:
    assert other_side("kick with the right foot, left of the ball") == "kick with the left foot, right of the ball"
    assert other_side("stand upright") == "stand upright"


def test_twice_as_fast_is_half_as_long_and_goes_the_same_way() -> None:
    fast = CLIP.at_rate(2.0)
    assert fast.ticks == 26
    same(replace(CLIP, **{name: getattr(CLIP, name)[::2] for name in
         ("joints", "root_position", "root_orientation", "contact")}), fast, atol=1e-6)  # fmt: skip
    assert CLIP.at_rate(0.5).ticks == 101


def test_velocities_are_those_of_the_motion() -> None:
    joints, linear, angular = velocities(CLIP, ROBOT.dt)
    seconds = (CLIP.ticks - 1) * ROBOT.dt
    np.testing.assert_allclose(np.linalg.norm(linear, axis=-1), 0.5 / seconds, rtol=1e-3)
    np.testing.assert_allclose(angular[:, 2], 0.5 / seconds, rtol=1e-3)
    assert np.abs(joints).max() == pytest.approx(0.1 * 2 * np.pi / seconds, rel=0.01)


def test_a_blend_goes_on_from_where_the_first_clip_ends() -> None:
    both = CLIP.followed_by(CLIP, blend=10, name="twice")
    assert both.ticks == 2 * CLIP.ticks - 10
    step = np.linalg.norm(np.diff(both.root_position, axis=0), axis=-1)
    assert step.max() < 1.6 * np.median(step), "the base jumps"
    assert np.abs(np.diff(both.joints, axis=0)).max() < 2.5 * np.abs(np.diff(CLIP.joints, axis=0)).max()
    assert 0.7 < yaw_of(both.root_orientation)[-1] < 1.0
    assert both.about.licence == "Apache-2.0"


def test_a_blend_between_lying_and_standing_is_refused() -> None:
    lying = replace(CLIP, about=replace(ABOUT, begins="lying on the front"))
    with pytest.raises(ConfigError, match="ends upright and 'circle' begins lying on the front"):
        CLIP.followed_by(lying, 10, "x")
    with pytest.raises(ConfigError, match="a blend of 60 ticks does not fit"):
        CLIP.followed_by(CLIP, 60, "x")


def test_a_library_is_a_folder(tmp_path: Path) -> None:
    library = Library(ROBOT, tmp_path)
    assert library.names == ()
    path = library.add(CLIP)
    with pytest.raises(ConfigError, match="already exists: choose another name"):
        library.add(CLIP)
    library.add(replace(CLIP, about=About(("turn",), "a formula", "MIT")), replace=True)
    assert Library(ROBOT, tmp_path).names == ("circle",)
    assert Library(ROBOT, tmp_path)["circle"].about.licence == "MIT"
    with pytest.raises(ConfigError, match=r"unknown clip 'cirkle' in .*: did you mean 'circle'"):
        library["cirkle"]
    (tmp_path / "copy.safetensors").write_bytes(path.read_bytes())
    with pytest.raises(ConfigError, match=r"holds a clip called 'circle', and so does circle\.safetensors"):
        Library(ROBOT, tmp_path)
    with pytest.raises(ConfigError, match="no such folder of clips"):
        Library(ROBOT, tmp_path / "none")

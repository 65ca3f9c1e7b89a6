"""Keyframes made at the page: what sliders and hands do to a pose, and a wave that is played on every body."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from page_line import Line

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.policy.motion.library import Library
from servoid.stack.runtime.run import RunSettings, run
from servoid.tools.cli import main
from servoid.tools.motions.editor.editor import SUFFIX, Editor
from servoid.tools.motions.editor.frames import Poser
from servoid.tools.motions.editor.page import KeyframePage
from servoid.tools.web.line.snapshot import Snapshot

ROBOT = load_robot()


@pytest.fixture(scope="module")
def poser() -> Poser:
    return Poser(ROBOT)


@pytest.fixture
def editor(tmp_path: Path) -> Editor:
    return Editor(ROBOT, tmp_path / "clips")


def test_a_hand_that_is_dragged_is_where_it_was_put_and_one_too_far_says_so(editor: Editor) -> None:
    place = editor.poser.handles(editor.frame.pose)["l_hand"] + [0.04, 0.03, 0.08]
    editor.do("drag l_hand", " ".join(map(str, place)))
    np.testing.assert_allclose(editor.poser.handles(editor.frame.pose)["l_hand"], place, atol=3e-3)
    assert editor.said == ""
    editor.do("move l_hand z", "2.0")
    assert "l_hand is" in editor.said
    assert "mm short of there" in editor.said


def test_a_foot_that_is_dragged_is_where_it_was_put_and_the_other_stays(editor: Editor) -> None:
    before = editor.poser.handles(editor.frame.pose)
    editor.do("drag left", " ".join(map(str, before["left"] + [0.03, 0.01, 0.02])))
    after = editor.poser.handles(editor.frame.pose)
    np.testing.assert_allclose(after["left"], before["left"] + [0.03, 0.01, 0.02], atol=2e-3)
    np.testing.assert_allclose(after["right"], before["right"], atol=2e-3)


def test_what_a_limp_robot_was_put_into_is_taken_and_comes_back(poser: Poser) -> None:
    pose = poser.with_joint(poser.home, "l_sho_roll", 0.4)
    pose = poser.with_foot(poser.with_base(pose, "height", 0.2), "left", np.array([0.03, 0.05, 0.02]))
    pose = poser.with_base(pose, "tilt pitch", 0.2)
    joints, _, _ = poser.solved(pose)
    taken = poser.taken(joints, poser.home, arms_alone=False)
    np.testing.assert_allclose(poser.solved(taken)[0], joints, atol=0.03)
    arms = poser.taken(joints, poser.home, arms_alone=True)
    assert arms.joints[ROBOT.names.index("l_sho_roll")] == pytest.approx(0.4)
    np.testing.assert_allclose(arms.feet, poser.home.feet)


def test_a_motion_mirrored_twice_is_itself(poser: Poser) -> None:
    pose = poser.with_foot(poser.with_joint(poser.home, "r_el", 0.7), "right", np.array([0.02, -0.06, 0.03]))
    pose = poser.with_weight(poser.with_base(pose, "tilt roll", 0.1), 0.8)
    once = poser.mirrored(pose)
    assert once.weight[1] == pytest.approx(0.8)
    np.testing.assert_allclose(
        poser.solved(once)[0][ROBOT.names.index("l_el")], -0.7 if ROBOT.mirror[1][4] < 0 else 0.7
    )
    for part, was in zip(vars(poser.mirrored(once)).values(), vars(pose).values(), strict=True):
        np.testing.assert_allclose(part, was, atol=1e-6)


@pytest.mark.parametrize(
    ("what", "value", "said"),
    [
        ("seconds", "soon", "seconds: 'soon' is no number from 0.05 to 20"),
        ("seconds", "-1", "no number from"),
        ("joint l_el", "nan", "no number from"),
        ("joint l_elbow", "1", "'joint l_elbow' is nothing that a keyframe has"),
        ("drag l_hand", "1 2", "a place has three numbers"),
        ("drag nose", "1 2 3", "neither a hand nor a foot"),
        ("choose", "7", "no number from 1 to 1"),
        ("name", "../wave", "must be of letters"),
        ("remove", "", "at least one keyframe"),
        ("take", "", "give its port with --port"),
        ("shutdown", "", "'shutdown' is nothing"),
    ],
)
def test_what_cannot_be_is_refused_and_changes_nothing(editor: Editor, what: str, value: str, said: str) -> None:
    before = editor.frames[:]
    with pytest.raises(ConfigError, match=said.replace("(", r"\(")):
        editor.do(what, value)
    assert editor.frames == before


def test_a_keyframe_that_cannot_be_reached_is_named_on_the_page(editor: Editor) -> None:
    line = Line()
    page = KeyframePage(line.link, editor, "op3")
    for what, value in (("add", ""), ("move left z", "0.08"), ("save", "")):
        line.ask("do", what=what, value=value)
    page.look()
    text = next(value for kind, value in reversed(line.told()) if kind == "panel")["items"][0]["text"]  # type: ignore[index, call-overload]
    assert "keyframe 2: the left foot leaves the ground with 50% of the weight on it" in text


@pytest.mark.slow
def test_a_wave_made_at_the_page_is_played_in_physics_on_sim_and_on_the_virtual_rig(tmp_path: Path) -> None:
    line, editor = Line(), Editor(ROBOT, tmp_path / "clips")
    page = KeyframePage(line.link, editor, "op3")
    up = " ".join(map(str, editor.poser.handles(editor.frame.pose)["r_hand"] + [0.05, -0.08, 0.12]))
    asked = [("drag r_hand", up), ("seconds", "0.8")]
    for angle in ("0.5", "-0.3", "0.5"):
        asked += [("add", ""), ("seconds", "0.4"), ("joint r_el", angle)]
    asked += [("add", ""), ("home", ""), ("seconds", "0.8"), ("name", "my-wave"), ("captions", "wave, wave to us")]
    asked += [("mirrored", "my-wave-left"), ("play", ""), ("save", "")]
    for what, value in asked:
        line.ask("do", what=what, value=value)
        page.look(0.02)
    shown = [value for _, value in line.told() if isinstance(value, Snapshot)]
    assert shown[0].handles is not None
    assert any(snapshot.phase == "playing" for snapshot in shown)
    assert "saved" in editor.said
    library = Library(ROBOT, tmp_path / "clips")
    assert set(library.names) == {"my-wave", "my-wave-left"}
    elbow = library["my-wave"].joints[:, ROBOT.names.index("r_el")]
    assert np.count_nonzero(np.diff(np.sign(np.diff(elbow[np.abs(np.gradient(elbow)) > 1e-4])))) >= 3, "it waves"
    again = tmp_path / "again"
    assert main(["motions", "author", str(tmp_path / "clips" / f"my-wave{SUFFIX}"), "--out", str(again)]) == 0
    np.testing.assert_allclose(Library(ROBOT, again)["my-wave"].joints, library["my-wave"].joints, atol=1e-3)
    clip = str(library.path("my-wave"))
    for backend in ("sim", "virtual"):
        most = []
        settings = RunSettings("stand", backend=backend, policy=clip, seconds=4.0)
        result = run(settings, on_tick=lambda record, most=most: most.append(record.observation.position))
        assert result.success, (backend, result.events)
        elbows = np.array(most)[:, ROBOT.names.index("r_el")]
        assert np.ptp(elbows) > 0.6, f"{backend} waved"

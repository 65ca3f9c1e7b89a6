"""`servoid motions`, from a file to a library and what is done with its clips."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_clips import walking_in_a_circle
from test_action_file import file, page

from servoid.hw.robot.description import load_robot
from servoid.policy.motion.library import Library
from servoid.tools.cli import main
from servoid.tools.motions.bodies import body_error
from servoid.tools.motions.physics import play

ROBOT = load_robot()
HOME = {joint.id: round(2048 + home * 4096 / (2 * np.pi)) for joint, home in zip(ROBOT.joints, ROBOT.home, strict=True)}
Motions = Callable[..., tuple[int, dict[str, Any], str]]


@pytest.fixture
def motions(capsys: pytest.CaptureFixture[str]) -> Motions:
    def call(*words: object) -> tuple[int, dict[str, Any], str]:
        code = main(["motions", *map(str, words), "--json"])
        out, err = capsys.readouterr()
        return code, json.loads(out.splitlines()[-1]), err

    return call


@pytest.fixture
def nod(tmp_path: Path, motions: Motions) -> Path:
    """A library with one clip: the head turns to the left and back."""
    turned = HOME | {19: HOME[19] + 500}
    path = file(tmp_path, {7: page((turned, 80, 10), (HOME, 80, 0), name="nod")})
    folder = tmp_path / "clips"
    told = ("--caption", "look to the left", "--licence", "Apache-2.0", "--out", folder)
    code, answer, err = motions("import", path, "--page", 7, "--name", "look-left", *told)
    assert code == 0, err
    assert answer["clips"][0]["seconds"] == pytest.approx(170 * 0.008 + 0.5, abs=0.03)
    return folder


def test_a_page_becomes_a_clip_that_stands_and_says_where_it_comes_from(nod: Path, motions: Motions) -> None:
    (listed,) = motions("list", "--library", nod)[1]["clips"]
    assert listed["source"] == "motion.bin, pages 7"
    assert listed["captions"] == ["look to the left"]
    clip = Library(ROBOT, nod)["look-left"]
    assert clip.joints[:, 0].max() == pytest.approx(500 * 2 * np.pi / 4096, abs=0.01)
    assert clip.root_position[:, 2].min() > 0.9 * ROBOT.standing_height
    code, played, _ = motions("play", "look-left", "--library", nod)
    assert (code, played["stands_share"]) == (0, 1.0)
    assert played["joint_error_rad"] < 0.1
    assert 0.0 < played["body_error_m"] < 0.015
    code, checked, _ = motions("check", "--library", nod)
    assert checked["clips"][0]["beyond_range_rad"] == 0.0


def test_a_folder_is_played_a_row_a_clip(nod: Path, motions: Motions) -> None:
    """And a robot that does not do what the clip says is far from it."""
    still = Library(ROBOT, nod)["look-left"]
    moved = still.joints + 0.0
    moved[:, 2] -= 1.0  # an arm
    Library(ROBOT, nod).add(replace(still, name="arm", joints=moved, about=replace(still.about, mirror="")))
    code, answer, err = motions("play", "--library", nod)
    assert code == 0, err
    assert [row["clip"] for row in answer["clips"]] == ["arm", "look-left"]
    for key in ("stands_share", "body_error_m"):
        assert answer["all"][key] == pytest.approx(np.mean([row[key] for row in answer["clips"]]))
    played = play(still.joints, ROBOT)
    near, far = (body_error(played, Library(ROBOT, nod)[name], ROBOT)[0] for name in ("look-left", "arm"))
    assert 2.0 * near < far


def test_clips_are_mirrored_and_blended_into_new_files(nod: Path, motions: Motions) -> None:
    code, answer, err = motions("mirror", "look-left", "--library", nod, "--out", nod)
    assert (code, answer["name"]) == (0, "look-right"), err
    both = ("blend", "look-left", "look-right", "--name", "look-around", "--library", nod, "--out", nod)
    assert motions(*both)[0] == 0
    library = Library(ROBOT, nod)
    assert library.names == ("look-around", "look-left", "look-right")
    head = library["look-around"].joints[:, 0]
    assert head.max() == pytest.approx(-head.min(), abs=0.02)
    code, answer, _ = motions(*both)
    assert code == 2
    assert "already exists" in answer["error"]
    assert motions(*both, "--replace")[0] == 0


def test_a_clip_that_goes_too_far_fails_the_check(tmp_path: Path, motions: Motions) -> None:
    clip = walking_in_a_circle(ROBOT)
    clip.joints[10] += 2.0
    Library(ROBOT, tmp_path).add(clip)
    code, answer, _ = motions("check", "--library", tmp_path)
    assert code == 1
    assert {"beyond_range_rad", "speed_share"} <= set(answer["clips"][0]["wrong"])


def test_a_run_becomes_a_clip(tmp_path: Path, motions: Motions, monkeypatch: pytest.MonkeyPatch) -> None:
    log = tmp_path / "walk.mcap"
    run = ["run", "walk", "--policy", "gait", "--set", "vx=0.15", "--seconds", "2", "--fast", "--record", str(log)]
    assert main(run) in (0, 1)
    told = ("--caption", "walk forward", "--licence", "Apache-2.0", "--out", tmp_path / "clips")
    code, answer, err = motions("import", log, "--name", "walk", *told)
    assert code == 0, err
    clip = Library(ROBOT, tmp_path / "clips")["walk"]
    assert answer["clips"][0]["ticks"] == clip.ticks == pytest.approx(100, abs=2)
    assert clip.root_position[-1, 0] > 0.1
    cut = ("import", log, "--name", "cycle", "--measured", "--part", 1, 1.5, "--loop", *told)
    assert motions(*cut)[0] == 0
    cycle = Library(ROBOT, tmp_path / "clips")["cycle"]
    assert (cycle.ticks, cycle.about.loop) == (25, True)
    off = np.abs(cycle.joints - clip.joints[50:75])
    assert 0.01 < off.max() < 0.5, "joints are not quite where their goals are"
    code, answer, _ = motions("import", log, "--name", "late", "--part", 1, 5, *told)
    assert code == 2
    assert "--part 1 5: the task of" in answer["error"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ("import", "{}/walk.c3d", "--name", "x"),
            "a flight log (.mcap) or a dataset's folder",
        ),
        (("import", "{}/motion.bin", "--name", "x"), "page missing; choose one with --page: 7 nod"),
        (("import", "{}/motion.bin", "--name", "x", "--page", 8), "page 8 is empty; pages with a motion: 7"),
        (("import", "{}/motion.bin", "--name", "look-left", "--page", 7), "look-left.safetensors: already exists"),
        (("play", "look-lfet", "--library", "{}/clips"), "did you mean 'look-left'?"),
        (("play", "look-left", "--library", "{}/clips", "--rate", 0), "--rate 0: must be between 0.1 and 10"),
        (("play", "look-left", "--library", "{}/clips", "--push", 0.3), "open loop nothing answers a push"),
        (("play", "look-left", "--library", "{}/clips", "--tracker", "expert"), "a tracker of the gait alone"),
        (("play", "look-left", "--library", "{}/clips", "--tracker", "trakcer"), "no such checkpoint"),
        (
            ("play", "look-left", "--library", "{}/clips", "--worlds", 5),
            "--worlds 5: must be at least 1, and needs --randomise",
        ),
        (("list", "--library", "{}/none"), "none: no such folder of clips"),
        (("play", "{}/motion.bin.safetensors"), "no such checkpoint"),
    ],
)
def test_mistakes_are_named(nod: Path, tmp_path: Path, motions: Motions, words: tuple[Any, ...], said: str) -> None:
    told = ("--caption", "x", "--licence", "MIT", "--out", nod) if words[0] == "import" else ()
    code, answer, _ = motions(*(str(word).format(tmp_path) for word in words), *told)
    assert code == 2
    assert said in answer["error"]


def test_a_page_beyond_the_joint_ranges_is_refused_with_the_joints(tmp_path: Path, motions: Motions) -> None:
    path = file(tmp_path, {7: page((HOME | {14: 2048 + 1800}, 80, 0))})
    told = ("--caption", "x", "--licence", "MIT", "--out", tmp_path / "clips")
    code, answer, _ = motions("import", path, "--page", 7, "--name", "x", *told)
    assert code == 2
    assert "page 7 goes beyond the joint ranges of op3: l_knee by 0.25 rad" in answer["error"]


def test_a_recipe_makes_all_of_its_clips_one_after_the_other(tmp_path: Path, motions: Motions) -> None:
    bent = HOME | {14: HOME[14] + 100, 13: HOME[13] - 100}
    path = file(tmp_path, {7: page((bent, 80, 0)), 8: page(({19: HOME[19] + 300}, 40, 0))})
    recipe = tmp_path / "two.yaml"
    text = "licence: MIT\nclips:\n  - {page: 7, name: bend, captions: [bend]}\n"
    recipe.write_text(text + "  - {page: 8, name: look, captions: [look], after: bend}\n")
    code, answer, err = motions("import", path, "--recipe", recipe, "--out", tmp_path / "clips")
    assert code == 0, err
    assert [clip["name"] for clip in answer["clips"]] == ["bend", "look"]
    library = Library(ROBOT, tmp_path / "clips")
    np.testing.assert_allclose(library["look"].joints[0], library["bend"].joints[-1], atol=1e-6)
    recipe.write_text(text + "  - {page: 8, name: look, captions: [look], after: bent}\n")
    code, answer, _ = motions("import", path, "--recipe", recipe, "--out", tmp_path / "clips", "--replace")
    assert (code, "after: 'bent' is not an earlier clip" in answer["error"]) == (2, True)
    recipe.write_text(text + "  - {pgae: 8, name: look, captions: [look]}\n")
    code, answer, _ = motions("import", path, "--recipe", recipe, "--out", tmp_path / "clips", "--replace")
    assert (code, "two.yaml:4: clips[1].pgae: unknown key" in answer["error"]) == (2, True)


def test_the_shipped_clips_fit_the_robot_and_stand_open_loop(motions: Motions) -> None:
    """They are what `servoid motions import --recipe op3-action-file` makes of the manufacturer's file, and what
    `servoid motions author` makes of `authored` and `kick`."""
    from servoid.tools.motions.keyframes import load_authored
    from servoid.tools.motions.recipe import load_recipe

    imported = load_recipe("op3-action-file")
    authored = [clip for name in ("authored", "kick") for clip in load_authored(name).clips]
    shipped = {clip["name"]: clip for clip in motions("list")[1]["clips"]}
    mirrored = {clip.mirrored for clip in authored if clip.mirrored is not None}
    assert shipped.keys() == {clip.name for clip in (*imported.clips, *authored)} | mirrored
    assert {clip["licence"] for clip in shipped.values()} == {imported.licence}
    for name in ("bow", "get-up-front", "get-up-back", "stand-on-left-foot", "kick-side-right"):
        assert motions("play", name)[1]["stands_share"] == 1.0, name

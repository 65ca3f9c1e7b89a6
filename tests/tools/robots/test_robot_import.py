"""A robot's file drafted from its model, and compared with it."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from shutil import copy

import numpy as np
import pytest

from servoid.hw.config import CONFIGS, available
from servoid.hw.robot.description import load_robot, load_servo, save_servo
from servoid.hw.robot.legs import Legs
from servoid.stack.control.fleet import Fleet
from servoid.stack.estimation.odometry import odometry_of
from servoid.tools.cli import main
from servoid.tools.robots.compare import findings
from servoid.tools.robots.facts import file_findings
from servoid.tools.robots.home import bent_home

ROBOTS = CONFIGS / "robots"


def imported(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, object]]:
    code = main(["robot", "import", *words, "--no-picture", "--json"])
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("name", ["op3", "wren"])
def test_what_geometry_says_is_drafted_as_it_is_written_by_hand(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, said = imported(capsys, str(ROBOTS / f"{name}.xml"), "--out", str(tmp_path / "own.yaml"))
    assert code == 0
    assert "home of every joint: the model has no keyframe; its knees were bent by geometry" in said["todo"]
    ours, drafted = load_robot(name), load_robot(tmp_path / "own.yaml")
    knees = [i for i, joint in enumerate(ours.names) if "knee" in joint]
    assert drafted.home[[drafted.names.index(ours.names[i]) for i in knees]] == pytest.approx(ours.home[knees], abs=0.2)
    looked = {one.what: one for one in findings(drafted)}
    assert [what for what, one in looked.items() if not one.good and what != "stiffness at home"] == []
    assert looked["steps of the gait"].good
    straight = replace(drafted, joints=tuple(replace(joint, home=0.0) for joint in drafted.joints))
    assert "bend the knees at home" in findings(straight)[-1].found
    mirrors = [{joint.name: (joint.mirror, joint.mirror_sign) for joint in robot.joints} for robot in (ours, drafted)]
    assert mirrors[1] == mirrors[0]
    assert (drafted.base, drafted.imu_site) == (ours.base, ours.imu_site)
    assert {side: foot.geoms for side, foot in drafted.feet.items()} == {s: f.geoms for s, f in ours.feet.items()}


def test_feet_that_are_turned_at_zero_are_found_whole_and_put_level(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """At a stranger's zero angles knees are bent backwards and toes are up: of each foot's four studs the two at the
    heel were taken, no pose with bent knees was found, and it stood leaning ahead while everything had fitted."""
    text = (ROBOTS / "wren.xml").read_text()
    sole = 'class="{}_leg" type="box" size="0.038 0.022 0.003" pos="0.006 0.003 -0.012" mass="0.014" material="sole"/>'
    for side, name, y in (("l", "left", 0.003), ("r", "right", -0.003)):
        old = f'<geom name="{side}_sole" {sole.format(name)}'.replace("0.003 -0.012", f"{y} -0.012")
        assert text.count(old) == 1
        studs = (
            f'<geom name="{side}{i}" class="{name}_leg" size="0.004" pos="{x} {y + z} -0.011" mass="0.0035"/>'
            for i, (x, z) in enumerate((x, z) for x in (-0.028, 0.04) for z in (-0.018, 0.018))
        )
        text = text.replace(old, "".join(studs))
        for link, place, turn in (("knee", "0 0 -0.056", -0.3), ("ank_roll", "0 0 -0.014", -0.15)):
            place = f'"{side}_{link}_link" pos="{place}"'
            assert text.count(place) == 1
            text = text.replace(place, f'{place} euler="0 {turn} 0"')
        text = text.replace(
            f'<joint name="{side}_knee" axis="0 1 0"/>', f'<joint name="{side}_knee" axis="0 1 0" range="0 2.2"/>'
        )
    (tmp_path / "tilted.xml").write_text(text)
    code, said = imported(capsys, str(tmp_path / "tilted.xml"), "--out", str(tmp_path / "tilted.yaml"))
    assert code == 0
    assert "home of every joint: the model has no keyframe; its knees were bent by geometry" in said["todo"]
    robot = load_robot(tmp_path / "tilted.yaml")
    assert [foot.geoms for foot in robot.feet.values()] == [tuple(f"{side}{i}" for i in range(4)) for side in "lr"]
    assert [one.what for one in findings(robot) if not one.good] == []  # knees bent until servos can follow the steps
    straight = replace(robot, joints=tuple(replace(joint, home=max(0.0, joint.range[0])) for joint in robot.joints))
    look = {one.what: one.found for one in findings(straight) if not one.good}
    assert "leans ahead by 0.4" in look["trunk at home"]
    fleet = Fleet(robot, 1, None)
    fleet.reset(np.ones(1, bool))
    for _ in range(10):
        fleet.step(robot.home[None])
    assert fleet.truth.foot_force.sum() == pytest.approx(9.81 * 0.62, rel=0.3)
    assert not fleet.truth.fallen.any()  # a stud is a body of its own, and part of the foot


def test_an_origin_on_the_ground_is_moved_into_the_trunk(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Models out of drawing programs have it there, and how high such a base is says nothing of a fall."""
    text = (ROBOTS / "wren.xml").read_text().replace('<freejoint name="root"/>', '<freejoint/><frame pos="0 0 0.19">')
    (tmp_path / "low.xml").write_text(text.replace("    </body>\n  </worldbody>", "</frame></body></worldbody>"))
    out = tmp_path / "low.yaml"
    assert imported(capsys, str(tmp_path / "low.xml"), "--out", str(out))[0] == 0
    robot = load_robot(out)
    assert robot.origin == pytest.approx((0, 0, 0.178), abs=1e-3)
    assert robot.standing_height == pytest.approx(load_robot("wren").standing_height - 0.005, abs=0.01)
    assert [one.what for one in findings(robot) if not one.good] == []
    out.write_text("\n".join(row for row in out.read_text().splitlines() if not row.startswith("origin")))
    assert main(["robot", "check", str(out)]) == 2
    assert "its origin must be in the trunk: give that as `origin`" in capsys.readouterr().err


def test_a_joint_whose_image_belongs_to_another_is_its_own_mirror(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A neck's rod beside the servo that moves it made a draft that could not be loaded."""
    site = '<site name="imu" pos="0 0 0.03"/>'
    rows = (
        f'<body pos="0 {y} 0.08"><joint name="{name}" axis="0 1 0"/><geom size="0.01" mass="0.01"/></body>'
        for name, y in (("nod", 0.0), ("rod", 0.03))
    )
    text = (ROBOTS / "wren.xml").read_text()
    assert site in text
    (tmp_path / "neck.xml").write_text(text.replace(site, site + "".join(rows)))
    code, said = imported(capsys, str(tmp_path / "neck.xml"), "--out", str(tmp_path / "neck.yaml"))
    assert code == 0
    assert "mirror of rod: nod, at its image, is that of another" in said["todo"]
    joints = {joint.name: joint.mirror for joint in load_robot(tmp_path / "neck.yaml").joints}
    assert (joints["nod"], joints["rod"]) == ("nod", "rod")


def test_a_model_in_place_of_a_robots_file_is_named_as_one(capsys: pytest.CaptureFixture[str]) -> None:
    """All of it was printed, as one line of YAML."""
    assert main(["robot", "check", str(ROBOTS / "wren.xml")]) == 2
    said = capsys.readouterr().err
    assert "wren.xml: is a model; a robot's file is YAML, and servoid robot import" in said
    assert len(said) < 500


def test_a_mesh_that_collides_and_is_missing_is_named_with_where_it_is_looked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shape = '<collision><geometry><mesh filename="package://own/foot.stl"/></geometry></collision>'
    (tmp_path / "own.urdf").write_text(f'<robot name="own"><link name="foot">{shape}</link></robot>')
    assert main(["robot", "import", str(tmp_path / "own.urdf"), "--no-picture"]) == 2
    assert "'foot': collision mesh package://own/foot.stl: no such file beside the URDF" in capsys.readouterr().err


def test_a_xacro_file_is_named_as_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "own.urdf").write_text('<robot name="own"><link name="${side}_foot"/></robot>')
    assert main(["robot", "import", str(tmp_path / "own.urdf"), "--no-picture"]) == 2
    assert "is xacro, of which a URDF is made first: xacro own.urdf > robot.urdf" in capsys.readouterr().err


def test_a_shapes_number_does_not_depend_on_meshes_that_only_show_the_robot(tmp_path: Path) -> None:
    """Drafted where they were not at hand, a robot's file named other geoms where they were."""
    text = (ROBOTS / "wren.xml").read_text()
    sole = '<geom name="l_sole"'
    assert text.count(sole) == 1
    text = text.replace(sole, '<geom size="0.01" contype="0" conaffinity="0" mass="0"/><geom')
    (tmp_path / "wren.xml").write_text(text)
    own = (ROBOTS / "wren.yaml").read_text()
    assert own.count("l_sole") == 1
    (tmp_path / "wren.yaml").write_text(own.replace("l_sole", "l_ank_roll_link.1"))
    assert load_robot(tmp_path / "wren.yaml").feet["left"].half_size == load_robot("wren").feet["left"].half_size


def test_a_foot_too_few_and_a_rate_that_physics_does_not_have_are_shown() -> None:
    wren = load_robot("wren")
    one = replace(wren, rate=60, feet={"left": wren.feet["left"]})
    wrong = {found.what: found.found for found in file_findings(one) if not found.good}
    assert wrong == {
        "feet": "1: left: a humanoid has two",
        "rate": "60 Hz, of the physics' 250 steps a second: one that divides them is needed in simulation",
    }


def test_servos_that_no_one_supply_feeds_are_shown() -> None:
    wren = load_robot("wren")
    joints = [replace(joint, servo="mx-28") if "ank" in joint.name else joint for joint in wren.joints]
    supply = next(one for one in findings(replace(wren, joints=tuple(joints))) if one.what == "supply")
    assert (supply.good, supply.found) == (False, "a mx-28 needs 9.5 V, and a xl330-m288 bears 6.5 V at most")
    assert "l_knee" in supply.joints
    assert "l_ank_roll" not in supply.joints


def test_what_does_not_fit_its_model_is_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy(ROBOTS / "wren.xml", tmp_path)
    text = (ROBOTS / "wren.yaml").read_text()
    knee = "range: [-0.05, 2.1], home: 0.7, mirror: l_knee, mirror_sign: 1"
    assert knee in text
    text = text.replace("mirror: r_sho_pitch, mirror_sign: 1", "mirror: r_sho_pitch, mirror_sign: -1")
    text = text.replace("mirror: l_sho_pitch, mirror_sign: 1", "mirror: l_sho_pitch, mirror_sign: -1")
    (tmp_path / "wren.yaml").write_text(text.replace(knee, knee.replace("2.1", "1.5")))
    assert main(["robot", "check", str(tmp_path / "wren.yaml"), "--json"]) == 1
    found = {one["what"]: one for one in json.loads(capsys.readouterr().out)["findings"]}
    assert "l_knee, r_knee" in found["ranges"]["found"]
    assert "most l_sho_pitch" in found["mirrors"]["found"] or "most r_sho_pitch" in found["mirrors"]["found"]
    assert [what for what, one in found.items() if not one["good"]] == ["mirrors", "ranges"]


@pytest.mark.parametrize(("hip", "way"), [((-1.5, 0.5), 1), ((-0.5, 1.5), -1), ((-1.5, 1.5), 1)])
def test_a_knee_of_no_side_bends_where_its_hip_has_room(hip: tuple[float, float], way: int) -> None:
    """A bird's knees bend the other way."""
    wren = load_robot("wren")
    ranges = {"hip_pitch": hip, "knee": (-2.0, 2.0), "ank_pitch": (-1.5, 1.5)}
    joints = [replace(j, home=0.0, range=ranges.get(j.name[2:], j.range)) for j in wren.joints]
    home = bent_home(replace(wren, joints=tuple(joints)))
    assert home is not None
    assert home[[wren.names.index(f"{side}_knee") for side in "lr"]] * way == pytest.approx(0.75, abs=0.15)
    assert bent_home(replace(wren, joints=tuple(replace(j, home=h) for j, h in zip(joints, home, strict=True)))) is None


def test_servos_too_soft_to_stand_on_are_shown(tmp_path: Path) -> None:
    """A robot of 1.7 kg on servos of 2.5 N m/rad sank and fell over within 10 s, and everything had fitted."""
    save_servo(replace(load_servo("xl330-m288"), stiffness=0.3), tmp_path / "soft.yaml")
    wren = load_robot("wren")
    soft = replace(wren, joints=tuple(replace(joint, servo=str(tmp_path / "soft.yaml")) for joint in wren.joints))
    assert [one.what for one in findings(soft) if not one.good] == ["stiffness at home"]


@pytest.mark.parametrize("name", available("robots"))
def test_shipped_robots_fit_their_models(name: str) -> None:
    assert [one for one in findings(load_robot(name)) if not one.good] == []


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('<freejoint name="root"/>', "", "no body has a free joint: give the robot's base <freejoint/>"),
        ('<site name="imu" pos="0 0 0.03"/>', "", 'add <site name="imu"/> to that body'),
        ('name="r_sole" class="right_leg"', 'name="r_sole" class="visual"', "home"),
        ("<worldbody>", '<asset><mesh name="m" file="no.stl"/></asset><worldbody>', "no.stl"),
        ("</mujoco>", "", "not a valid MJCF or URDF"),
        (
            "<worldbody>",
            '<extension><plugin plugin="own.gear"/></extension><worldbody>',
            "plugin own.gear not found.* take it out",
        ),
    ],
)
def test_a_model_that_is_no_robots_is_refused_with_what_it_lacks(
    old: str, new: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (ROBOTS / "wren.xml").read_text()
    assert old in text
    (tmp_path / "own.xml").write_text(text.replace(old, new))
    code, answer = imported(capsys, str(tmp_path / "own.xml"), "--out", str(tmp_path / "own.yaml"))
    assert re.search(said, str(answer))
    assert code == (0 if said == "home" else 2)


def test_limbs_that_are_drawn_into_each_other_pass_through(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A stranger's boxes overlapped, and their contacts threw the robot over in half a second."""
    text = (ROBOTS / "wren.xml").read_text()
    ankle = 'class="left_leg" type="box" size="0.014 0.01 0.007"'
    assert text.count(ankle) == 1
    (tmp_path / "own.xml").write_text(text.replace(ankle, ankle.replace("0.01 ", "0.057 ")))
    out = tmp_path / "own.yaml"
    code, said = imported(capsys, str(tmp_path / "own.xml"), "--out", str(out))
    assert code == 0
    assert any("l_ank_roll_link and r_ank_pitch_link: their shapes overlap at home" in text for text in said["todo"])
    robot = load_robot(out)
    assert robot.overlapping == (("l_ank_roll_link", "r_ank_pitch_link"),)
    assert next(one for one in findings(robot) if one.what == "limbs at home").good
    (look,) = [one for one in findings(replace(robot, overlapping=())) if one.what == "limbs at home"]
    assert not look.good
    assert "overlap: l_ank_roll_link and r_ank_pitch_link by" in look.found
    out.write_text(out.read_text().replace("[l_ank_roll_link, r", "[l_ank_rolling, r"))
    assert main(["robot", "check", str(out)]) == 2
    assert "no body (that overlaps another) named 'l_ank_rolling'" in capsys.readouterr().err


def test_a_keyframe_for_other_motors_is_read_for_its_pose(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key = '<keyframe><key qpos="0 0 0.2 1 0 0 0 0.5 0 0 0 0 0 0 0 0 0 0 0 0 0" ctrl="1 2"/></keyframe>'
    text = (ROBOTS / "wren.xml").read_text()
    (tmp_path / "own.xml").write_text(text.replace("</mujoco>", key + "</mujoco>"))
    assert imported(capsys, str(tmp_path / "own.xml"), "--out", str(tmp_path / "own.yaml"))[0] == 0
    robot = load_robot(tmp_path / "own.yaml")
    assert robot.home[robot.names.index("l_sho_pitch")] == pytest.approx(0.5)


def test_a_robots_file_is_not_written_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "own.yaml").write_text("precious")
    assert main(["robot", "import", str(ROBOTS / "wren.xml"), "--out", str(tmp_path / "own.yaml")]) == 2
    assert "is there already: give another --out, or --force" in capsys.readouterr().err
    assert (tmp_path / "own.yaml").read_text() == "precious"


def test_a_robot_without_networks_stands_and_says_what_it_goes_by(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`run stand` needed the odometry of an OP3."""
    for kind in ("xml", "yaml"):
        copy(ROBOTS / f"heron.{kind}", tmp_path)
    copy(ROBOTS / "heron" / "xm430-w350.yaml", tmp_path)
    own = tmp_path / "heron.yaml"
    own.write_text(own.read_text().replace("heron/xm430", "xm430"))
    words = ["--policy", "gait", "--fast", "--seconds", "1", "--robot", str(own)]
    assert main(["run", "stand", *words, "--record", str(tmp_path / "log.mcap"), "--json"]) == 0
    events = json.loads(capsys.readouterr().out)["events"]
    assert any("odometry goes by the legs alone" in event["text"] for event in events)


@pytest.mark.parametrize("name", ["wren", "heron"])
def test_shipped_robots_go_by_odometry_of_their_own(name: str) -> None:
    """Without it, distances that their legs measure are off by a quarter."""
    network, warning = odometry_of(load_robot(name))
    assert network is not None
    assert warning is None


@pytest.mark.slow
@pytest.mark.parametrize("name", ["wren", "heron"])
def test_robots_with_other_legs_walk_by_their_own_gaits(name: str) -> None:
    """Legs that roll or pitch before they turn, and a waist: the numeric inverse takes their steps."""
    from servoid.stack.control.fleet import Fleet
    from servoid.stack.control.gait import GaitPolicy

    robot = load_robot(name)
    fleet = Fleet(robot, 3, None, seed=1, threads=1)
    policy = GaitPolicy(robot, (3,))
    fleet.reset(np.ones(3, bool))
    for _ in range(200):
        fleet.drive(policy, np.array([[0.2, 0, 0], [0, 0.06, 0], [0.1, 0, 0.4]]))
    assert not fleet.truth.fallen.any()
    assert fleet.truth.position[0, 0] > 0.4
    assert fleet.truth.position[1, 1] > 0.1
    assert np.isfinite(Legs(robot).stand(robot.home)[0])

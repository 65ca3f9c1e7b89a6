"""What strangers' MJCFs hold beside the robot does not act on it, and what they lack or get wrong is named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import Robot, load_robot
from servoid.sim.model import FLOOR, build
from servoid.sim.multi_robot import ADDED

OP3 = load_robot()
Make = Callable[..., Robot]


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """The OP3 with changes of its MJCF, each `(old, new)`."""

    def changed(*changes: tuple[str, str], yaml: tuple[str, str] = ("", "")) -> Robot:
        text = Path(OP3.mjcf).read_text()
        for old, new in changes:
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        (tmp_path / "own.xml").write_text(text)
        source = Path("configs/robots/op3.yaml").read_text().replace("mjcf: op3.xml", "mjcf: own.xml")
        (tmp_path / "own.yaml").write_text(source.replace(*yaml) if yaml[0] else source)
        return load_robot(tmp_path / "own.yaml")

    return changed


def differences(model: mujoco.MjModel, other: mujoco.MjModel) -> list[str]:
    """Arrays of numbers in which two models differ."""
    names = [name for name in dir(model) if not name.startswith("_")]
    pairs = [(name, getattr(model, name), getattr(other, name)) for name in names]
    arrays = [(name, a, b) for name, a, b in pairs if isinstance(a, np.ndarray)]
    return [name for name, a, b in arrays if a.shape != b.shape or not np.array_equal(a, b)]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("<default>\n", '<default>\n<position ctrlrange="-3.14 3.14" kp="21" forcerange="-5 5"/>\n'),
        ("<default>\n", '<default>\n<general forcerange="-0.5 0.5" gear="3" ctrlrange="-0.1 0.1"/>\n'),
        ("<default>\n", '<default>\n<mesh scale="0.001 0.001 0.001"/><light diffuse="0 0 0"/>\n'),
        ('<joint limited="false"/>', '<joint damping="1.084" armature="0.045" stiffness="4" springref="1"/>'),
        ('<joint limited="false"/>', '<joint range="-0.1 0.1" actuatorfrcrange="-0.1 0.1" frictionloss="2"/>'),
        ("<worldbody>\n", '<option gravity="0 0 -1" timestep="0.001" density="1000"/>\n<worldbody>\n'),
        ("<worldbody>\n", '<worldbody>\n<geom name="floor" type="plane" size="1 1 1" friction="0.01"/>\n'),
        ("<worldbody>\n", '<worldbody>\n<body name="ball"><freejoint/><geom size="0.1"/></body>\n'),
        ("</mujoco>", '<keyframe><key name="home" qpos="' + "0 " * 27 + '"/></keyframe></mujoco>'),
        ("</mujoco>", '<actuator><motor joint="l_knee"/></actuator></mujoco>'),
        ("</mujoco>", '<sensor><gyro name="gyro" site="imu" noise="5" cutoff="1"/></sensor></mujoco>'),
        ('<body name="l_el_link"', '<body gravcomp="1" name="l_el_link"'),
    ],
)
def test_what_the_file_holds_beside_the_body_changes_nothing(make: Make, old: str, new: str) -> None:
    """With `<position ctrlrange=...>` among the defaults the robot fell within 1.3 s."""
    assert differences(build(make((old, new))), build(OP3)) == []


def test_the_bodys_own_contacts_stay(make: Make) -> None:
    model = build(make(('<geom condim="3" solref="0.008 1"/>', '<geom condim="4" solref="0.02 1" margin="0.001"/>')))
    assert model.geom("l_sole_long").condim[0] == 4
    assert model.geom("l_sole_long").margin[0] == 0.001
    assert model.geom(FLOOR).margin[0] == 0.0


def test_no_name_of_the_file_collides_with_one_that_is_added(make: Make) -> None:
    """A site `left_foot` beside `feet: left` was an internal error."""
    added = build(OP3)
    kinds = (added.ngeom, added.geom), (added.nsite, added.site), (added.nmat, added.mat)
    names = [view(i).name for count, view in kinds for i in range(count)]
    assert f"{ADDED}left_foot" in names
    sites = "".join(f'<site name="{name}"/>' for name in {n.removeprefix(ADDED) for n in names if n.startswith(ADDED)})
    geoms = '<geom name="floor" size="0.001" mass="0"/>'
    model = build(
        make(('<site name="imu" pos="-0.01 0 0.05"/>', f'<site name="imu" pos="-0.01 0 0.05"/>{sites}{geoms}'))
    )
    assert model.geom("floor").bodyid == model.body(OP3.base).id
    assert model.geom(FLOOR).bodyid == 0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ([('<freejoint name="root"/>', "")], "body 'body_link' needs <freejoint/> as its only joint: it has none"),
        ([('<freejoint name="root"/>', '<joint name="root" type="ball"/>')], "<freejoint/>.*it has 'root'"),
        (
            [
                ('<body name="body_link" pos="0 0 0.3">', '<body name="cart"><body name="body_link" pos="0 0 0.3">'),
                ("  </worldbody>", "</body></worldbody>"),
            ],
            "body 'body_link' is a child of 'cart': a robot's base must be a child of <worldbody>",
        ),
        ([('<joint name="l_knee" axis="0 1 0"/>', '<joint name="l_knee" type="slide"/>')], "'l_knee' is not a hinge"),
        ([('<joint name="head_pan"', '<joint name="waist"')], "no joint named 'head_pan', which robot 'op3' needs"),
        (
            [
                (
                    '<default class="left_leg"><geom group="1" contype="2"',
                    '<default class="left_leg"><geom contype="2"',
                ),
                ('contype="2" conaffinity="5"', 'contype="2" conaffinity="4"'),
            ],
            "geom 'l_sole_long', of a sole, passes through the floor: give its contype or conaffinity the bit 1",
        ),
        ([('mass="0.01176" pos="0.00233 0 0.00823"', 'mass="0" pos="0 0 0"')], "MuJoCo cannot compile it: "),
        ([("</worldbody>", "")], "not a valid MJCF or URDF: "),
        ([("<worldbody>", '<asset><mesh name="m" file="no.stl"/></asset><worldbody>')], "cannot compile it: .*no.stl"),
    ],
)
def test_what_is_wrong_is_named_with_the_file(make: Make, changes: list[tuple[str, str]], said: str) -> None:
    with pytest.raises(ConfigError, match=rf"own\.xml: .*{said}"):
        build(make(*changes))


def test_building_says_nothing_and_leaves_no_file(
    capfd: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    """MuJoCo's warnings go to standard error and into a log in the current folder."""
    monkeypatch.chdir(tmp_path)
    build(OP3)
    assert capfd.readouterr() == ("", "")
    assert [str(warning.message) for warning in recwarn] == []
    assert list(tmp_path.iterdir()) == []

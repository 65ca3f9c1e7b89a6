"""Models that others wrote are imported, fit their files, and stand. None is kept here: SERVOID_FOREIGN_MODELS names
the paths of some, with what separates those in PATH between them; `PATH=BODY` names the base, too."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from servoid.hw.robot.description import load_robot, load_servo, save_servo
from servoid.sim.model import build
from servoid.tools.cli import main
from servoid.tools.robots.compare import findings

GIVEN = [entry.partition("=") for entry in os.environ.get("SERVOID_FOREIGN_MODELS", "").split(os.pathsep) if entry]
MODELS = [(Path(path), base) for path, _, base in GIVEN]


@pytest.mark.slow
@pytest.mark.skipif(not MODELS, reason="SERVOID_FOREIGN_MODELS names no models")
@pytest.mark.parametrize(("model", "base"), MODELS)
def test_a_strangers_robot_is_imported_fits_its_file_and_stands(model: Path, base: str, tmp_path: Path) -> None:
    """On servos as much stronger than an OP3's as the robot is heavier and taller: a model says nothing of them."""
    out = tmp_path / "own.yaml"
    hung = ["--base", base] if base else []
    assert main(["robot", "import", str(model), "--out", str(out), "--no-picture", *hung]) == 0
    robot, op3 = load_robot(out), load_robot()
    load = [float(build(one).body_mass[1:].sum()) * one.standing_height for one in (robot, op3)]
    times, servo = 2.0 * load[0] / load[1], load_servo("xm430-w350")
    figures = ("stiffness", "stall_torque", "braking_torque", "damping", "friction", "armature")
    save_servo(replace(servo, **{name: times * getattr(servo, name) for name in figures}), tmp_path / "strong.yaml")
    out.write_text(out.read_text().replace("servo: xm430-w350", "servo: strong.yaml"))
    found = {one.what: one for one in findings(load_robot(out))}
    assert found["kinematics"].good, found["kinematics"].found
    print(model.parent.name, *(f"{one.what}: {one.found}" for one in found.values()), sep="\n  ")
    stand = ["run", "stand", "--robot", str(out), "--policy", "gait", "--fast", "--set", "seconds=5"]
    assert main([*stand, "--record", str(tmp_path / "stand.mcap")]) == 0

"""What a prior sees: the same wherever the robot stands and faces, in a mirror, and by the robot's own kinematics."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servoid.hw.robot.description import load_robot
from servoid.hw.robot.limbs import Limbs
from servoid.hw.robot.mirror import Mirror
from servoid.policy.features import raw_layout, raw_mirror
from servoid.policy.priors.features import PriorFeatures, deviations, seen_from_last
from servoid.policy.priors.manner import amplitude, beside, cadence
from servoid.sim.kinematics import limbs_of
from servoid.sim.model import build

ROBOT = load_robot()
LIMBS = limbs_of(ROBOT)
FEATURES = PriorFeatures(ROBOT, LIMBS)


def rows(seed: int, frames: int = 6) -> np.ndarray:
    """Raw rows `(frames, raw size)` of any motion."""
    rng = np.random.default_rng(seed)
    raw = rng.normal(size=(frames, raw_layout(len(ROBOT.joints)).size))
    raw[:, raw_layout(len(ROBOT.joints)).slice("position")] *= 0.3
    return raw


def window(raw: np.ndarray) -> np.ndarray:
    return np.asarray(seen_from_last(*FEATURES.of(raw)))


@given(st.integers(0, 2**16))
@settings(max_examples=10, deadline=None)
def test_ends_of_limbs_are_where_the_simulation_has_them(seed: int) -> None:
    model = build(ROBOT)
    data = mujoco.MjData(model)
    joints = np.random.default_rng(seed).uniform(-1.0, 1.0, len(ROBOT.joints))
    data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    data.qpos[[model.joint(name).qposadr[0] for name in ROBOT.names]] = joints
    mujoco.mj_kinematics(model, data)
    theirs = {tuple(np.round(data.body(name).xipos, 6)) for name in ("l_el_link", "r_el_link", "l_ank_roll_link")}
    ours = {tuple(np.round(end, 6)) for end in LIMBS.ends(joints).reshape(-1, 3)}
    assert len(ours) == 4
    assert theirs <= ours
    again = Limbs.from_header(LIMBS.to_header())
    assert np.allclose(again.ends(joints), LIMBS.ends(joints), atol=1e-5)


def test_a_window_looks_the_same_from_wherever_it_is_seen() -> None:
    raw = rows(0)
    moved = raw.copy()
    at = raw_layout(len(ROBOT.joints))
    moved[:, at.slice("displacement")][:, :2] += [3.0, -2.0]
    moved[:, at.slice("yaw")] += 2.5
    assert np.allclose(window(raw), window(moved), atol=1e-5)
    turned = raw.copy()
    turned[0, at.slice("yaw")] += 1.0  # but not where it turns on the way
    assert not np.allclose(window(raw), window(turned), atol=1e-2)


def test_a_mirrored_motion_is_the_mirror_of_its_window() -> None:
    raw = rows(1)
    assert np.allclose(FEATURES.mirror(window(raw)), window(raw_mirror(ROBOT)(raw)), atol=1e-5)


def test_upper_and_lower_body_share_all_features_out() -> None:
    lower = FEATURES.lower
    joints = lower[FEATURES.layout.slice("position")]
    assert {ROBOT.names[i] for i in np.flatnonzero(~joints)} == {
        "head_pan", "head_tilt", "l_sho_pitch", "l_sho_roll", "l_el", "r_sho_pitch", "r_sho_roll", "r_el",
    }  # fmt: skip
    assert lower[FEATURES.layout.slice("ends")].sum() == 6  # two feet
    assert lower[: FEATURES.layout.slice("position").start].all()


def test_what_hardly_moves_is_not_blown_up() -> None:
    frames = np.random.default_rng(0).normal(size=(500, FEATURES.layout.size))
    still = FEATURES.layout.slice("position").start
    frames[:, still] = 0.0
    _, std = deviations(frames, FEATURES.layout)
    assert 0.15 < std[still] < 0.25


def test_amplitude_and_cadence_are_those_of_a_sine() -> None:
    t = np.arange(200) / 50
    joints = 0.3 * np.sin(2 * np.pi * 2.1 * t)[:, None] * np.ones(len(ROBOT.joints))
    assert np.allclose(amplitude(joints), 0.3, atol=0.01)
    assert abs(cadence(joints, 50) - 2.1) < 0.1
    assert np.isnan(cadence(np.zeros((100, 3)), 50))
    table = {"speed": [0.1, 0.3], "amplitude": [[0.2] * 20, [0.4] * 20], "cadence": [2.1, 2.1]}
    manner = beside(table, ROBOT, joints[None], 0.2)
    assert abs(manner["amplitude"] - 1.0) < 0.05
    assert manner["amplitude_error"] < 0.05
    assert abs(manner["cadence"] - 1.0) < 0.05
    shuffling = beside(table, ROBOT, 0.3 * joints[None], 0.2)
    assert shuffling["amplitude"] < 0.35


def test_limbs_that_a_mirror_does_not_know_are_refused() -> None:
    lopsided = Limbs(LIMBS.limbs[:1])
    with pytest.raises(ValueError, match="not the same in a mirror"):
        lopsided.mirror(Mirror.joints(ROBOT))

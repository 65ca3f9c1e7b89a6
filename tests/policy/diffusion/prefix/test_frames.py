"""Frames relative to the one before: both conversions, the kinematics behind them, and what they are for."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import headed, yaw_of
from servoid.hw.robot.description import load_robot
from servoid.policy.diffusion.prefix.frames import Anchor, BodyMotion, Frames, wrapped
from servoid.policy.diffusion.prefix.key_points import KeyPoints
from servoid.policy.features import raw_layout
from servoid.policy.motion.library import Library
from servoid.sim.model import build

ROBOT = load_robot("op3")
FRAMES = Frames(ROBOT)


def _motion(seed: int, frames: int = 12, lean: float = 1.2) -> BodyMotion:
    """A motion that wanders, turns and leans as far as lying."""
    rng = np.random.default_rng(seed)
    place = np.cumsum(0.03 * rng.standard_normal((frames, 3)), 0) + np.array([0.0, 0.0, 0.3])
    tilt = lean * rng.uniform(-1.0, 1.0, (frames, 2)) / 2
    angle = np.linalg.norm(tilt, axis=1)
    axis = tilt / np.maximum(angle, 1e-9)[:, None]
    quaternion = np.column_stack([np.cos(angle), np.sin(angle)[:, None] * axis, np.zeros(frames)])
    orientation = headed(quaternion, rng.uniform(-3, 3) + np.cumsum(rng.uniform(-0.8, 0.8, frames)))
    joints = rng.uniform(ROBOT.lower, ROBOT.upper, (frames, len(ROBOT.joints)))
    return FRAMES.motion(place, orientation, joints)


def _same(a: BodyMotion, b: BodyMotion) -> None:
    for field in fields(BodyMotion):
        left, right = np.asarray(getattr(a, field.name)), np.asarray(getattr(b, field.name))
        if field.name == "orientation":  # of either sign
            left = left * np.sign((left * right).sum(-1, keepdims=True))
        np.testing.assert_allclose(left, right, atol=1e-6, err_msg=field.name)


def _parts(motion: BodyMotion) -> list[Any]:
    return [getattr(motion, field.name) for field in fields(BodyMotion)]


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.booleans())
def test_either_conversion_undoes_the_other(seed: int, tensors: bool) -> None:
    motion = _motion(seed)
    if tensors:
        motion = BodyMotion(*map(torch.from_numpy, _parts(motion)))
    relative = FRAMES.to_relative(motion)
    assert relative.shape == (11, FRAMES.layout.size)
    back = FRAMES.to_global(relative, Anchor.before(motion))
    _same(back, BodyMotion(*(x[1:] for x in _parts(motion))))
    joined = [np.concatenate([a[:1], b]) for a, b in zip(_parts(motion), _parts(back), strict=True)]
    np.testing.assert_allclose(FRAMES.to_relative(BodyMotion(*joined)), np.asarray(relative), atol=1e-5)


def test_frames_do_not_say_where_the_motion_was() -> None:
    motion = _motion(1)
    away = FRAMES.motion(
        np.stack([2.0 - motion.place[:, 1], 1.0 + motion.place[:, 0], motion.place[:, 2]], -1),
        headed(motion.orientation, np.full(12, np.pi / 2)),
        motion.joints,
    )
    np.testing.assert_allclose(FRAMES.to_relative(away), FRAMES.to_relative(motion), atol=1e-9)


def test_key_points_are_where_mujoco_has_them() -> None:
    model = build(ROBOT)
    data = mujoco.MjData(model)
    motion = _motion(2, frames=5)
    at = [int(model.jnt_qposadr[model.joint(name).id]) for name in ROBOT.names]
    names = FRAMES.key_points.names
    assert {"left hand", "right hand", "left foot", "right foot", "head", "left knee", "right elbow"} <= set(names)
    for i in range(5):
        data.qpos[:3], data.qpos[3:7], data.qpos[at] = motion.place[i], motion.orientation[i], motion.joints[i]
        mujoco.mj_kinematics(model, data)
        for name, geom in (("left hand", "l_hand"), ("right hand", "r_hand"), ("head", "head")):
            np.testing.assert_allclose(motion.points[i, names.index(name)], data.geom(geom).xpos, atol=1e-9)
        np.testing.assert_allclose(motion.points[i, names.index("left knee")], data.joint("l_knee").xanchor, atol=1e-9)
        np.testing.assert_allclose(motion.points[i, names.index("right elbow")], data.joint("r_el").xanchor, atol=1e-9)
        np.testing.assert_allclose(motion.points[i, names.index("left foot")], data.site("l_sole").xpos, atol=1e-3)


def test_a_whole_body_has_hips_shoulders_and_toes_too() -> None:
    whole = KeyPoints(ROBOT, whole=True)
    assert whole.names[: len(FRAMES.key_points.names)] == FRAMES.key_points.names, "those of frames stay what they are"
    model = build(ROBOT)
    data = mujoco.MjData(model)
    motion = _motion(4, frames=1)
    data.qpos[:7] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    data.qpos[[int(model.jnt_qposadr[model.joint(name).id]) for name in ROBOT.names]] = motion.joints[0]
    mujoco.mj_kinematics(model, data)
    at = dict(zip(whole.names, whole(motion.joints[0]), strict=True))
    np.testing.assert_allclose(at["left hip"], data.joint("l_hip_yaw").xanchor, atol=1e-9)
    np.testing.assert_allclose(at["right shoulder"], data.joint("r_sho_pitch").xanchor, atol=1e-9)
    ahead = at["right toe"] - at["right foot"]
    assert np.linalg.norm(ahead) == pytest.approx(ROBOT.feet["right"].half_size[0], abs=1e-3)
    np.testing.assert_allclose(ahead / np.linalg.norm(ahead), data.site("r_sole").xmat.reshape(3, 3)[:, 0], atol=0.02)


def test_a_mirrored_motion_has_mirrored_frames() -> None:
    clip = Library(ROBOT)["kick-left"]
    other = clip.mirrored(ROBOT, "other")
    ours, theirs = (
        FRAMES.to_relative(FRAMES.motion(c.root_position, c.root_orientation, c.joints)) for c in (clip, other)
    )
    np.testing.assert_allclose(FRAMES.mirror(ours), theirs, atol=1e-5)


def test_states_of_the_estimator_are_a_motion() -> None:
    motion = _motion(3, lean=0.6)
    layout = raw_layout(len(ROBOT.joints))
    raw = np.zeros((12, layout.size))
    raw[:, layout.slice("displacement")] = motion.place
    raw[:, layout.slice("yaw")] = np.unwrap(yaw_of(motion.orientation))[:, None]
    raw[:, layout.slice("gravity")] = FRAMES.layout.split(FRAMES.to_relative(_doubled(motion)))["gravity"]
    raw[:, layout.slice("position")] = motion.joints
    _same(FRAMES.of_states(raw), motion)


def _doubled(motion: BodyMotion) -> BodyMotion:
    """The same with its first frame twice, so that every frame has one before it."""
    return BodyMotion(
        *(np.concatenate([x[:1], x]) for x in (getattr(motion, field.name) for field in fields(BodyMotion)))
    )


def test_the_heading_is_smooth_while_the_robot_lies_down() -> None:
    """The base's x axis points at the sky or at the ground then, and its direction on the ground jumps."""
    clip = Library(ROBOT)["lie-down-front"]
    frames = FRAMES.motion(clip.root_position, clip.root_orientation, clip.joints)
    assert np.abs(wrapped(np.diff(frames.heading))).max() < 0.1


def test_the_end_of_frames_is_differentiable_and_follows_the_joints() -> None:
    motion = _motion(4)
    relative = torch.tensor(FRAMES.to_relative(motion), dtype=torch.float64, requires_grad=True)
    place, heading, points = FRAMES.end_points(relative)
    anchored = FRAMES.to_global(relative.detach().numpy(), _at_origin(motion.points.shape[1:]))
    np.testing.assert_allclose(points.detach().numpy(), anchored.points[-1], atol=1e-6)
    (gradient,) = torch.autograd.grad(points.sum() + place.sum() + heading, relative)
    assert torch.isfinite(gradient).all()
    assert gradient.abs().sum() > 0
    step = torch.zeros_like(relative)
    step[3, FRAMES.layout.slice("yaw_rate")] = 1e-5
    after = FRAMES.end_points((relative + step).detach())
    change = sum((a - b).sum() for a, b in zip(after, (place, heading, points), strict=True))
    assert float(change.detach()) == pytest.approx(float((gradient * step).sum().detach()), rel=1e-3)


def _at_origin(shape: tuple[int, ...]) -> Anchor:
    points: Array = np.zeros(shape)
    return Anchor(np.zeros(2), np.zeros(()), points)

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import State
from servoid.hw.robot.description import load_robot
from servoid.policy.features import (
    Normaliser,
    raw_layout,
    raw_mirror,
    raw_row,
    to_raw,
    to_tokens,
    token_layout,
)
from servoid.policy.trajectory import Trajectory

N = 20
RAW = raw_layout(N)
ROBOT = load_robot()
MIRROR = raw_mirror(ROBOT)


def window(seed: int, turns: float = 0.0) -> Array:
    """A random window of raw rows that turns by less than half a turn."""
    rng = np.random.default_rng(seed)
    raw = rng.normal(size=(9, RAW.size))
    raw[:, RAW.slice("yaw")] = 2 * np.pi * turns + 0.8 + rng.uniform(-1.5, 1.5, (9, 1))
    return raw


def moved(raw: Array, x: float, y: float, yaw: float) -> Array:
    """The same motion by an odometry that started elsewhere."""
    out = raw.copy()
    c, s = np.cos(yaw), np.sin(yaw)
    out[:, :2] = raw[:, :2] @ np.array([[c, s], [-s, c]]) + [x, y]
    out[:, RAW.slice("yaw")] += yaw
    return out


@given(st.integers(0, 1000), st.sampled_from([-7.0, 0.0, 3.0]))
def test_raw_rows_come_back_from_the_canonical_frame(seed: int, turns: float) -> None:
    raw = window(seed, turns)
    np.testing.assert_allclose(to_raw(to_tokens(raw, raw[3], N), raw[3], N), raw, atol=1e-9)


@given(st.integers(0, 1000), st.floats(-50, 50), st.floats(-50, 50), st.floats(-20, 20))
def test_tokens_do_not_depend_on_where_odometry_began(seed: int, x: float, y: float, yaw: float) -> None:
    raw = window(seed)
    there = moved(raw, x, y, yaw)
    np.testing.assert_allclose(to_tokens(there, there[3], N), to_tokens(raw, raw[3], N), atol=1e-9)


def test_a_step_ahead_is_along_x_whatever_the_heading() -> None:
    raw = np.zeros((2, RAW.size))
    raw[:, RAW.slice("yaw")] = np.pi / 2  # looking along the odometry frame's y
    raw[1, :3] = 0.0, 0.3, 0.25
    token = token_layout(N).split(to_tokens(raw, raw[0], N)[1])
    np.testing.assert_allclose(token["displacement"], [0.3, 0.0], atol=1e-12)
    np.testing.assert_allclose(token["heading"], [1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(token["height"], [0.25])


def test_numpy_and_torch_agree() -> None:
    raw = window(5)
    tokens = to_tokens(raw, raw[3], N)
    as_torch = to_tokens(torch.from_numpy(raw), torch.from_numpy(raw[3]), N)
    np.testing.assert_allclose(as_torch.numpy(), tokens, atol=1e-12)
    np.testing.assert_allclose(to_raw(as_torch, torch.from_numpy(raw[3]), N).numpy(), raw, atol=1e-9)
    np.testing.assert_allclose(MIRROR(torch.from_numpy(raw)).numpy(), MIRROR(raw))


@given(st.integers(0, 1000))
def test_mirroring_twice_is_nothing(seed: int) -> None:
    raw = window(seed)
    np.testing.assert_array_equal(MIRROR(MIRROR(raw)), raw)


def test_the_mirror_turns_left_into_right() -> None:
    raw = np.zeros(RAW.size)
    parts = RAW.split(raw)
    parts["displacement"][:] = 1.0, 2.0, 3.0
    parts["yaw"][:] = 0.4
    parts["velocity"][:] = 1.0, 2.0, 3.0
    parts["angular_velocity"][:] = 1.0, 2.0, 3.0
    parts["gravity"][:] = 0.1, 0.2, -0.9
    parts["position"][ROBOT.names.index("l_knee")] = 0.7
    parts["joint_velocity"][ROBOT.names.index("head_pan")] = 1.5
    seen = RAW.split(MIRROR(raw))
    np.testing.assert_allclose(seen["displacement"], [1, -2, 3])
    np.testing.assert_allclose(seen["yaw"], [-0.4])
    np.testing.assert_allclose(seen["velocity"], [1, -2, 3])
    np.testing.assert_allclose(seen["angular_velocity"], [-1, 2, -3])
    np.testing.assert_allclose(seen["gravity"], [0.1, -0.2, -0.9])
    assert seen["position"][ROBOT.names.index("r_knee")] == -0.7  # the right knee turns the other way
    assert seen["joint_velocity"][ROBOT.names.index("head_pan")] == -1.5


def test_the_canonical_frame_and_the_mirror_commute() -> None:
    # A mirrored window must be the mirror image of the window's trajectory.
    raw = window(2)
    plain = Trajectory.of(torch.from_numpy(to_tokens(raw, raw[3], N))[None], N, 0.02)
    image = MIRROR(raw)
    seen = Trajectory.of(torch.from_numpy(to_tokens(image, image[3], N))[None], N, 0.02)
    flip = torch.tensor([1.0, -1.0], dtype=torch.double)
    torch.testing.assert_close(seen.displacement, plain.displacement * flip)
    torch.testing.assert_close(seen.velocity, plain.velocity * flip)
    torch.testing.assert_close(seen.yaw, -plain.yaw)
    torch.testing.assert_close(seen.yaw_rate, -plain.yaw_rate)
    torch.testing.assert_close(plain.joints[0].numpy(), RAW.split(raw)["position"])
    torch.testing.assert_close(plain.height[0].numpy(), RAW.split(raw)["displacement"][:, 2])


def test_a_state_becomes_the_raw_row_that_its_layout_says() -> None:
    state = State(
        time_ns=0,
        orientation=np.array([1.0, 0, 0, 0]),
        gravity=np.array([0.0, 0, -1]),
        yaw=np.float64(0.3),
        angular_velocity=np.array([0.1, 0.2, 0.3]),
        velocity=np.array([0.4, 0.5, 0.6]),
        displacement=np.array([1.0, 2.0, 0.26]),
        position=np.arange(N) / 10,
        joint_velocity=-np.arange(N) / 10,
        contact=np.ones(2),
    )
    row = RAW.split(raw_row(state))
    for name in ("displacement", "velocity", "angular_velocity", "gravity", "position", "joint_velocity"):
        np.testing.assert_allclose(row[name], getattr(state, name), rtol=1e-6)
    assert row["yaw"] == pytest.approx(0.3)


def test_a_feature_that_stands_still_is_not_blown_up() -> None:
    values = np.zeros((100, 2), dtype=np.float32)
    values[:, 1] = np.linspace(-3, 3, 100)
    normaliser = Normaliser.fit(values)
    assert normaliser.std[0] == pytest.approx(Normaliser.FLOOR)
    np.testing.assert_allclose(normaliser.decode(normaliser.encode(values)), values, atol=1e-6)


def test_a_layout_names_an_unknown_field() -> None:
    with pytest.raises(KeyError, match="no field 'speed'"):
        token_layout(N).slice("speed")

"""Quaternions and frames, over any leading dimensions."""

from __future__ import annotations

import numpy as np
from task_bodies import state

from servoid.hw.geometry import cross, headed, joined, multiply, rotate, split, to_heading, turned, up_vector, yaw_of

RNG = np.random.default_rng(0)
VECTORS = RNG.normal(size=(4, 5, 3))


def quaternions() -> np.ndarray:
    q = RNG.normal(size=(4, 5, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def test_components_come_apart_and_together() -> None:
    np.testing.assert_array_equal(joined(*split(VECTORS)), VECTORS)
    np.testing.assert_allclose(cross(VECTORS, VECTORS[0]), np.cross(VECTORS, VECTORS[0]))


def test_a_product_turns_by_the_second_and_then_by_the_first() -> None:
    a, b = quaternions(), quaternions()
    np.testing.assert_allclose(rotate(multiply(a, b), VECTORS), rotate(a, rotate(b, VECTORS)), atol=1e-12)


def test_up_is_seen_from_the_body() -> None:
    q = quaternions()
    np.testing.assert_allclose(rotate(q, up_vector(q)), np.broadcast_to([0, 0, 1.0], VECTORS.shape), atol=1e-12)


def test_turning_about_the_vertical_changes_the_heading_alone() -> None:
    q, angle = quaternions(), RNG.uniform(-3, 3, (4, 5))
    after = headed(q, angle)
    np.testing.assert_allclose(up_vector(after), up_vector(q), atol=1e-12)
    np.testing.assert_allclose(np.exp(1j * (yaw_of(after) - yaw_of(q))), np.exp(1j * angle), atol=1e-12)
    np.testing.assert_allclose(rotate(after, VECTORS), turned(rotate(q, VECTORS), angle), atol=1e-12)


def test_what_follows_x_and_y_stays_as_it_is() -> None:
    obstacles = np.array([[1.0, 3.0, 0.2], [0.0, 2.0, 0.1]])
    now = state(x=1.0, y=2.0, yaw=np.pi / 2)
    np.testing.assert_allclose(to_heading(obstacles, now), [[1, 0, 0.2], [0, 1, 0.1]], atol=1e-12)
    np.testing.assert_array_equal(obstacles[0], [1.0, 3.0, 0.2])  # the caller's array is the caller's

"""Left and right swapped."""

from __future__ import annotations

import numpy as np

from servoid.hw.robot.description import load_robot
from servoid.hw.robot.legs import Legs
from servoid.hw.robot.mirror import Mirror

ROBOT = load_robot()


def test_a_mirrored_pose_puts_each_foot_where_the_other_was() -> None:
    rng = np.random.default_rng(0)
    joints = ROBOT.home + rng.uniform(-0.3, 0.3, (10, 20))
    legs, feet = Legs(ROBOT), Mirror.feet(ROBOT)
    here = legs.forward(legs.pick(joints))[0]
    there = legs.forward(legs.pick(Mirror.joints(ROBOT)(joints)))[0]
    np.testing.assert_allclose(Mirror.VECTOR(here)[:, feet.index], there, atol=1e-9)


def test_a_joined_mirror_mirrors_each_part_and_undoes_itself() -> None:
    joints, feet = Mirror.joints(ROBOT), Mirror.feet(ROBOT)
    whole = Mirror.join(Mirror.ROTATION, joints, feet, Mirror.vectors(feet), Mirror.SCALAR)
    x = np.random.default_rng(1).normal(size=(4, 3 + 20 + 2 + 6 + 1))
    seen = whole(x)
    np.testing.assert_array_equal(seen[:, :3], x[:, :3] * [-1, 1, -1])
    np.testing.assert_array_equal(seen[:, 3:23], joints(x[:, 3:23]))
    np.testing.assert_array_equal(seen[:, 23:25], x[:, [24, 23]])
    np.testing.assert_array_equal(seen[:, 25:28], x[:, 28:31] * [1, -1, 1])
    np.testing.assert_array_equal(seen[:, 31], x[:, 31])
    np.testing.assert_array_equal(whole(seen), x)

"""A gait whose base goes lower than it walks."""

from __future__ import annotations

import numpy as np
import pytest

from servoid.hw.robot.description import load_robot
from servoid.hw.robot.legs import Legs
from servoid.policy.references.gait import Gait, load_gait

ROBOT, SETTINGS = load_robot(), load_gait()
LEGS = Legs(ROBOT)
PHASES = np.linspace(0, 1, 48, endpoint=False)


def test_a_lowered_gait_lowers_the_base_and_nothing_else() -> None:
    """By as much as it is asked, slowly, with its feet as they were but for a shift ahead; asked no more, it rises."""
    gait = Gait(ROBOT)
    gait.command(np.array([0.1, 0.0, 0.0]), np.array(0.02))
    gait.advance()
    assert 0.0 < gait.lowered < 0.001
    for _ in range(50):
        gait.advance()
    assert gait.lowered == pytest.approx(0.02)
    upright, low = (gait.pose(PHASES, np.zeros((48, 3)), np.ones(48), by)[0] for by in (0.0, 0.02))
    before, after = (LEGS.soles(LEGS.pick(joints))[0] for joints in (upright, low))
    np.testing.assert_allclose(
        np.linalg.norm(after - before, axis=-1), 0.02 * np.hypot(1.0, SETTINGS.lower_shift), atol=1e-4
    )
    gait.command(np.array([0.1, 0.0, 0.0]))
    for _ in range(50):
        gait.advance()
    assert gait.lowered == 0.0

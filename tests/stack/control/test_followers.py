"""What follows plans: the tracker of the gait where they walk, and else the tracker of any motion."""

from __future__ import annotations

import numpy as np

from servoid.hw.robot.description import load_robot
from servoid.policy.references.gait import Gait
from servoid.policy.references.plan import PlanReference, row_layout
from servoid.stack.control.fleet import Fleet
from servoid.stack.control.tracker import OVER_SECONDS, Followers, Tracker, walks

ROBOT = load_robot("op3")


def _walk(speed: float, height: float = ROBOT.standing_height) -> PlanReference:
    layout, reference = row_layout(ROBOT), PlanReference(ROBOT, (1,))
    rows = np.zeros((1, 60, layout.size))
    rows[..., layout.slice("place")] = [0.0, 0.0, height]
    rows[0, :, 0] = speed * ROBOT.dt * np.arange(60)
    rows[..., layout.slice("orientation")] = [1.0, 0.0, 0.0, 0.0]
    rows[..., layout.slice("position")] = ROBOT.home
    reference.follow(rows)
    return reference


def test_a_plan_walks_that_goes_somewhere_upright() -> None:
    assert walks(_walk(0.2), ROBOT).all()
    assert walks(_walk(-0.08), ROBOT).all()
    assert not walks(_walk(0.0), ROBOT).any()
    assert not walks(_walk(0.2, height=0.15), ROBOT).any(), "it crawls, or falls"


def test_it_goes_over_from_one_to_the_other_and_each_sees_every_tick() -> None:
    fleet = Fleet(ROBOT, 1, None, seed=0)
    fleet.reset(np.ones(1, bool))
    both, alone, walker = (
        Followers(ROBOT, "tracker", "expert", (1,)),
        Tracker(ROBOT, "tracker", (1,), clips=True),
        Tracker(ROBOT, "expert", (1,)),
    )
    still, walk = _walk(0.0), _walk(0.2)
    over = round(OVER_SECONDS / ROBOT.dt)
    for tick in range(3 + over + 1):
        state, reference = fleet.observe(), still if tick < 3 else walk
        target, a, b = (follow(state, fleet.applied, reference) for follow in (both, alone, walker))
        expected = a if tick < 3 else b
        if tick < 3 or tick >= 3 + over - 1:
            np.testing.assert_allclose(target, expected, atol=1e-6)
        fleet.step(target)


def test_the_gait_is_walked_by_its_own_tracker() -> None:
    """Told by a plan it goes as far as by the gait itself, where the tracker of clips steps on the spot."""
    gait, fleet = Gait(ROBOT, (1,)), Fleet(ROBOT, 1, None, seed=0)
    follow = Followers(ROBOT, "tracker", "expert", (1,))
    fleet.reset(np.ones(1, bool))
    for _ in range(150):
        gait.command(np.array([[0.2, 0.0, 0.0]]))
        fleet.step(follow(fleet.observe(), fleet.applied, gait))
        gait.advance()
    assert not fleet.truth.fallen.any()
    assert fleet.truth.position[0, 0] > 0.35

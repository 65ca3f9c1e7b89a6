"""Targets of a plan: what is asked, by how much it is missed, and from where it is seen."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.policy.diffusion.prefix import target
from servoid.policy.diffusion.prefix.frames import Anchor, Frames

ROBOT = load_robot("op3")
FRAMES = Frames(ROBOT)


def _turning(rate: float) -> torch.Tensor:
    """A second of standing that turns at `rate` rad/s: frames `(1, 25, size)`."""
    frames = torch.zeros(1, 25, FRAMES.layout.size)
    frames[..., FRAMES.layout.slice("yaw_rate")] = rate
    frames[..., FRAMES.layout.slice("gravity")] = torch.tensor([0.0, 0.0, -1.0])
    frames[..., FRAMES.layout.slice("height")] = 0.26
    frames[..., FRAMES.layout.slice("position")] = torch.from_numpy(ROBOT.home).float()
    return frames


@pytest.mark.parametrize(("asked", "off"), [(0.5, 0.0), (0.5 - np.pi, np.pi), (0.2, 0.3), (0.5 + 2 * np.pi, 0.0)])
def test_half_a_turn_too_many_is_the_worst_heading(asked: float, off: float) -> None:
    """Wrapped at half a turn, as a careless modulus does it, it would cost nothing."""
    wanted = target.of_points(FRAMES, [("heading", [asked])])
    _, angle = wanted.error(FRAMES, _turning(0.5))
    assert abs(float(angle)) == pytest.approx(off, abs=1e-5)
    assert float(wanted.loss(FRAMES, _turning(0.5))) == pytest.approx(off**2, abs=1e-4)


def test_only_what_is_asked_counts_and_a_point_of_the_ground_has_no_height() -> None:
    still = _turning(0.0)
    assert float(target.none(FRAMES, 1).loss(FRAMES, still)) == 0.0
    ground = target.of_points(FRAMES, [("ground", [0.3, 0.4])])
    assert float(ground.loss(FRAMES, still)) == pytest.approx((0.5 / target.SCALE) ** 2, rel=1e-4)
    pelvis = target.of_points(FRAMES, [("pelvis", [0.0, 0.0, 0.26])])
    assert float(pelvis.loss(FRAMES, still)) == pytest.approx(0.0, abs=1e-6)
    with pytest.raises(ConfigError, match="did you mean 'left hand'"):
        target.of_points(FRAMES, [("left hnd", [0.0, 0.0, 0.0])])
    with pytest.raises(ConfigError, match="was it seen"):
        target.of_points(FRAMES, [("head", [0.0, np.nan, 0.0])])


def test_a_target_drawn_from_frames_is_where_they_end() -> None:
    generator = torch.Generator().manual_seed(0)
    frames = _turning(0.4).expand(400, -1, -1)
    drawn = target.drawn(FRAMES, frames, generator)
    distance, angle = drawn.error(FRAMES, frames)
    assert float(distance.max()) < 1e-4
    assert float(angle.abs().max()) < 1e-5
    share = drawn.asked.float().sum(1)
    assert 0.2 < float((share == 0).float().mean()) < 0.3, "both draws are none in a quarter of the cases"
    assert int(share.max()) == 2


def test_a_target_seen_from_further_on_is_the_same_place() -> None:
    """A plan of two parts asks the second one for what is left."""
    first, second = _turning(1.0), _turning(0.0)
    both = torch.cat([first, second], 1)
    wanted = target.of_points(FRAMES, [("left hand", [0.1, 0.2, 0.3]), ("heading", [1.3])])
    end = Anchor.before(FRAMES.to_global(first), -1)
    left = wanted.moved(end.place, end.heading)
    for whole, part in zip(wanted.error(FRAMES, both), left.error(FRAMES, second), strict=True):
        torch.testing.assert_close(whole[..., wanted.asked[0, : whole.shape[-1]]] if whole.ndim > 1 else whole,
                                   part[..., wanted.asked[0, : part.shape[-1]]] if part.ndim > 1 else part,
                                   atol=1e-5, rtol=0)  # fmt: skip


def test_what_is_not_asked_is_not_shown() -> None:
    asked = target.of_points(FRAMES, [("left hand", [0.1, 0.2, 0.3])])
    code = asked.encode()
    assert code.shape == (1, target.size(FRAMES))
    asked.places[0, :2] = 9.0
    asked.heading[:] = 1.0
    torch.testing.assert_close(asked.encode(), code)

"""What a latent action is conditioned on: the part of a recorded row that does not depend on the place in the world."""

from __future__ import annotations

from servoid.policy.features import AnyArray, Layout, raw_layout

_HEIGHT = 2  # index of z among the displacement's x, y, z, which come first in a row, with yaw after them


def proprioception_layout(n_joints: int) -> Layout:
    """The fields of `proprioception`, SI units, frames as in `servoid.policy.features.raw_layout`."""
    of_row = dict(raw_layout(n_joints).fields)
    kept = ("velocity", "angular_velocity", "gravity", "position", "joint_velocity")
    return Layout((("height", 1), *((name, of_row[name]) for name in kept)))


def proprioception(raw: AnyArray) -> AnyArray:
    """Raw rows `(..., raw size)` without the place: `(..., raw size - 3)`, a numpy array or a torch tensor."""
    index = [_HEIGHT, *range(_HEIGHT + 2, raw.shape[-1])]
    return raw[..., index]

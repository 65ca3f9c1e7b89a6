"""A style of walking, authored: what the gait does otherwise, and what the joints of the upper body do meanwhile."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np

from servoid.hw.config import load_marked, nearest, resolve
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.policy.references.gait import GaitSettings


@dataclass(frozen=True)
class WalkingStyle:
    """`configs/styles/NAME.yaml`. What is said of a joint is said of its mirror, too, but where it is `one_sided`."""

    joints: dict[str, float] = field(default_factory=dict)  # rad at which joints are held, instead of at home
    swing: dict[str, float] = field(default_factory=dict)  # rad to which they swing from there, once a cycle
    gait: dict[str, float] = field(default_factory=dict)  # factors of the gait's own settings
    lower: float = 0.0  # m that the base goes lower
    dip: float = 0.0  # m that it goes lower on one foot: a limp
    one_sided: bool = False

    def changed(self, gait: GaitSettings) -> GaitSettings:
        """The gait of this style."""
        return replace(gait, **{name: factor * getattr(gait, name) for name, factor in self.gait.items()})

    def on(self, legs: WalkingStyle) -> WalkingStyle:
        """The arms and the head of this style, on the legs of another."""
        return replace(legs, joints=self.joints, swing=self.swing, one_sided=self.one_sided)

    def held(self, robot: Robot) -> tuple[Array, Array, Array]:
        """Joints that are not the gait's `(n_joints,)` bool, where they are held and how far they swing, rad."""
        where, at, swing = np.zeros(len(robot.joints), bool), robot.home.copy(), np.zeros(len(robot.joints))
        mirror, sign = robot.mirror
        for values, found, other in ((self.joints, at, 1.0), (self.swing, swing, -1.0)):
            for name, value in values.items():
                joint = robot.names.index(name)
                twin = int(mirror[joint])
                if not self.one_sided and twin != joint:  # half a cycle later
                    found[twin], where[twin] = other * sign[joint] * value, True
                found[joint], where[joint] = value, True
        return where, at, swing


def load_style(name: str, robot: Robot) -> WalkingStyle:
    """By a name in configs/styles, or by file. Raises ConfigError."""
    style, marks = load_marked(resolve("styles", name), WalkingStyle)
    legs = {robot.names[int(joint)] for leg in robot.leg_index for joint in leg}
    scaled = [f.name for f in fields(GaitSettings) if f.type == "float"]
    for key in style.gait:
        if key not in scaled:
            raise marks.error(f"gait.{key}", f"no such setting of the gait; {nearest(key, scaled)}")
    for part, values in (("joints", style.joints), ("swing", style.swing)):
        for key, value in values.items():
            if key not in robot.names:
                raise marks.error(f"{part}.{key}", f"{robot.name} has no such joint; {nearest(key, robot.names)}")
            if key in legs:
                raise marks.error(f"{part}.{key}", "the legs walk by the gait: say it by factors of its settings")
            joint = robot.names.index(key)
            if not robot.lower[joint] <= value <= robot.upper[joint]:
                low, high = robot.lower[joint], robot.upper[joint]
                raise marks.error(f"{part}.{key}", f"must be in its range of {low:g} to {high:g} rad, not {value:g}")
    return style

"""Weights of the terms of the guidance cost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from servoid.hw.setting import Setting, check


@dataclass(frozen=True)
class Weights:
    """Weights of the terms of the guidance cost, and the lengths that shape those about obstacles and bars."""

    velocity: Annotated[float, Setting("squared error of the mean velocity", "1/(m/s)^2", least=0)] = 1.0
    yaw_rate: Annotated[float, Setting("squared error of the mean turning rate", "1/(rad/s)^2", least=0)] = 0.1
    displacement: Annotated[float, Setting("squared error of where the motion ends", "1/m^2", least=0)] = 1.0
    yaw: Annotated[float, Setting("squared error of the heading at the end", "1/rad^2", least=0)] = 0.1
    stand: Annotated[float, Setting("squared velocity, where it shall stand", "1/(m/s)^2", least=0)] = 10.0
    speed: Annotated[float, Setting("squared error of the speed over the ground", "1/(m/s)^2", least=0)] = 0.0
    steering: Annotated[float, Setting("1 - cos(angle between velocity and the one asked)", least=0)] = 0.0
    heading: Annotated[float, Setting("1 - cos(angle between heading and velocity asked)", least=0)] = 0.0
    goal: Annotated[float, Setting("distance from the goal", "1/m", least=0)] = 0.0
    facing: Annotated[float, Setting("1 - cos(bearing of the goal), less within 0.1 m of it", least=0)] = 0.0
    waypoint: Annotated[float, Setting("squared distance from the goal", "1/m^2", least=0)] = 0.0
    path: Annotated[float, Setting("squared distance from the place on the path", "1/m^2", least=0)] = 10.0
    way: Annotated[float, Setting("distance from the goal by a free way", "1/m", least=0)] = 0.0
    along: Annotated[float, Setting("1 - cos(heading, free way), less within 0.1 m of the goal", least=0)] = 0.0
    repulsion: Annotated[float, Setting("exp(-sharpness distance), for each obstacle", least=0)] = 0.1
    sharpness: Annotated[float, Setting("how steeply repulsion falls", "1/m", above=0)] = 15.0
    avoidance: Annotated[float, Setting("softplus(1 - distance / margin), for each obstacle", least=0)] = 0.0
    margin: Annotated[float, Setting("distance at which avoidance sets in", "m", above=0)] = 0.275
    width: Annotated[
        float, Setting("from the robot's middle to its side, for obstacles; 0: its middle alone", "m", least=0)
    ] = 0.0
    depth: Annotated[float, Setting("from the robot's middle to its front", "m", least=0)] = 0.0
    safe: Annotated[float, Setting("distance at which repulsion ends; 0: it has no end", "m", least=0)] = 0.0
    reach: Annotated[float, Setting("distance of a hand from its target", "1/m", least=0)] = 0.0
    bar: Annotated[float, Setting("squared height by which the robot does not clear a bar", "1/m^2", least=0)] = 0.0
    beneath: Annotated[float, Setting("distance from a bar within which the robot is low", "m", above=0)] = 0.15
    gap: Annotated[float, Setting("height kept between a bar and the robot", "m", least=0)] = 0.01

    def __post_init__(self) -> None:
        check(self)
        if self.depth > self.width:
            raise ValueError(f"depth: {self.depth:g} must not be more than width ({self.width:g})")

    @property
    def twist(self) -> bool:
        """Whether any term counts that is about the velocity, which every instruction holds."""
        return any((self.velocity, self.yaw_rate, self.displacement, self.yaw, self.stand))


@dataclass(frozen=True)
class FreeWeights(Weights):
    """Weights for a planner that finds the way by itself: no velocity that a script asks for counts by default."""

    velocity: Annotated[float, Setting("squared error of the mean velocity", "1/(m/s)^2", least=0)] = 0.0
    yaw_rate: Annotated[float, Setting("squared error of the mean turning rate", "1/(rad/s)^2", least=0)] = 0.0
    displacement: Annotated[float, Setting("squared error of where the motion ends", "1/m^2", least=0)] = 0.0
    yaw: Annotated[float, Setting("squared error of the heading at the end", "1/rad^2", least=0)] = 0.0
    stand: Annotated[float, Setting("squared velocity, where it shall stand", "1/(m/s)^2", least=0)] = 0.0

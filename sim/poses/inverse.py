"""Inverse kinematics of a whole robot along a motion, by mink's quadratic programs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.geometry import rotate
from servoid.hw.robot.description import Robot
from servoid.sim.model import build

_FIRST, _EACH = 60, 6  # steps for the first tick, and for each after it, from the pose before
# Times the speed that the guard allows, that joints may have: feet come before speeds, and arms after them.
_FASTEST, _ARMS = 3.0, 0.85
_FOOT_TURN = 0.1  # weight of a foot's turn [rad], to that of its place [m]
_SWINGING = 0.05  # weight of a foot in the air, to one that stands


@dataclass(frozen=True)
class FollowWeights:
    feet: float
    base: float  # of its height
    balance: float  # of the base's place, level, over the feet
    tilt: float
    arms: float
    posture: float


@dataclass(frozen=True)
class FollowedPoints:
    """A motion as places that a robot follows, of `ticks`."""

    base: Array  # (ticks, 3) m
    turn: Array  # (ticks, 4) quaternion w x y z of the base
    soles: Array  # (ticks, n_feet, 3) m, of their centres
    heading: Array  # (ticks, n_feet) rad; soles are level
    carries: Array  # (ticks, n_feet) bool
    geoms: dict[str, Array]  # (ticks, 3) m of geoms in the base frame


class Inverse:
    """Raises ConfigError where mink is not installed. `narrower` are ranges [rad] of joints within their own."""

    def __init__(self, robot: Robot, weights: FollowWeights, narrower: Mapping[str, tuple[float, float]]) -> None:
        try:
            import mink
        except ModuleNotFoundError:
            raise ConfigError("this needs the 'motions' extra: pip install 'servoid[motions]'") from None
        self._mink, self._robot, self._weights = mink, robot, weights
        model = build(robot)
        ids = [model.joint(name).id for name in robot.names]
        margin = robot.limits.margin
        model.jnt_limited[ids] = 1
        model.jnt_range[ids] = np.stack([robot.lower + margin, robot.upper - margin], -1)
        for name, ends in narrower.items():
            model.joint(name).range[:] = ends
        self._model, self._at = model, model.jnt_qposadr[ids]
        feet = list(robot.feet.values())
        self._links = [model.body(int(model.geom(foot.geoms[0]).bodyid[0])).name for foot in feet]
        self._sole = np.array([foot.sole for foot in feet])

    def follow(self, asked: FollowedPoints) -> tuple[Array, Array, Array]:
        """Joints `(ticks, n_joints)` rad, place `(ticks, 3)` m and quaternion `(ticks, 4)` of the base."""
        mink, w = self._mink, self._weights
        base = mink.FrameTask(self._robot.base, "body", [w.balance, w.balance, w.base], w.tilt)
        feet = [mink.FrameTask(link, "body", w.feet, w.feet * _FOOT_TURN) for link in self._links]
        geoms = {name: mink.FrameTask(name, "geom", w.arms, 0.0) for name in asked.geoms}
        posture = mink.PostureTask(self._model, cost=w.posture)
        tasks = [base, *feet, *geoms.values(), posture]
        legs = {link.joint for leg in self._robot.legs.values() for link in leg}
        faster = {name: _FASTEST if name in legs else _ARMS for name in self._robot.names}
        most = {name: factor * self._robot.limits.joint_speed for name, factor in faster.items()}
        limits = [mink.ConfigurationLimit(self._model), mink.VelocityLimit(self._model, most)]
        start = np.zeros(self._model.nq)
        start[:3], start[3:7], start[self._at] = asked.base[0], asked.turn[0], self._robot.home
        configuration = mink.Configuration(self._model, q=start)
        posture.set_target(start)
        out = np.empty((len(asked.base), self._model.nq))
        for tick in range(len(out)):
            base.set_target(self._frame(asked.turn[tick], asked.base[tick]))
            for i, foot in enumerate(feet):
                foot.set_target(self._ankle(asked, tick, i))
                share = 1.0 if asked.carries[tick, i] else _SWINGING
                foot.set_position_cost(share * w.feet)
                foot.set_orientation_cost(share * w.feet * _FOOT_TURN)
            dt = self._robot.dt / _EACH if tick else 1.0  # s of a step: the first tick comes from nowhere
            for _ in range(_EACH if tick else _FIRST):
                for name, task in geoms.items():
                    place = configuration.q[:3] + rotate(configuration.q[3:7], asked.geoms[name][tick])
                    task.set_target(self._frame(np.array([1.0, 0.0, 0.0, 0.0]), place))
                velocity = mink.solve_ik(configuration, tasks, dt, "daqp", damping=1e-6, limits=limits)
                configuration.integrate_inplace(velocity, dt)
            out[tick] = configuration.q
        return out[:, self._at], out[:, :3], out[:, 3:7]

    def _frame(self, turn: Array, place: Array) -> object:
        return self._mink.SE3(np.concatenate([turn, place]))

    def _ankle(self, asked: FollowedPoints, tick: int, foot: int) -> object:
        """Where the link that holds a sole is."""
        half = asked.heading[tick, foot] / 2
        turn = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
        return self._frame(turn, asked.soles[tick, foot] - rotate(turn, self._sole[foot]))

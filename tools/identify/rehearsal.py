"""Recorded motions done again by a hanging robot in simulation, many servos at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot, Servo
from servoid.sim.joints.friction import friction
from servoid.sim.model import TIMESTEP
from servoid.tools.identify.hanging import BASE, HELD, hanging_model
from servoid.tools.identify.recording import Piece

_R, _K, _KP, _KD, _VMAX = 0, 1, 4, 6, 7  # indices in a dcmotor's gainprm, as in sim/model.py
_TINY = 1e-9


@dataclass(frozen=True)
class Candidate:
    """The servo of each joint, and the supply's resistance [Ohm]."""

    servos: tuple[Servo, ...]
    resistance: float


class Rehearsal:
    """Repeats pieces. Unlike in training, the supply sags, and a delay need not be whole steps of the physics: a goal
    that comes in the middle of a step acts for half of it."""

    def __init__(self, robot: Robot, pieces: Sequence[Piece]) -> None:
        self.robot, self.pieces = robot, list(pieces)
        self._substeps = round(robot.dt / TIMESTEP)
        alike: dict[str, list[int]] = {}
        for i, piece in enumerate(pieces):
            alike.setdefault(repr((sorted(piece.robot.loads.items()), piece.gravity.round(3).tolist())), []).append(i)
        self._groups = list(alike.values())  # of one model and one gravity each

    def angles(self, candidates: Sequence[Candidate]) -> list[Array]:
        """What encoders would have said: of each piece `(candidates, ticks, n_joints)` rad."""
        found: dict[int, Array] = {}
        for group in self._groups:
            rows = self._run([self.pieces[i] for i in group], candidates)
            found.update(zip(group, rows, strict=True))
        return [found[i] for i in range(len(self.pieces))]

    def _run(self, pieces: Sequence[Piece], candidates: Sequence[Candidate]) -> list[Array]:
        from mujoco.batch import Batch

        model = hanging_model(pieces[0].robot)
        model.opt.gravity[:] = pieces[0].gravity
        n, m, nj, sub = len(candidates), len(pieces), len(self.robot.joints), self._substeps
        ticks = max(len(piece.goal) for piece in pieces)
        batch = Batch(model, n * m, 1)
        dofs = np.array([int(model.joint(name).dofadr[0]) for name in self.robot.names])
        qpos, qvel, control = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
        force, gain = batch.bind("actuator_force"), batch.expand("actuator_gainprm")

        def servos(name: str) -> Array:  # a row for each world: of a candidate, each of its pieces
            values = np.array([[getattr(servo, name) for servo in c.servos] for c in candidates], dtype=float)
            return np.repeat(values, m, 0)

        volts, stall, top = servos("voltage"), servos("stall_torque"), servos("no_load_speed")
        k = volts / top
        r = k * volts / stall
        gain[:, :, _R], gain[:, :, _K], gain[:, :, _KD] = r, k, k * k / r
        limit = servos("braking_torque")
        bounds = batch.expand("actuator_forcerange")
        bounds[:, :, 0], bounds[:, :, 1] = -limit, limit
        batch.expand("dof_damping")[:, dofs] = _padded(servos("damping"), batch.expand("dof_damping")[:, dofs])
        armature = batch.expand("dof_armature")
        armature[:, dofs] = servos("armature")
        batch.set_const(np.arange(n * m))
        armature[:, BASE] = HELD
        loss = batch.expand("dof_frictionloss")
        laws = [servos(name) for name in ("friction", "stribeck_friction", "stribeck_speed", "load_friction")]
        loss[:, dofs] = laws[0]
        varies = bool((laws[1] > 0).any() or (laws[3] > 0).any())

        rest = np.stack([piece.voltage for piece in pieces])[np.tile(np.arange(m), n)]
        resistance = np.repeat([c.resistance for c in candidates], m)[:, None]
        goal = np.stack([_held(piece.goal, ticks) for piece in pieces])
        factor = np.stack([_held(piece.gain, ticks) for piece in pieces])[np.tile(np.arange(m), n)]
        wanted = _delayed(goal[np.tile(np.arange(m), n)], servos("command_delay"), self.robot.dt, sub)
        stiffness, ampere = servos("stiffness") / volts, servos("torque_per_ampere")

        joints = np.array([int(model.joint(name).qposadr[0]) for name in self.robot.names])
        qpos[:, joints] = np.tile(np.stack([piece.measured[0] for piece in pieces]), (n, 1))
        went = np.empty((n * m, ticks * sub + 1, nj))
        went[:, 0] = qpos[:, joints]
        supply = rest.copy()
        for step in range(ticks * sub):
            error = wanted[:, step] - qpos[:, joints]
            kp = stiffness * supply * factor[:, step // sub]
            gain[:, :, _KP], gain[:, :, _VMAX] = kp, supply
            control[:] = wanted[:, step]
            if varies:
                loss[:, dofs] = friction(laws[0], laws[1], laws[2], laws[3], qvel[:, dofs], force)
            batch.step()
            went[:, step + 1] = qpos[:, joints]
            duty = np.clip(kp * r / k * error / supply, -1.0, 1.0)
            drawn = np.maximum(duty * force / ampere, 0.0).sum(-1, keepdims=True)
            supply = np.maximum(rest - resistance * drawn, 0.3 * rest)

        # A tick reads what the encoders said a latency ago.
        at = np.clip(np.arange(ticks)[:, None] * sub - servos("position_latency")[0] / TIMESTEP, 0.0, None)
        before = np.floor(at + _TINY).astype(int)
        share, each = at - before, np.arange(nj)
        seen = went[:, before, each] * (1 - share) + went[:, before + (share > _TINY), each] * share
        seen = seen.reshape(n, m, ticks, nj)
        return [seen[:, i, : len(piece.goal)] for i, piece in enumerate(pieces)]


def _padded(values: Array, field: Array) -> Array:
    """Values for a field that may hold more than one coefficient a joint."""
    if field.ndim == values.ndim:
        return values
    result = np.zeros_like(field)
    result[..., 0] = values
    return result


def _held(values: Array, ticks: int) -> Array:
    """`(ticks, ...)`: the last value goes on."""
    return np.concatenate([values, np.repeat(values[-1:], ticks - len(values), 0)])


def _delayed(goal: Array, delay: Array, dt: float, substeps: int) -> Array:
    """The mean goal in force over each step of the physics `(worlds, ticks * substeps, n_joints)`, of goals
    `(worlds, ticks, n_joints)` that each act a delay `(worlds, n_joints)` s after their tick."""
    worlds, ticks, nj = goal.shape
    whole = np.concatenate([np.zeros((worlds, 1, nj)), np.cumsum(goal, 1)], 1)  # goals of the ticks before, added up
    first = goal[:, :1]

    def added(at: Array) -> Array:  # at: (worlds, steps, nj) in ticks
        inside = np.clip(at, 0.0, ticks - 1e-9)
        i = inside.astype(int)
        sums = np.take_along_axis(whole, i, 1) + (inside - i) * np.take_along_axis(goal, i, 1)
        early: Array = sums + np.minimum(at, 0.0) * first
        return early

    starts = np.arange(ticks * substeps + 1)[None, :, None] / substeps - delay[:, None, :] / dt
    totals = added(starts)
    result: Array = np.diff(totals, axis=1) * substeps
    return result

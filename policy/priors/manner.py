"""How a robot walks, beside how well: amplitude of the leg joints and cadence, by speed. Pure functions of joints.

A return does not show the manner: what shuffles may keep the speed that is asked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.policy.features import raw_layout
from servoid.policy.recording import Recording

_SLOWEST, _FASTEST = 0.5, 5.0  # cycles a second that a walk may have
_STEADY = 0.4  # of the top turning rate, and of the top speed sideways, below which a walk counts as straight
_SKIPPED = 1.0  # s after a change of command
_LEAST = 20.0  # s of walking that a row of the table needs


def legs(robot: Robot) -> list[int]:
    """Numbers of the leg joints."""
    return sorted(int(joint) for leg in robot.leg_index for joint in leg)


def amplitude(joints: Array) -> Array:
    """Half of the swing of a sine as strong as each joint's motion `(n_joints,)` rad; `joints` is `(ticks, n_joints)`,
    or `(n, ticks, n_joints)` of so many walks."""
    deviation = joints.std(-2)
    return np.sqrt(2.0 * np.mean(deviation.reshape(-1, joints.shape[-1]) ** 2, 0))


def cadence(joints: Array, rate: float) -> float:
    """Cycles a second [Hz]: where the spectra of `joints` `(..., ticks, n)` are highest together; NaN without motion.

    Left and right step in turn, so that a leg's joints repeat once a cycle.
    """
    walks = joints.reshape(-1, *joints.shape[-2:])
    ticks = walks.shape[1]
    window = np.hanning(ticks)[:, None]
    padded = max(4 * ticks, 1)
    power = np.abs(np.fft.rfft((walks - walks.mean(1, keepdims=True)) * window, padded, axis=1)) ** 2
    total = power.sum((0, 2))
    frequency = np.fft.rfftfreq(padded, 1.0 / rate)
    inside = (frequency >= _SLOWEST) & (frequency <= _FASTEST)
    if not total[inside].max(initial=0.0) > 1e-9:
        return float("nan")
    return float(frequency[inside][np.argmax(total[inside])])


def manner_by_speed(
    recordings: Sequence[Recording], robot: Robot, bins: int = 6, seconds: float = 1.44
) -> dict[str, Any]:
    """The manner of straight walking in a dataset, by the measured speed: what a checkpoint of a prior keeps.

    Of equal shares of the robot's top speed, those at which it walked for 20 s or more, in pieces of `seconds`.
    """
    ticks, top = round(seconds * robot.rate), robot.walking
    pieces: list[list[Array]] = [[] for _ in range(bins)]
    speeds: list[list[float]] = [[] for _ in range(bins)]
    at = raw_layout(len(robot.joints))
    for recording in recordings:
        change = np.r_[True, np.any(np.diff(recording.command, axis=0) != 0.0, axis=1)]
        change |= np.r_[True, np.diff(recording.episode) != 0]
        bounds = np.r_[np.flatnonzero(change), len(change)]
        for first, end in pairwise(bounds):
            asked = recording.command[first]
            if abs(asked[1]) > _STEADY * top.sideways or abs(asked[2]) > _STEADY * top.turning or asked[0] <= 0.0:
                continue
            for begin in range(first + round(_SKIPPED * robot.rate), end - ticks + 1, ticks):
                raw = recording.raw[begin : begin + ticks]
                speed = float(raw[:, at.slice("velocity")][:, 0].mean())
                number = int(bins * speed / top.forward)
                if 0 <= number < bins:
                    pieces[number].append(raw[:, at.slice("position")])
                    speeds[number].append(speed)
    rows = [i for i in range(bins) if len(pieces[i]) * seconds >= _LEAST]
    found = [np.stack(pieces[i]) for i in rows]
    legs_of = legs(robot)
    return {
        "speed": [round(float(np.mean(speeds[i])), 4) for i in rows],  # m/s
        "amplitude": [np.round(amplitude(x), 4).tolist() for x in found],  # rad, by joint
        "cadence": [round(cadence(x[..., legs_of], robot.rate), 4) for x in found],  # Hz
    }


def beside(manner: Mapping[str, Any], robot: Robot, joints: Array, speed: float) -> dict[str, float]:
    """The manner of walks `joints` `(n, ticks, n_joints)` at a mean `speed` [m/s], by ratios to the data's at it.

    `amplitude` is the mean ratio over the leg joints, each weighted by what it does in the data, and `amplitude_error`
    the mean of how far ratios are from 1, weighted likewise. NaN where the data has no straight walking.
    """
    if not manner.get("speed"):
        return dict.fromkeys(("amplitude", "amplitude_error", "cadence", "cadence_hz"), float("nan"))
    legs_of, at = legs(robot), np.array(manner["speed"])
    table = np.array(manner["amplitude"])[:, legs_of]
    theirs = np.array([np.interp(speed, at, column) for column in table.T])
    ratio = amplitude(joints[..., legs_of]) / np.maximum(theirs, 1e-6)
    weight = theirs / theirs.sum()
    hertz = cadence(joints[..., legs_of], robot.rate)
    return {
        "amplitude": float(ratio @ weight),
        "amplitude_error": float(np.abs(ratio - 1.0) @ weight),
        "cadence": hertz / float(np.interp(speed, at, manner["cadence"])),
        "cadence_hz": hertz,
    }

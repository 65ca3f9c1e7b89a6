"""Clips of DeepMimic (X. B. Peng et al., 2018): JSON with a frame of 44 numbers of its humanoid."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.geometry import multiply, rotate
from servoid.tools.motions.human.key_points import CapturedMotion

# Where a joint is in its parent, m, x forward, y up, z right; columns of a frame that hold its turn: a quaternion
# w x y z, or an angle about z. From the character's file.
_ROOT = slice(4, 8)
_JOINTS = {
    "chest": ("hips", (0.0, 0.236151, 0.0), slice(8, 12)),
    "neck": ("chest", (0.0, 0.223894, 0.0), slice(12, 16)),
    "right_hip": ("hips", (0.0, 0.0, 0.084887), slice(16, 20)),
    "right_knee": ("right_hip", (0.0, -0.421546, 0.0), slice(20, 21)),
    "right_ankle": ("right_knee", (0.0, -0.40987, 0.0), slice(21, 25)),
    "right_toe": ("right_ankle", (0.13, -0.03, 0.0), None),
    "right_shoulder": ("chest", (-0.02405, 0.2435, 0.18311), slice(25, 29)),
    "right_elbow": ("right_shoulder", (0.0, -0.274788, 0.0), slice(29, 30)),
    "right_hand": ("right_elbow", (0.0, -0.258947, 0.0), None),
    "left_hip": ("hips", (0.0, 0.0, -0.084887), slice(30, 34)),
    "left_knee": ("left_hip", (0.0, -0.421546, 0.0), slice(34, 35)),
    "left_ankle": ("left_knee", (0.0, -0.40987, 0.0), slice(35, 39)),
    "left_toe": ("left_ankle", (0.13, -0.03, 0.0), None),
    "left_shoulder": ("chest", (-0.02405, 0.2435, -0.18311), slice(39, 43)),
    "left_elbow": ("left_shoulder", (0.0, -0.274788, 0.0), slice(43, 44)),
    "left_hand": ("left_elbow", (0.0, -0.258947, 0.0), None),
}
NUMBERS = 44
RATE = 60.0  # ticks a second that frames of uneven length are resampled at


def read_deepmimic(path: Path, text: str) -> CapturedMotion:
    """Key points of a clip. Raises ConfigError naming what is wrong."""
    try:
        rows = json.loads(text)["Frames"]
    except (ValueError, KeyError, TypeError):
        raise ConfigError(f'{path}: not a clip of DeepMimic, or cut off: it needs JSON with "Frames"') from None
    if not isinstance(rows, list) or len(rows) < 2:
        raise ConfigError(f"{path}: holds too few frames: at least 2 are needed")
    for number, row in enumerate(rows, 1):
        if not isinstance(row, list) or len(row) != NUMBERS:
            size = len(row) if isinstance(row, list) else 0
            raise ConfigError(f"{path}: frame {number} has {size} numbers, and DeepMimic's humanoid {NUMBERS}")
    frames = np.array(rows, dtype=float)
    if not np.isfinite(frames).all() or not (frames[:-1, 0] > 0.0).all():
        raise ConfigError(f"{path}: a frame is not finite, or lasts no time")
    times = np.r_[0.0, np.cumsum(frames[:-1, 0])]
    at = np.arange(int(times[-1] * RATE) + 1) / RATE
    places = _places(frames)
    points = {
        name: np.stack([np.interp(at, times, column) for column in place.T], -1) for name, place in places.items()
    }
    return CapturedMotion(RATE, points)


def _places(frames: Array) -> dict[str, Array]:
    turns, places = {"hips": _unit(frames[:, _ROOT])}, {"hips": frames[:, 1:4]}
    for name, (parent, offset, columns) in _JOINTS.items():
        places[name] = places[parent] + rotate(turns[parent], np.tile(offset, (len(frames), 1)))
        if columns is None:
            continue
        values = frames[:, columns]
        turn = _unit(values) if values.shape[1] == 4 else _about_z(values[:, 0])
        turns[name] = multiply(turns[parent], turn)
    del places["chest"]
    return {name: place[:, [0, 2, 1]] * [1.0, -1.0, 1.0] for name, place in places.items()}  # z up, y left


def _unit(quaternion: Array) -> Array:
    return quaternion / np.maximum(np.linalg.norm(quaternion, axis=-1, keepdims=True), 1e-9)


def _about_z(angle: Array) -> Array:
    zero = np.zeros_like(angle)
    return np.stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)], -1)

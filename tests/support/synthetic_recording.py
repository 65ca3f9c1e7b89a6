"""A small made-up recording: a body that glides and turns while its joints swing, and an expert that leads them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.policy.features import recorded_names


def episode(robot: Robot, ticks: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Raw rows, clean actions and applied actions of one episode."""
    n, dt = len(robot.joints), robot.dt
    speed, turn = rng.uniform(-0.1, 0.3), rng.uniform(-0.8, 0.8)
    t = np.arange(ticks + 1) * dt
    yaw = rng.uniform(-3, 3) + turn * t
    steps = speed * dt * np.stack([np.cos(yaw), np.sin(yaw)], -1)
    xy = rng.uniform(-5, 5, 2) + np.cumsum(steps, 0)
    phase = 2 * np.pi * (2.0 * t[:, None] + rng.uniform())
    swing = 0.2 * speed * np.sin(phase + np.arange(n))
    joints = robot.home + swing
    velocity = np.gradient(joints, dt, axis=0)
    columns = [
        xy,
        np.full((ticks + 1, 1), robot.standing_height),
        yaw[:, None],
        np.tile([speed, 0.0, 0.0], (ticks + 1, 1)),
        np.tile([0.0, 0.0, turn], (ticks + 1, 1)),
        np.tile([0.0, 0.0, -1.0], (ticks + 1, 1)),
        joints,
        velocity,
    ]
    raw = np.concatenate(columns, 1)
    action = joints[1:]
    return raw[:-1], action, action + rng.normal(0, 0.05, action.shape)


def write_dataset(folder: Path, robot: Robot, episodes: int = 12, ticks: int = 120, seed: int = 0) -> Path:
    """Write such a recording in the layout of `servoid collect`."""
    rng = np.random.default_rng(seed)
    raws, actions, applied = zip(*(episode(robot, ticks, rng) for _ in range(episodes)), strict=True)
    frame = np.tile(np.arange(ticks), episodes)

    def rows(parts: tuple[Array, ...]) -> pa.Array:
        flat = np.concatenate(parts).astype(np.float32)
        return pa.FixedSizeListArray.from_arrays(pa.array(flat.ravel()), flat.shape[1])

    table = pa.table(
        {
            "observation.state": rows(raws),
            "action": rows(actions),
            "action_applied": rows(applied),
            "command": rows(tuple(np.tile([turn, 0.0, 0.0], (ticks, 1)) for turn in rng.uniform(-0.1, 0.3, episodes))),
            "episode_index": np.repeat(np.arange(episodes), ticks),
            "frame_index": frame,
            "timestamp": (frame * robot.dt).astype(np.float32),
        }
    )
    (folder / "data" / "chunk-000").mkdir(parents=True)
    (folder / "meta").mkdir()
    half = table.num_rows // 2  # an episode may straddle two files
    pq.write_table(table.slice(0, half + 7), folder / "data" / "chunk-000" / "file-000.parquet")
    pq.write_table(table.slice(half + 7), folder / "data" / "chunk-000" / "file-001.parquet")
    features = {name: {"names": names} for name, names in recorded_names(robot).items()}
    info = {"codebase_version": "v3.0", "fps": robot.rate, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    return folder

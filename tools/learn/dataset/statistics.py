"""What LeRobot keeps of each feature's values: minimum, maximum, mean, deviation, count, and quantiles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoid.hw.contracts.body import Array

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
KEYS = ("min", "max", "mean", "std", "count", *QUANTILES)

Statistics = dict[str, Array]


def statistics(values: Array) -> Statistics:
    """Of `(frames, size)` or `(frames,)`: each `(size,)` or `(1,)`, and the count `(1,)`. Quantiles are exact."""
    rows = values.reshape(len(values), -1)
    quantiles = np.quantile(rows, list(QUANTILES.values()), axis=0)
    return {
        "min": rows.min(0),
        "max": rows.max(0),
        "mean": rows.mean(0, dtype=np.float64),
        "std": rows.std(0, dtype=np.float64),
        "count": np.array([len(rows)]),
        **dict(zip(QUANTILES, quantiles, strict=True)),
    }


def of_pictures(pictures: Sequence[Array], frames: int) -> Statistics:
    """Of some of the pictures `(height, width, 3)` uint8 of a film of so many frames: each `(3, 1, 1)`, of 0 to 1."""
    pixels = np.concatenate([picture.reshape(-1, 3) for picture in pictures]) / 255.0
    found = {key: value.reshape(3, 1, 1) for key, value in statistics(pixels).items() if key != "count"}
    return {**found, "count": np.array([frames])}


def together(parts: Sequence[Statistics]) -> Statistics:
    """Of several films, whose pictures are not looked at again: a lower quantile is the least of theirs, a higher one
    the greatest, as LeRobot has it."""
    count = np.array([part["count"][0] for part in parts], float)
    weight = count / count.sum()
    mean = sum(w * part["mean"] for w, part in zip(weight, parts, strict=True))
    spread = sum(w * (part["std"] ** 2 + (part["mean"] - mean) ** 2) for w, part in zip(weight, parts, strict=True))
    return {
        "min": np.min([part["min"] for part in parts], axis=0),
        "max": np.max([part["max"] for part in parts], axis=0),
        "mean": np.asarray(mean),
        "std": np.sqrt(spread),
        "count": np.array([int(count.sum())]),
        **{
            key: (np.min if share <= 0.5 else np.max)([part[key] for part in parts], axis=0)
            for key, share in QUANTILES.items()
        },
    }

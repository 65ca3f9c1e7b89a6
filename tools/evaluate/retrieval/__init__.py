"""How well motions go with sentences, in the embedding of a contrastive encoder: pure functions of arrays.

As in T2M (Guo et al. 2022), whose measures CLoSD reports.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoid.hw.contracts.body import Array

POOL = 32  # sentences that a motion is to be told from
TOP = (1, 2, 3)


def r_precision(motion: Array, text: Array, label: Array, rng: np.random.Generator) -> dict[str, float]:
    """Share of motions `(n, k)` whose own sentence is among the nearest 1, 2 and 3 of `POOL`, the others being of other
    labels.

    `text` `(labels, k)` is a sentence of each label, `label` `(n,)` which one a motion was made for. Raises ValueError
    for fewer labels than a pool has.
    """
    if len(text) < POOL:
        raise ValueError(f"R-precision needs {POOL} different sentences, not {len(text)}")
    rank = np.empty(len(motion), int)
    for i, own in enumerate(label):
        others = rng.choice(np.delete(np.arange(len(text)), own), POOL - 1, replace=False)
        apart = np.linalg.norm(text[np.append(others, own)] - motion[i], axis=-1)
        rank[i] = int((apart[:-1] <= apart[-1]).sum())
    return {f"r_precision_top{top}": float((rank < top).mean()) for top in TOP}


def frechet_distance(a: Array, b: Array) -> float:
    """FID between embeddings `(n, k)` and `(m, k)`: |mean difference|^2 + trace(A + B - 2 (AB)^(1/2))."""
    first, second = np.cov(a, rowvar=False), np.cov(b, rowvar=False)
    values, vectors = np.linalg.eigh(first)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    cross = np.sqrt(np.maximum(np.linalg.eigvalsh(root @ second @ root), 0.0)).sum()
    apart = a.mean(0) - b.mean(0)
    return float(apart @ apart + np.trace(first) + np.trace(second) - 2.0 * cross)


def multimodal_distance(motion: Array, text: Array, label: Array) -> float:
    """Mean distance of motions from their own sentences."""
    return float(np.linalg.norm(motion - text[label], axis=-1).mean())


def diversity(motion: Array, rng: np.random.Generator, pairs: int = 300) -> float:
    """Mean distance of motions drawn at random."""
    picks = rng.integers(len(motion), size=(2, pairs))
    return float(np.linalg.norm(motion[picks[0]] - motion[picks[1]], axis=-1).mean())


def multimodality(motion: Array, label: Array) -> float:
    """Mean distance of motions of the same label; NaN where none has two."""
    apart: list[float] = []
    for one in np.unique(label):
        same = motion[label == one]
        if len(same) > 1:
            each = np.linalg.norm(same[:, None] - same[None], axis=-1)
            apart.append(float(each[np.triu_indices(len(same), 1)].mean()))
    return float(np.mean(apart)) if apart else float("nan")


def measures(motion: Array, text: Array, label: Array, data: Array, rng: np.random.Generator) -> dict[str, float]:
    """All of them; `data` `(m, k)` are embeddings of the data's own motions."""
    return {
        **r_precision(motion, text, label, rng),
        "fid": frechet_distance(motion, data),
        "multimodal_distance": multimodal_distance(motion, text, label),
        "diversity": diversity(motion, rng),
        "multimodality": multimodality(motion, label),
    }


COLUMNS: Sequence[str] = (
    *(f"r_precision_top{top}" for top in TOP), "fid", "multimodal_distance", "diversity", "multimodality",
)  # fmt: skip

"""Figures of many episodes: means with their spread, and what one policy's are beyond another's on the same seeds."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from servoid.tools.common.confidence import bootstrap, wilson

Row = Mapping[str, Any]  # of an episode
SHARES = ("success_rate", "fall_rate", "aborted_rate", "fell_ending_rate")
RECOVERIES = ("falls", "recovered_share", "time_to_stand_s")
_KEYS = dict(zip(SHARES, ("success", "fell", "aborted", "fell_ending"), strict=True))  # of an episode's row


def figures(row: Row) -> dict[str, float]:
    """All figures of one episode: shares as 0 or 1, `seconds`, and those metrics that it has."""
    measured = {**row["metrics"], "odometry_error_m": row["odometry_error_m"]}
    known = {name: float(value) for name, value in sorted(measured.items()) if value is not None}
    shares = {name: float(row[key]) for name, key in _KEYS.items()}
    return {**shares, "mean_seconds": row["seconds"], **{name: v for name, v in known.items() if math.isfinite(v)}}


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Means over the episodes that have a figure, standard deviations beside them (`sd`; of two episodes at least)."""
    import numpy as np

    each, n, successes = [figures(row) for row in rows], len(rows), sum(row["success"] for row in rows)
    values = {
        name: [one[name] for one in each if name in one] for name in dict.fromkeys(n for one in each for n in one)
    }
    means = {name: float(np.mean(found)) for name, found in values.items()}
    spread = {name: float(np.std(found, ddof=1)) if len(found) > 1 else None for name, found in values.items()}
    known = {name for row in rows for name in row["metrics"]} | {"odometry_error_m"}
    metrics = {name: means.get(name) for name in sorted(known)}
    return {
        "episodes": n,
        **{name: means[name] for name in SHARES},
        "success_ci95": wilson(successes, n),
        **(recoveries(rows) if all("falls" in row for row in rows) else {}),
        "mean_seconds": means["mean_seconds"],
        "metrics": metrics,
        "sd": {name: spread.get(name) for name in ("mean_seconds", *metrics)},
        "failed_seeds": [row["seed"] for row in rows if not row["success"]],
        "falls_by": dict(Counter(row["fall"] for row in rows if row["fall"] is not None).most_common()),
    }


def recoveries(rows: Sequence[Row]) -> dict[str, Any]:
    """Of robots that may get up: falls of all episodes, the share of them that they got up from, and the median time
    from lying still to standing."""
    import numpy as np

    falls, seconds = sum(row["falls"] for row in rows), [s for row in rows for s in row["stand_seconds"]]
    return {
        "falls": falls,
        "recovered_share": len(seconds) / falls if falls else None,
        "time_to_stand_s": float(np.median(seconds)) if seconds else None,
    }


def differences(rows: Sequence[Row], first: Sequence[Row]) -> dict[str, Any]:
    """By figure, what `rows` have more than those of the `first` policy, over the episodes of the same seeds that both
    have a value in: the mean, its 95 % interval (bootstrap of the pairs; None where they say nothing of it), and how
    many pairs there are."""
    others = {row["seed"]: figures(row) for row in first}
    pairs = [(figures(row), others[row["seed"]]) for row in rows if row["seed"] in others]
    found: dict[str, Any] = {}
    for name in dict.fromkeys(name for mine, _ in pairs for name in mine):
        apart = [mine[name] - other[name] for mine, other in pairs if name in mine and name in other]
        if apart:
            found[name] = {"mean": sum(apart) / len(apart), "ci95": bootstrap(apart), "pairs": len(apart)}
    return found


def table(summaries: Mapping[str, Mapping[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Head and rows for a person: a line a figure, a column a policy."""
    names = list(dict.fromkeys(name for one in summaries.values() for name in one["metrics"]))
    rows = [["episodes", *(str(one["episodes"]) for one in summaries.values())]]
    for name in RECOVERIES:
        if all(name in one for one in summaries.values()):
            shown = ["-" if one[name] is None else f"{one[name]:.4g}" for one in summaries.values()]
            rows.append([name, *shown])
    for name in (*SHARES, "mean_seconds", *names):
        rows.append([name, *(_cell(name, one) for one in summaries.values())])
    return ["figure", *summaries], rows


def difference_table(found: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Head and rows of what `differences` found."""
    return ["figure", "difference", "95 % interval", "pairs"], [
        [name, f"{one['mean']:+.3g}", _interval(one["ci95"], "+"), str(one["pairs"])] for name, one in found.items()
    ]


def _cell(name: str, summary: Mapping[str, Any]) -> str:
    if name == "success_rate":
        return f"{summary[name]:.3g} ({_interval(summary['success_ci95'])})"
    if name in SHARES:
        return f"{summary[name]:.3g}"
    mean = summary["mean_seconds"] if name == "mean_seconds" else summary["metrics"].get(name)
    if mean is None:
        return "-"
    spread = summary["sd"].get(name)
    return f"{mean:.4g}" + ("" if spread is None else f" ± {spread:.2g}")


def _interval(bounds: Sequence[float] | None, sign: str = "") -> str:
    return "-" if bounds is None else f"{bounds[0]:{sign}.3g} to {bounds[1]:{sign}.3g}"

"""Work on the machines of a Ray cluster."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from servoid.tools.common.worker_pool import Place, Processes


def add_ray_argument(parser: argparse.ArgumentParser) -> None:
    """`--ray ADDRESS`, for `workplace`."""
    parser.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="work on the machines of a Ray cluster: HOST:6379, or auto for the one that this machine is part of "
        "(docs/cluster.md)",
    )


@contextmanager
def workplace(
    address: str | None, inspect: Callable[[], Mapping[str, Any]], say: Callable[[str], None]
) -> Iterator[Place[Any]]:
    """Processes of this machine, or with an `address` those of a Ray cluster, on each of whose nodes `inspect` must
    return what it does here. Raises ConfigError."""
    if address is None:
        yield Processes()
        return
    from servoid.tools.common.cluster.ray_cluster import RayCluster

    with RayCluster(address, inspect, say) as cluster:
        yield cluster

"""Workers that are actors of a Ray cluster, one for each core of its nodes."""

from __future__ import annotations

import logging
import os
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from servoid.hw.config import ConfigError
from servoid.tools.common.worker_pool import MachineLost, attempt

_START_SECONDS = 600.0  # until the first process of a node answers: on a busy one it imports for minutes
_SHUNNED_SECONDS = 30.0  # a node that a worker was lost on gets no other: Ray needs as long to see that a node is gone
_NODE_SECONDS = 120.0  # to wait for a node where none is left
_KNOCK_SECONDS = 10.0
_POLL_SECONDS = 1.0

Inspect = Callable[[], Mapping[str, Any]]


class RayWorker:
    """An actor, which does one job after the other."""

    def __init__(self, actor: Any, node: str, cluster: RayCluster) -> None:
        self._actor, self._node, self._cluster = actor, node, cluster
        self.reference: Any = None  # of the answer

    def give(self, job: Any) -> None:
        self.reference = self._actor.attempt.remote(job)

    def answer(self) -> Any:
        import ray

        try:
            done, answer = ray.get(self.reference)
        except ray.exceptions.RayTaskError as error:  # the job or the answer cannot be sent
            raise RuntimeError(_first_line(error.cause)) from error
        except ray.exceptions.RayError as error:
            self._cluster.shun(self._node)
            raise MachineLost(f"a worker on the Ray cluster was lost: {_first_line(error)}") from error
        if not done:
            raise answer
        return answer

    def kill(self) -> None:
        import ray

        self._cluster.release(self._node)
        with suppress(ray.exceptions.RayError, ValueError):  # it is gone already
            ray.kill(self._actor, no_restart=True)


class RayCluster:
    """The nodes of a cluster on which everything is as it is here. As a context manager, it leaves the cluster.

    Nodes that come later are used, too, if they are so.
    """

    here = False

    def __init__(self, address: str, inspect: Inspect, say: Callable[[str], None]) -> None:
        """`inspect` returns, by names, what must be the same on each node: it is called here and there.

        Raises ConfigError where no cluster answers, or where something is another on a node.
        """
        self._inspect, self._say = inspect, say
        self._here = dict(inspect())
        self._processor = processor()
        _connect(address)
        self._checked: dict[str, bool] = {}  # by their IDs: whether they are as this machine is
        self._hired: Counter[str] = Counter()
        self._shunned: dict[str, float] = {}  # until when
        try:
            nodes = _alive()
            if not nodes:
                raise ConfigError(f"--ray {address}: none of its nodes is alive")
            for node in nodes:
                if (trouble := self._check(node)) is not None:
                    raise ConfigError(trouble)
                self._checked[node["NodeID"]] = True
        except BaseException:
            self._leave()
            raise
        say(f"Ray: {len(nodes)} nodes, {self.size} cores")

    def __enter__(self) -> RayCluster:
        return self

    def __exit__(self, *_: object) -> None:
        self._leave()

    def _leave(self) -> None:
        import ray

        ray.shutdown()

    @property
    def size(self) -> int:
        """Cores of the nodes that are as this machine."""
        return sum(_cores(node) for node in _alive() if self._checked.get(node["NodeID"], False))

    def hire(self, work: Callable[[Any], Any], needed: bool) -> RayWorker | None:
        """Raises RuntimeError where a worker is needed, and no node is left or comes back."""
        until = time.monotonic() + _NODE_SECONDS
        while (node := self._roomiest()) is None:
            if not needed:
                return None
            if time.monotonic() >= until:
                raise RuntimeError(
                    f"no node of the Ray cluster had a core for {_NODE_SECONDS:g} s: start others with `ray start`"
                )
            time.sleep(_POLL_SECONDS)
        self._hired[node["NodeID"]] += 1
        return RayWorker(_actor(work, node["NodeID"]), node["NodeID"], self)

    def ready(self, busy: Sequence[RayWorker], seconds: float | None) -> Sequence[RayWorker]:
        import ray

        workers = {worker.reference: worker for worker in busy}
        done, _ = ray.wait(list(workers), num_returns=1, timeout=seconds, fetch_local=False)
        return [workers[reference] for reference in done]

    def _roomiest(self) -> Mapping[str, Any] | None:
        """The node with the most cores that nothing was given to; None where all are taken."""
        now = time.monotonic()
        free = {}
        for node in _alive():
            name = node["NodeID"]
            if self._shunned.get(name, 0.0) > now:
                continue
            if name not in self._checked:  # it came later
                trouble = self._check(node)
                self._checked[name] = trouble is None
                if trouble is not None:
                    self._say(f"{trouble}; it is not used")
            if self._checked[name] and (room := _cores(node) - self._hired[name]) > 0:
                free[name] = (room, node)
        return max(free.values(), key=lambda pair: pair[0])[1] if free else None

    def release(self, node: str) -> None:
        """A worker of that node is no more."""
        self._hired[node] -= 1

    def shun(self, node: str) -> None:
        """A worker of that node was lost: hire no other there for a while."""
        self._shunned[node] = time.monotonic() + _SHUNNED_SECONDS

    def _check(self, node: Mapping[str, Any]) -> str | None:
        """What is another on a node than here; None where all is the same."""
        import ray

        where = f"node {node['NodeManagerAddress']}"
        look = ray.remote(_look).options(num_cpus=0, max_retries=0, scheduling_strategy=_on(node["NodeID"]))
        try:
            there, its_processor = ray.get(look.remote(self._inspect, str(Path.cwd())), timeout=_START_SECONDS)
        except ray.exceptions.GetTimeoutError:
            return f"{where} did not answer within {_START_SECONDS:g} s"
        except Exception as error:
            if "No module named 'servoid'" in str(error):
                return f"{where}: Servoid is not installed there"
            return f"{where}: {_first_line(error)}"
        if isinstance(there, str):
            return f"{where}: {there}"
        if names := differing(self._here, there):
            return f"{where} has others of these than this machine: {', '.join(names)}; install the same on both"
        if its_processor != self._processor:
            self._say(
                f"{where} has another processor ({its_processor}): its episodes may differ from this machine's "
                f"({self._processor}) in the last digits"
            )
        return None


def differing(here: Mapping[str, Any], there: Mapping[str, Any]) -> list[str]:
    """Names of what is not the same."""
    return [name for name in {**here, **there} if here.get(name) != there.get(name)]


def processor() -> str:
    """This machine's processor, in words."""
    import platform

    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()


class _Actor:
    """What runs on a node."""

    def __init__(self, work: Callable[[Any], Any], folder: str) -> None:
        _enter(folder)
        self._work = work

    def attempt(self, job: Any) -> tuple[bool, Any]:
        return attempt(self._work, job)


def _look(inspect: Inspect, folder: str) -> tuple[Mapping[str, Any] | str, str]:
    """What `inspect` returns on a node, or why it cannot; and the processor."""
    _enter(folder)
    try:
        return inspect(), processor()
    except ConfigError as error:
        return str(error), processor()


def _enter(folder: str) -> None:
    """Relative paths mean on a node what they mean here, where it has such a folder."""
    with suppress(OSError):
        os.chdir(folder)


def _actor(work: Callable[[Any], Any], node: str) -> Any:
    import ray

    return ray.remote(_Actor).options(num_cpus=1, scheduling_strategy=_on(node)).remote(work, str(Path.cwd()))


def _on(node: str) -> Any:
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    return NodeAffinitySchedulingStrategy(node_id=node, soft=False)


def _alive() -> list[dict[str, Any]]:
    import ray

    nodes: Any = ray.nodes  # which has no types
    return [node for node in nodes() if node["Alive"]]


def _cores(node: Mapping[str, Any]) -> int:
    return int(node["Resources"].get("CPU", 0))


def _connect(address: str) -> None:
    """Raises ConfigError."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent to anybody
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # Ray warns of what it is going to do by itself
    try:
        import ray
    except ModuleNotFoundError:
        raise ConfigError("--ray needs the 'ray' extra: pip install 'servoid[ray]'") from None
    try:
        _knock(address)
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:  # what a cluster that is not there comes to depends on the kind of address
        raise ConfigError(
            f"--ray {address}: no Ray cluster of this version answers ({_first_line(error)}): start one with "
            "`ray start --head`"
        ) from None


def _knock(address: str) -> None:
    """Raise OSError where nobody listens at HOST:PORT: Ray would try for minutes. Other kinds of address are Ray's."""
    import socket

    host, _, port = address.rpartition(":")
    if host and port.isdecimal() and "/" not in host:
        socket.create_connection((host, int(port)), timeout=_KNOCK_SECONDS).close()


def _first_line(error: object) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]

"""On a cluster of two nodes episodes are what they are on one machine, each once, though a node is killed meanwhile."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from servoid.hw.config import ConfigError
from servoid.tools import cli
from servoid.tools.commands import rollout
from servoid.tools.common.cluster import workplace
from servoid.tools.common.worker_pool import MachineLost, each

ENOUGH = 80_000_000  # bytes of a node's object store


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Two nodes of a core each."""
    pytest.importorskip("ray")
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}  # nothing else is to go before them
    from ray import cloudpickle
    from ray.cluster_utils import Cluster

    cloudpickle.register_pickle_by_value(sys.modules[__name__])  # the nodes cannot import it

    cluster = Cluster(
        initialize_head=True,
        head_node_args={"num_cpus": 1, "object_store_memory": ENOUGH, "include_dashboard": False},
    )
    cluster.add_node(num_cpus=1, object_store_memory=ENOUGH)
    cluster.wait_for_nodes()
    yield cluster
    cluster.shutdown()


@pytest.fixture(scope="module")
def place(cluster: Any) -> Iterator[Any]:
    with workplace(cluster.address, same, print) as place:
        yield place


def rolled(capfd: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    parser = argparse.ArgumentParser()
    rollout.add_arguments(parser)
    given = ["walk", "--policy", "gait", "--seconds", "1", "--episodes", "4", "--randomise", "--seed", "3", "--json"]
    assert rollout.main(parser.parse_args([*given, *words])) == 0
    result = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert result.pop("wall_seconds") > 0
    return result


def same() -> dict[str, str]:
    return {"code": "a"}


def of_this_process() -> dict[str, str]:
    return {"code": "a", "checkpoint expert": os.environ.get("SERVOID_TEST_CHECKPOINT", "old")}


def of_a_file(path: Path) -> dict[str, str]:
    if os.environ.get("SERVOID_TEST_CHECKPOINT") is None:
        raise ConfigError(f"{path}: no such file")
    return {}


def wait_a_bit(job: int) -> int:
    time.sleep(0.3)
    return job


def refuse(job: int) -> int:
    raise ConfigError(f"job {job}")


@pytest.mark.slow
def test_two_nodes_give_what_one_machine_gives(cluster: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    alone = rolled(capfd, "--workers", "1", "--out", str(tmp_path / "alone"))
    many = rolled(capfd, "--ray", cluster.address, "--out", str(tmp_path / "many"))
    assert {**alone, "out": None} == {**many, "out": None}

    def kept(name: str) -> list[str]:
        head, *episodes = (tmp_path / name / "gait.jsonl").read_text().splitlines()
        return [head, *sorted(episodes)]

    assert kept("alone") == kept("many")  # to the last bit


@pytest.mark.slow
def test_a_dataset_is_the_same_wherever_its_parts_are_recorded(cluster: Any, tmp_path: Path) -> None:
    words = "collect --policy gait --plain-odometry --worlds 4 --frames 600 --seconds 4 --parts 2 --threads 1 --out"
    assert cli.main([*words.split(), str(tmp_path / "alone")]) == 0
    assert cli.main([*words.split(), str(tmp_path / "many"), "--ray", cluster.address]) == 0
    for path in sorted((tmp_path / "alone").rglob("*.parquet")):
        assert (tmp_path / "many" / path.relative_to(tmp_path / "alone")).read_bytes() == path.read_bytes()


@pytest.mark.slow
def test_a_node_that_differs_is_refused_in_one_line(cluster: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SERVOID_TEST_CHECKPOINT", "new")  # here, and not on the nodes
    with (
        pytest.raises(ConfigError, match=r"node \S+ has others of these than this machine: checkpoint expert; inst"),
        workplace(cluster.address, of_this_process, print),
    ):
        pass
    with (
        pytest.raises(ConfigError, match=r"node \S+: \S+: no such file"),
        workplace(cluster.address, lambda: of_a_file(Path("best.safetensors")), print),
    ):
        pass


@pytest.mark.slow
def test_without_a_cluster_one_line_says_so() -> None:
    pytest.importorskip("ray")
    with (
        pytest.raises(ConfigError, match=r"--ray 127\.0\.0\.1:1: no Ray cluster"),
        workplace("127.0.0.1:1", same, print),
    ):
        pass


@pytest.mark.slow
def test_an_error_on_a_node_comes_back(place: Any) -> None:
    with pytest.raises(ConfigError, match="job 7"):
        list(each(refuse, [7], 1, place=place))


@pytest.mark.slow
def test_a_node_that_dies_loses_no_job_and_repeats_none(cluster: Any, place: Any) -> None:
    assert place.size == 2
    answers = []
    for answer in each(wait_a_bit, range(10), 2, place=place):
        answers.append(answer)
        if len(answers) == 3:  # another job is under way
            (worker,) = cluster.worker_nodes
            cluster.remove_node(worker, allow_graceful=False)
    assert sorted(answers) == list(range(10))


class Fragile:
    """Workers whose machines are lost with the jobs that `fails` names, so often."""

    here = False
    size = 2

    def __init__(self, fails: dict[int, int]) -> None:
        self.fails = fails
        self.hired = 0

    def hire(self, work: Any, needed: bool) -> Any:
        self.hired += 1

        def answer() -> int:
            job = worker.job
            if self.fails.get(job, 0):
                self.fails[job] -= 1
                raise MachineLost("gone")
            return job

        worker = Held(answer=answer, kill=lambda: None)
        worker.give = lambda job: setattr(worker, "job", job)
        return worker

    def ready(self, busy: Any, seconds: float | None) -> Any:
        return busy[:1]


class Held(SimpleNamespace):
    __hash__ = object.__hash__
    __eq__ = object.__eq__


def test_a_job_is_given_to_three_workers_at_most() -> None:
    """One that kills every machine it comes to must not go on for ever."""
    place = Fragile({1: 2})
    assert sorted(each(abs, range(4), 2, place=place)) == [0, 1, 2, 3]
    assert place.hired == 4
    with pytest.raises(MachineLost):
        list(each(abs, range(4), 2, place=Fragile({1: 3})))

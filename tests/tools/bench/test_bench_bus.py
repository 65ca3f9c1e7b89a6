"""`servoid bench bus`: a small run of the real thing, and that a cycle which did not do its work counts as failed."""

from __future__ import annotations

import json

import numpy as np
import pytest

from servoid.tools.bench.bus import SERVOS, ClientTimes, wire_ms
from servoid.tools.bench.responder import CURRENT, VELOCITY
from servoid.tools.cli import main


@pytest.mark.slow
def test_it_times_both_clients_beside_the_wire(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "bus", "--cycles", "10", "--baud", "2000000", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    rows = {(row["client"], row["mode"]): row for row in result["rows"]}
    assert set(rows) == {(client, mode) for client in ("servoid", "sdk", "wire") for mode in ("sync", "fast")}
    for row in rows.values():
        assert set(row) == {
            "client", "mode", "baud", "median_ms", "p99_ms", "cpu_us", "failed", "ratio_to_wire"
        }  # fmt: skip
        assert row["ratio_to_wire"] >= 1.0, "nothing is quicker than the wire"
        assert row["p99_ms"] >= row["median_ms"]
    assert rows["servoid", "fast"]["failed"] < 10
    assert rows["servoid", "fast"]["cpu_us"] < rows["sdk", "fast"]["cpu_us"]


def test_the_wire_takes_what_its_bytes_take() -> None:
    """568 and 436 bytes for the servos, and 45 for the board."""
    assert wire_ms("sync", 1_000_000) == pytest.approx(6.13)
    assert wire_ms("fast", 4_000_000) == pytest.approx(1.2025)


@pytest.mark.parametrize("fault", [None, "nothing", "old", "foreign"])
def test_a_cycle_with_wrong_values_is_a_failed_one(fault: str | None) -> None:
    class Client:
        def cycle(self, goals: list[int]) -> np.ndarray | None:
            values = np.array([[CURRENT] * SERVOS, [VELOCITY] * SERVOS, goals])
            values[2, 5] -= fault == "old"
            values[1, 3] += fault == "foreign"
            return None if fault == "nothing" else values

        def close(self) -> None: ...

    run = ClientTimes()
    run.batch(Client(), 3)
    assert run.failed == (3 if fault else 0)
    assert len(run.wall) == 3


def test_another_baud_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "bus", "--baud", "57600"]) == 2
    assert "--baud 57600" in capsys.readouterr().err

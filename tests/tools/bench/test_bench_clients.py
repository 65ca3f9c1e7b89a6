"""`servoid bench clients`: each verb of other people's clients on the rig; a rig that is wrong does not pass."""

from __future__ import annotations

import json

import pytest

from servoid.hw.robot.description import load_robot
from servoid.tools.bench.client_verbs import CLIENTS, Verb
from servoid.tools.bench.sdk_host import Refused, SdkHost
from servoid.tools.cli import main

VERBS = [(client, verb) for client, verbs in CLIENTS.items() for verb in verbs]


@pytest.mark.parametrize(("client", "verb"), VERBS, ids=[f"{client}: {verb[0]}" for client, verb in VERBS])
def test_a_client_finds_what_it_would_find_on_a_robot(client: str, verb: tuple[str, object, Verb]) -> None:
    _, factory_state, act = verb
    act(SdkHost(load_robot(), factory_state))  # type: ignore[arg-type]


@pytest.mark.parametrize("verb", [verb for verb in CLIENTS["sdk examples"] if verb[0] in ("ping", "fast sync read")])
def test_a_servo_that_is_missing_is_seen(verb: tuple[str, object, Verb]) -> None:
    host = SdkHost(load_robot(), verb[1])  # type: ignore[arg-type]
    host.rig.servos[4].dead = True
    with pytest.raises(Refused, match=r"no status packet|Incorrect status packet"):
        verb[2](host)


def test_the_command_lists_every_verb_with_its_result(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "clients", "--client", "robel", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["verbs"], result["failed"]) == (len(CLIENTS["robel"]), 0)
    assert [row["client"] for row in result["rows"]] == ["robel"]
    assert main(["bench", "clients", "--client", "robl"]) == 2
    assert "did you mean 'robel'" in capsys.readouterr().err

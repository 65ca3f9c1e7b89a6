"""What happened in a run that a person should know of."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Event:
    """One event. `kind` is a short word that programs may test; `text` says what happened and what to do.

    Kinds: `phase` (the guard changed its state), `rejected` (a non-finite target), `fall`, `stale`, `button` (the stop
    button), `servo` (a hardware error), `temperature`, `voltage`, `overload` (a blocked joint), `derated` (gains went
    down), `homing`, `recovery` (a try to get up), `policy`, `plan`, `record`, `interrupt`, `task`, `system`.
    """

    tick: int
    time: float  # s since the run began
    kind: str
    joint: str | None
    text: str

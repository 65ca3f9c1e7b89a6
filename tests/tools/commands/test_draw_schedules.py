from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servoid.policy.diffusion.settings import SCHEDULES
from servoid.tools.commands.draw_schedules import NETWORK, PICTURES, draw, matrix

DOCS = Path(__file__).resolve().parents[3] / "docs"


def test_the_documentation_shows_a_picture_of_every_schedule() -> None:
    text = (DOCS / "diffusion.md").read_text()
    assert {settings.schedule for settings in PICTURES.values()} == set(SCHEDULES)
    for name in PICTURES:
        assert f"(schedules/{name}.png)" in text
        assert (DOCS / "schedules" / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_show_what_is_known_as_clean_and_end_clean(name: str) -> None:
    drawn = matrix(name)
    assert not drawn.states[:, NETWORK.state_ticks <= 0].any()
    assert not drawn.actions[:, NETWORK.action_ticks < 1].any()
    assert drawn.states[0, -1] == NETWORK.levels
    assert not drawn.states[-1].any()
    assert not drawn.actions[-1].any()
    assert (np.diff(drawn.states, axis=0) <= 0).all()


@pytest.mark.slow
def test_a_picture_is_drawn(tmp_path: Path) -> None:
    draw("rolling", tmp_path / "deep" / "rolling.png")
    assert (tmp_path / "deep" / "rolling.png").read_bytes().startswith(b"\x89PNG")

"""Pictures of clips: `servoid motions film`, in a process of its own: MuJoCo chooses how to draw when imported."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from drawing import draws

from servoid.tools.cli import main

CODE = "import sys; from servoid.tools.cli import main; sys.exit(main(sys.argv[1:]))"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["png", "gif", "mp4"])
def test_a_clip_is_shown_from_two_sides(tmp_path: Path, kind: str) -> None:
    image, av = pytest.importorskip("PIL.Image"), pytest.importorskip("av")
    if not draws("egl"):
        pytest.skip("MuJoCo itself cannot draw with egl on this machine")
    found = str(Path(__file__).parents[3] / "src")
    told = ("motions", "film", "nod", "--kind", kind, "--as-written", "--out", str(tmp_path))
    environment = os.environ | {"MUJOCO_GL": "egl", "PYTHONPATH": found}
    done = subprocess.run([sys.executable, "-c", CODE, *told], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    path = tmp_path / f"nod.{kind}"
    if kind == "png":
        with image.open(path) as picture:
            assert picture.size == (8 * 160, 2 * 256)
            assert len(picture.convert("RGB").getcolors(1 << 20)) > 20  # something was drawn
        return
    with av.open(str(path)) as film:
        stream = film.streams.video[0]
        frames = sum(1 for _ in film.decode(stream))
        assert (stream.width, stream.height) == (512, 256)
        assert 25 <= frames <= 43  # of 1.7 s; a GIF keeps one of those that are alike


def test_where_pictures_cannot_go_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert main(["motions", "film", "nod", "--out", str(tmp_path / "file")]) == 2
    assert "cannot be created" in capsys.readouterr().err

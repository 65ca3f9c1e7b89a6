"""Pictures of clips: strips of frames from two sides (PNG), and films (MP4, GIF)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import Clip

if TYPE_CHECKING:  # MuJoCo chooses how to draw when it is imported: not before it is known
    from servoid.sim.marks import Frame

SIDES = (150.0, 90.0)  # degrees: from its right and front, and from its right side
FPS = 25
COLUMNS = 8  # pictures of a strip from each side
SIZE = (256, 256)  # pixels of a picture
_CUT = 48  # pixels of its left and right that a strip leaves out


def frames(clip: Clip, robot: Robot, *, in_physics: bool) -> list[Frame]:
    """A clip's ticks: as written, or as a robot moves that is told its goals and nothing else."""
    from servoid.sim.marks import Frame
    from servoid.tools.motions.physics import play
    from servoid.tools.motions.standing import Standing

    if in_physics:
        played = play(clip.joints, robot, begins=clip.about.begins)
        rows = played.place[0], played.orientation[0], played.joints[0]
    else:
        rows = clip.root_position, clip.root_orientation, Standing(robot).held(clip)
    return [Frame(place, turn, joints) for place, turn, joints in zip(*rows, strict=True)]


def film(clip: Clip, robot: Robot, path: Path, *, in_physics: bool) -> None:
    """Write a film (.mp4, .gif) or a strip (.png). Raises RenderError where nothing can be drawn."""
    shown = frames(clip, robot, in_physics=in_physics)
    if path.suffix == ".png":
        at = np.linspace(0, len(shown) - 1, COLUMNS).round().astype(int)
        write_picture(path, strip([shown[i] for i in at], robot))
        return
    step = max(round(robot.rate / FPS), 1)
    sides = [_drawn(shown[::step], robot, azimuth) for azimuth in SIDES]
    _write_film(path, [np.concatenate(pair, 1) for pair in zip(*sides, strict=True)])


def strip(shown: list[Frame], robot: Robot) -> Array:
    """Frames side by side, a row from each side: `(height, width, 3)` uint8."""
    rows = [np.concatenate([p[:, _CUT:-_CUT] for p in _drawn(shown, robot, azimuth)], 1) for azimuth in SIDES]
    return np.concatenate(rows, 0)


def _drawn(shown: list[Frame], robot: Robot, azimuth: float) -> list[Array]:
    from servoid.sim.render import render

    return [picture.copy() for picture in render(robot, shown, *SIZE, shadows=False, azimuth=azimuth)]


def write_picture(path: Path, picture: Array) -> None:
    """Write `(height, width, 3)` uint8 as a small PNG. Raises OSError."""
    from PIL import Image

    Image.fromarray(picture).quantize(48).save(path)


def _write_film(path: Path, pictures: list[Array]) -> None:
    if path.suffix == ".gif":
        from PIL import Image

        first, *rest = [Image.fromarray(picture).quantize(64) for picture in pictures]
        first.save(path, save_all=True, append_images=rest, duration=1000 // FPS, loop=0)
        return
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"preset": "fast", "crf": "26"})
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))

"""A film of an episode as a camera of a dataset: a picture a tick, drawn from the log as `servoid plot` does."""

from __future__ import annotations

from pathlib import Path

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.tools.learn.dataset.from_log import LoggedEpisode
from servoid.tools.learn.dataset.schema import DatasetFilm
from servoid.tools.learn.dataset.statistics import of_pictures

CAMERA = "observation.images.film"
_SAMPLES = 100  # pictures of an episode that its statistics are of, and
_STRIDE = 4  # pixels of them
_OPTIONS = {"preset": "veryfast", "crf": "23", "g": "2"}  # few pictures between key frames: they are read one by one


def film(episode: LoggedEpisode, path: Path, size: tuple[int, int]) -> DatasetFilm:
    """Draw an episode, `size` being width and height, into `path`. Raises ConfigError where nothing can be drawn."""
    import av

    from servoid.hw.robot.description import load_robot
    from servoid.sim.render import RenderError, render
    from servoid.tools.common.pictures.video import shown_frames

    header = episode.log.header
    robot, frames = load_robot(header["settings"]["robot"]), shown_frames(episode.log, episode.rows)
    step, samples = max(len(frames) // _SAMPLES, 1), list[Array]()
    try:
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=robot.rate, options=_OPTIONS)
            stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
            for number, picture in enumerate(render(robot, frames, *size)):
                if number % step == 0:
                    samples.append(picture[::_STRIDE, ::_STRIDE].copy())
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            container.mux(stream.encode(None))
    except RenderError as error:
        raise ConfigError(f"--film: {error}") from error
    except OSError as error:
        raise ConfigError(f"{path}: the film cannot be written ({error})") from error
    return DatasetFilm(path, of_pictures(samples, len(samples)))

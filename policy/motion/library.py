"""A library of clips: a folder of their files."""

from __future__ import annotations

from pathlib import Path

from servoid.hw.config import ConfigError, nearest
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import SUFFIX, Clip, load, read_about, save

SHIPPED = Path(__file__).resolve().parent / "clips"


class Library:
    """The clips of one robot in a folder. Files are read when they are asked for."""

    def __init__(self, robot: Robot, folder: Path = SHIPPED) -> None:
        """Raises ConfigError where there is no such folder, or two files hold a clip of one name."""
        if not folder.is_dir():
            raise ConfigError(f"{folder}: no such folder of clips")
        self.robot, self.folder = robot, folder
        self._paths: dict[str, Path] = {}
        self._robots: dict[str, str] = {}
        for path in sorted(folder.glob(f"*{SUFFIX}")):
            name, _, head = read_about(path)
            if name in self._paths:
                raise ConfigError(f"{path}: holds a clip called '{name}', and so does {self._paths[name].name}")
            self._paths[name], self._robots[name] = path, head["robot"]

    @property
    def fitting(self) -> tuple[str, ...]:
        """Names of the clips that are of this robot."""
        return tuple(name for name, robot in self._robots.items() if robot == self.robot.name)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._paths)

    def path(self, name: str) -> Path:
        """File of the clip of that name. Raises ConfigError with the nearest name."""
        if name not in self._paths:
            raise ConfigError(f"unknown clip '{name}' in {self.folder}: {nearest(name, self._paths)}")
        return self._paths[name]

    def __getitem__(self, name: str) -> Clip:
        """Raises ConfigError for an unknown name, or a clip that does not fit the robot."""
        return load(self.path(name), self.robot)

    def add(self, clip: Clip, *, replace: bool = False) -> Path:
        """Write a clip into the folder; its path. Raises ConfigError where one of its name is there already."""
        path = self.folder / f"{clip.name}{SUFFIX}"
        if not replace and (clip.name in self._paths or path.exists()):
            raise ConfigError(f"{path}: already exists: choose another name, or --replace")
        save(clip, path, self.robot)
        self._paths[clip.name], self._robots[clip.name] = path, self.robot.name
        return path


def find(name: str, robot: Robot) -> Clip:
    """A clip by the path of its file, or by its name in the shipped library. Raises ConfigError."""
    return load(Path(name), robot) if name.endswith(SUFFIX) else Library(robot)[name]

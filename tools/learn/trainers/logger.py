"""What a training run leaves to look at: a CSV, TensorBoard scalars and a learning-curve picture."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType


class Logger:
    """Scalars of a run in its folder; a resumed run goes on in the same files."""

    def __init__(self, folder: Path, columns: Sequence[str], step: int = 0) -> None:
        """`step` is where the run goes on; rows from beyond it, logged before an interruption, are dropped."""
        from torch.utils.tensorboard import SummaryWriter

        self.path = folder / "log.csv"
        self.columns = ("step", *columns)
        rows = [row for row in self.read() if int(float(row["step"])) <= step] if step and self.path.exists() else []
        with self.path.open("w", newline="") as file:
            writer = csv.DictWriter(file, self.columns, extrasaction="ignore", restval="")
            writer.writeheader()
            writer.writerows(rows)
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1)

    def __enter__(self) -> Logger:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._board.close()

    def log(self, step: int, scalars: Mapping[str, float]) -> None:
        """Add a row; columns without a scalar stay empty. Raises KeyError for a scalar without a column."""
        for name, value in scalars.items():
            if name not in self.columns:
                raise KeyError(f"no column '{name}' in {self.path}")
            self._board.add_scalar(name, value, step)
        with self.path.open("a", newline="") as file:
            csv.DictWriter(file, self.columns, restval="").writerow(
                {"step": step, **{name: f"{value:.6g}" for name, value in scalars.items()}}
            )

    def read(self) -> list[dict[str, str]]:
        """All rows, as text."""
        with self.path.open(newline="") as file:
            return list(csv.DictReader(file))

    def plot(self, path: Path, panels: Sequence[Sequence[str]], x: str = "step") -> None:
        """Draw columns over `x`, a panel for each group of them."""
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot as plt

        rows = self.read()
        figure, axes = plt.subplots(len(panels), 1, figsize=(8, 2.6 * len(panels)), sharex=True, squeeze=False)
        for axis, names in zip(axes[:, 0], panels, strict=True):
            for name in names:
                points = [(float(row[x]), float(row[name])) for row in rows if row.get(name) and row.get(x)]
                if points:
                    axis.plot(*zip(*points, strict=True), marker="o" if len(points) < 50 else None, ms=3, label=name)
            axis.grid(alpha=0.3)
            if axis.lines:
                beside = {
                    "loc": "upper left",
                    "bbox_to_anchor": (1.0, 1.0),
                    "fontsize": 6,
                    "ncols": len(names) // 16 + 1,
                }
                axis.legend(**(beside if len(names) > 4 else {}))
        axes[-1, 0].set_xlabel(x)
        figure.savefig(path, dpi=110, bbox_inches="tight")
        plt.close(figure)

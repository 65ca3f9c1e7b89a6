"""Servos that move a simulated robot as the measured one moved: by CMA-ES, then by least squares, with spreads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot, Servo
from servoid.tools.identify.excitation import HELD_OUT
from servoid.tools.identify.figures import MODELS, Figures, ServoFigure
from servoid.tools.identify.recording import Piece
from servoid.tools.identify.rehearsal import Candidate, Rehearsal

DETERMINED = 0.1  # of a figure: with a larger spread, the data do not determine it
_NOISE = 0.002  # rad: of an encoder's tick and of what no model has
_ALIKE = 10  # ticks in a row whose errors are as good as one
_CANDIDATES, _GENERATIONS = 10, 6
_ITERATIONS, _STEP = 20, 0.015  # of least squares; of a figure's spread, for the slopes
_SETTLED = 1e-3  # of the cost, that an iteration gains at the end
_DAMPING = (0.0, 0.01, 0.1, 1.0, 10.0)  # tried at each iteration
_GROWS = ("stribeck_friction", "load_friction")  # of models with more figures
_FAINTER = (0.0, -1.5, -3.0)  # spreads from the file's, at which they are tried first
_FARTHEST = 4.0  # spreads that a figure may be from its file's
_BETTER = 0.98  # of the held-out error, that a model with more figures must come below
_BLOCK = 1.0  # s of one joint in one motion: errors in it belong together

Say = Callable[[str], None]


@dataclass(frozen=True)
class Estimate:
    """A figure, how far it may be off (a share of it), and whether the data determine it."""

    figure: ServoFigure
    value: float
    spread: float

    @property
    def determined(self) -> bool:
        return self.spread <= DETERMINED


@dataclass(frozen=True)
class Fit:
    """What a model of friction makes of the recordings. Errors are RMS over joints that moved [rad]. `found` is worked
    out for the model that is taken."""

    model: str
    figures: Figures
    point: Array
    error: float  # on the motions that it was fitted on
    held_out: float  # on the others
    found: tuple[Estimate, ...] = ()

    @property
    def servos(self) -> dict[str, Servo]:
        """Each servo as it was found, by the name of the one that it was taken for."""
        return self.figures.identified(self.point)


def identify(
    robot: Robot, pieces: Sequence[Piece], say: Say, models: Sequence[str] = tuple(MODELS)
) -> tuple[Fit, list[Fit]]:
    """The best model, by the error on motions that none was fitted on, and all that were tried.

    Raises ConfigError where nothing moved, or where only motions are there that nothing is fitted on.
    """
    moved = moving_joints(robot, pieces)
    if not moved or all(piece.name == HELD_OUT for piece in pieces):
        raise ConfigError("the recording has no motion to fit: record again with servoid identify")
    fits: list[Fit] = []
    best: tuple[Fit, _Trial] | None = None
    for model in models:
        trial = _Trial(Figures(robot, moved, model), pieces, moved)
        fits.append(trial.fit(fits))
        last = fits[-1]
        say(f"friction {model}: off by {np.degrees(last.error):.3f} degrees, {np.degrees(last.held_out):.3f} held out")
        if best is None or last.held_out < _BETTER * best[0].held_out:
            best = last, trial
    assert best is not None
    fit, trial = best
    return replace(fit, found=trial.estimates()), fits


def moving_joints(robot: Robot, pieces: Sequence[Piece]) -> list[str]:
    """Joints that were told to move in any of the pieces."""
    way = np.max([np.ptp(piece.goal, axis=0) for piece in pieces], axis=0)
    return [name for name, far in zip(robot.names, way, strict=True) if far > 0.01]


class _Trial:
    """A model of friction against the recordings."""

    def __init__(self, figures: Figures, pieces: Sequence[Piece], moved: Sequence[str]) -> None:
        self.figures, self._n = figures, len(figures.all)
        self._joints = np.array([figures.robot.names.index(name) for name in moved])
        self._fitted = [piece for piece in pieces if piece.name != HELD_OUT]
        self._others = [piece for piece in pieces if piece.name == HELD_OUT] or self._fitted
        self._rehearsal = Rehearsal(figures.robot, self._fitted)
        self._scout = Rehearsal(figures.robot, self._fitted[::2])  # enough to tell a basin

    def fit(self, before: Sequence[Fit]) -> Fit:
        """From what simpler models found, or where there are none by CMA-ES from the files."""
        self._polish(self._nearest(before) if before else self._search())
        others = _errors(Rehearsal(self.figures.robot, self._others), self._candidates([self._point]), self._joints)
        return Fit(self.figures.model, self.figures, self._point, _rms(self._off), _rms(others[0]))

    def _candidates(self, points: Sequence[Array]) -> list[Candidate]:
        return [Candidate(*self.figures.of_joints(point)) for point in points]

    def _residuals(self, points: Sequence[Array]) -> list[Array]:
        return _errors(self._rehearsal, self._candidates(points), self._joints)

    def _cost(self, error: Array, point: Array) -> float:
        return float(np.square(error / _NOISE).sum() / _ALIKE + np.square(point).sum())

    def _nearest(self, before: Sequence[Fit]) -> Array:
        """The best of the points that others found, with the figures that they lack as in the files, or fainter."""
        points = []
        for fit in before:
            values = fit.figures.values(fit.point)
            point = self.figures.point(values)
            new = [i for i, f in enumerate(self.figures.all) if (f.servo, f.name) not in values and f.name in _GROWS]
            for faint in _FAINTER if new else _FAINTER[:1]:
                points.append(point.copy())
                points[-1][new] = faint
        costs = [self._cost(error, point) for error, point in zip(self._residuals(points), points, strict=True)]
        return points[int(np.argmin(costs))]

    def _search(self) -> Array:
        import cma

        options = {"popsize": _CANDIDATES, "seed": 1, "verbose": -9, "bounds": [-_FARTHEST, _FARTHEST]}
        search = cma.CMAEvolutionStrategy(np.zeros(self._n), 0.7, options)
        for _ in range(_GENERATIONS):
            points = search.ask()
            errors = _errors(self._scout, self._candidates(points), self._joints)
            search.tell(points, [self._cost(e, p) for e, p in zip(errors, points, strict=True)])
        best: Array = np.asarray(search.result.xbest)
        return best

    def _polish(self, point: Array) -> None:
        """Levenberg and Marquardt's least squares. Slopes are measured where the last ones, made to fit the newest step
        (Broyden, 1965), lead no further: it ends where slopes that were just measured gain nothing."""
        errors = self._residuals([point])[0]
        cost, scale = self._cost(errors, point), 1.0 / (_NOISE * np.sqrt(_ALIKE))
        slopes, fresh = self._slopes(point, errors), True
        for _ in range(_ITERATIONS):
            hessian = scale**2 * slopes.T @ slopes + np.eye(self._n)
            downhill = scale**2 * slopes.T @ errors + point
            steps = [np.linalg.solve(hessian + d * np.diag(np.diag(hessian)), downhill) for d in _DAMPING]
            points = [np.clip(point - step, -_FARTHEST, _FARTHEST) for step in steps]
            trials = self._residuals(points)
            costs = [self._cost(e, p) for e, p in zip(trials, points, strict=True)]
            leader = int(np.argmin(costs))
            gained, moved = cost - costs[leader], points[leader] - point
            settled = gained < _SETTLED * cost
            if gained > 0:
                slopes = slopes + np.outer(trials[leader] - errors - slopes @ moved, moved / (moved @ moved))
                point, errors, cost = points[leader], trials[leader], costs[leader]
            if settled and fresh:
                break
            fresh = settled
            if fresh:
                slopes = self._slopes(point, errors)
        self._point, self._off, self._slope = point, errors, slopes

    def _slopes(self, point: Array, errors: Array) -> Array:
        """Change of each error with each figure `(samples, n)`."""
        moved = self._residuals([point + _STEP * step for step in np.eye(self._n)])
        return np.stack([(error - errors) / _STEP for error in moved], -1)

    def estimates(self) -> tuple[Estimate, ...]:
        """The figures of the last fit, and how far each may be off: by the curvature of the fit and by what single
        seconds of single joints say: H^-1 (sum g g' + P) H^-1, g being the slope of the cost in a block and P what was
        known before."""
        point, slopes, errors = self._point, self._slope, self._off
        weight = 1.0 / (_NOISE**2 * _ALIKE)
        inverse = np.linalg.inv(weight * slopes.T @ slopes + np.eye(self._n))
        pulls = weight * slopes * errors[:, None]
        block = round(_BLOCK * self.figures.robot.rate)
        parts: list[Array] = []
        begin = 0
        for piece in self._fitted:
            rows = len(piece.goal) * len(self._joints)
            by_tick = pulls[begin : begin + rows].reshape(len(piece.goal), len(self._joints), -1)
            parts += [by_tick[i : i + block].sum(0) for i in range(0, len(by_tick), block)]
            begin += rows
        blocks = np.concatenate(parts)
        deviation = np.sqrt(np.diag(inverse @ (blocks.T @ blocks + np.eye(self._n)) @ inverse))
        values = self.figures.values(point)
        return tuple(
            Estimate(f, values[f.servo, f.name], f.relative(float(d), values[f.servo, f.name]))
            for f, d in zip(self.figures.all, deviation, strict=True)
        )


def _errors(rehearsal: Rehearsal, candidates: Sequence[Candidate], joints: Array) -> list[Array]:
    """Simulated less measured angles, piece by piece, of each candidate `(samples,)` rad; 0 where none was read."""
    angles = rehearsal.angles(candidates)
    parts = [
        np.nan_to_num((went - piece.measured)[:, :, joints]).reshape(len(candidates), -1)
        for went, piece in zip(angles, rehearsal.pieces, strict=True)
    ]
    return list(np.concatenate(parts, 1))


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.square(errors).mean()))

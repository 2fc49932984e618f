"""How a drop goes on that was measured at its beginning alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares

from sbi_active.criticism import Trials
from sbi_active.criticism.results import SCATTER, UNEXPLAINED, ModelKey
from sbi_active.criticism.rivals.error_models import declared_noise
from sbi_active.criticism.rivals.residual_process import ResidualProcess
from sbi_active.criticism.rivals.rival_set import RivalSet
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from sbi_active.tasks.ball_drops.data import Drop  # pyright: ignore
from sbi_active.tasks.ball_drops.model import GRAVITY  # pyright: ignore

Array = NDArray[Any]

NUM_DRAWS = 200


@dataclass(frozen=True)
class Forecast:
    """What a rival expects of the rest of one trial.

    Attributes:
        times: In s, shape (m,).
        x: As measured, shape (m,).
        mean: Mean of the noise-free predictions, shape (m,).
        low: 5 % quantile, errors included, shape (m,).
        high: 95 % quantile, shape (m,).
    """

    times: Array
    x: Array
    mean: Array
    low: Array
    high: Array

    @property
    def rmse(self) -> float:
        """Of the mean."""
        return float(np.sqrt(np.mean((self.mean - self.x) ** 2)))

    @property
    def coverage(self) -> float:
        """Share of the samples in the central 90 %."""
        return float(((self.x >= self.low) & (self.x <= self.high)).mean())


def forecast(
    rivals: RivalSet,
    whole: Trials,
    *,
    probabilities: Mapping[str, float],
    trial: int,
) -> Forecast:
    """Return the rest of a trial given its beginning and the other trials.

    Unlike a new trial, it keeps the nuisances that its beginning shows, and its errors
    go on from the last one. It is the average of the models, since what a verdict
    leaves open is a part of what is not known.

    Args:
        rivals: The models, fitted to trials of which this one was cut short.
        whole: The same trials, this one in full.
        probabilities: By names of the effects joined by " + ", or a catch-all.
        trial: Position of the one that was cut.
    """
    rng = np.random.default_rng(0)
    names, p = [*probabilities], np.array([*probabilities.values()])
    counts = np.round(NUM_DRAWS * p / p.sum()).astype(int)
    parts = [
        _drawn(rivals, whole, _key(rivals, name), trial, num, rng)
        for name, num in zip(names, counts, strict=True)
        if num
    ]
    mean, x = (np.concatenate(part) for part in zip(*parts, strict=True))
    m = TrialSimulator(rivals.simulator.model, whole).measurements
    rest = _rest(rivals, m, trial)[1:]
    low, high = np.quantile(x, [0.05, 0.95], axis=0)
    return Forecast(m.time[rest], m.x[rest], mean.mean(0), low, high)


def _rest(rivals: RivalSet, m: Any, trial: int) -> NDArray[np.int64]:
    """Return places of the last sample of the beginning, and of all that follow it."""
    first = int((rivals.measurements.trial == trial).sum())
    return np.flatnonzero(m.trial == trial)[first - 1 :]


def _drawn(
    rivals: RivalSet,
    whole: Trials,
    key: ModelKey,
    trial: int,
    num: int,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Return noise-free predictions of one model, and outcomes, both (num, m)."""
    fit = rivals.fit(key)
    rival, u = fit.rival, fit.sample.draws(num, rng)
    simulator = TrialSimulator(rivals.simulator.model, whole)
    mean = simulator.predict(*rival.coordinates.split(u))[0]
    m = simulator.measurements
    own = rival.residual(u, penalized=False)[0]
    extra = np.zeros(len(m))
    if isinstance(rival.error, ResidualProcess):
        shift, extra = rival.error.condition(
            own, m, rivals.scaled_actions(whole), order=rivals.scaled_order(whole)
        )
        mean = mean + shift
    cells, sizes = rival.error.noise_posterior(own, rng)
    noise = declared_noise(rivals.model.noise, m)
    last, *rest = _rest(rivals, m, trial)
    rho = np.stack([noise.cells[c].rho for c in cells])
    sd = np.stack([noise.cells[c].sd for c in cells]) * sizes[:, None]
    r = m.x[last] - mean[:, last]
    x = np.empty((num, len(rest)))
    for j, k in enumerate(rest):
        fresh = sd[:, k] * np.sqrt(1 - rho[:, k] ** 2)
        r = rho[:, k] * r + fresh * rng.normal(size=num)
        x[:, j] = mean[:, k] + r
    return mean[:, rest], x + extra[rest] * rng.normal(size=x.shape)


def aligned_error(
    rivals: RivalSet, whole: Trials, *, verdict: str, trial: int
) -> float:
    """Return the RMSE of a whole trial with its nuisances fitted by least squares.

    Parameters and strengths are posterior means.

    Args:
        rivals: As in :func:`forecast`.
        whole: The trials in full.
        verdict: As there; a catch-all adds nothing.
        trial: Position of the trial.
    """
    fit = rivals.fit(ModelKey(_key(rivals, verdict).effects))
    rival, draws = fit.rival, fit.sample.draws(NUM_DRAWS, np.random.default_rng(0))
    theta, phi = rival.coordinates.split(draws)
    start = [phi[e.name][:, trial].mean(0).numpy() for e in rivals.nuisances]
    sizes = np.cumsum([len(part) for part in start])[:-1]
    mean = {e.name: phi[e.name].mean(0, keepdim=True) for e in rival.effects}
    one = TrialSimulator(rivals.simulator.model, whole.select([trial]))

    def residual(z: Array) -> Array:
        own = {
            e.name: torch.from_numpy(part)[None, None]
            for e, part in zip(rivals.nuisances, np.split(z, sizes), strict=True)
        }
        predicted = one.predict(theta.mean(0, keepdim=True), {**mean, **own})[0]
        return predicted[0] - one.measurements.x

    return float(
        np.sqrt(np.mean(least_squares(residual, np.concatenate(start)).fun ** 2))
    )


def _key(rivals: RivalSet, verdict: str) -> ModelKey:
    """Return the model that a verdict names."""
    if verdict in (UNEXPLAINED, SCATTER):
        return ModelKey(error=verdict)
    return ModelKey(tuple(n for n in verdict.split(" + ") if n in rivals.effects))


#: Bounds of (h0, t0, strength), and starts of t0 and the strength.
STRENGTHS = {
    "gravity alone": (),
    "free gravity": (6.0, 9.0),
    "linear drag": (0.05, 0.3),
    "quadratic drag": (0.003, 0.02),
}
KINDS = (*STRENGTHS,)
STARTS = (-0.3, 0.0, 0.3)  # s
LOW, HIGH = (-np.inf, -2.0, 1e-6), (np.inf, 1.0, 20.0)


def second_drop_error(fitted: Drop, tested: Drop, kind: str) -> float:
    """Return the RMSE of a drop that only lends its release to the model.

    The strength comes from the other drop, the release height and time from this one.

    Args:
        fitted: Drop that the strength is fitted to.
        tested: Drop that is predicted.
        kind: One of ``KINDS``.
    """
    strength = _fit(fitted, kind)[2:]
    h0, t0 = _fit(tested, kind, strength=strength)[:2]
    return _rms(_height(kind, tested.times, h0, t0, strength) - tested.heights)


def forecast_error(fitted: Drop, tested: Drop, kind: str, *, until: float) -> float:
    """Return the RMSE of the rest of a drop, its release fitted to the beginning.

    Args:
        fitted: Drop that the strength is fitted to.
        tested: Drop that is predicted.
        kind: One of ``KINDS``.
        until: End of the beginning, s.
    """
    strength = _fit(fitted, kind)[2:]
    early = tested.times <= until
    h0, t0 = _fit(tested, kind, strength=strength, among=early)[:2]
    error = _height(kind, tested.times, h0, t0, strength) - tested.heights
    return _rms(error[~early])


def _fit(
    drop: Drop, kind: str, *, strength: Array | None = None, among: Any = slice(None)
) -> Array:
    """Return (h0, t0) or (h0, t0, strength) of the smallest sum of squares."""
    times, heights = drop.times[among], drop.heights[among]
    free = strength is None and bool(STRENGTHS[kind])

    def residual(z: Array) -> Array:
        own = z[2:] if free or strength is None else strength
        return _height(kind, times, z[0], z[1], own) - heights

    num = 3 if free else 2
    fits = [
        least_squares(
            residual, [heights[0], t0, c][:num], bounds=(LOW[:num], HIGH[:num])
        )
        for t0 in STARTS
        for c in (STRENGTHS[kind] if free else (0.0,))
    ]
    return min(fits, key=lambda fit: fit.cost).x


def _height(kind: str, times: Array, h0: float, t0: float, strength: Array) -> Array:
    s = np.maximum(times - t0, 0.0)
    ways: dict[str, Callable[[], Array]] = {
        "gravity alone": lambda: 0.5 * GRAVITY * s**2,
        "free gravity": lambda: 0.5 * strength[0] * s**2,
        "linear drag": lambda: (
            GRAVITY / strength[0] * (s + np.expm1(-strength[0] * s) / strength[0])
        ),
        "quadratic drag": lambda: (
            np.log(np.cosh(np.sqrt(GRAVITY * strength[0]) * s)) / strength[0]
        ),
    }
    return h0 - ways[kind]()


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2)))

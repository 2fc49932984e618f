"""Results if every model misses by more than the sensor's error."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sbi_active.arrays import Array

#: What is neither named nor declared.
UNDECLARED = "something undeclared"


@dataclass(frozen=True, kw_only=True)
class Support:
    """What speaks for an effect that helps, where every model misses.

    None of it needs calibration, or depends on how fine the sensor is declared.

    Attributes:
        inclusion: Probability that it, or what no permitted action tells from it, is
            there, beside a residual process of unknown size.
        better: Probability that a new trial is predicted better with it.
        gained: Nats that the model gains by it, beside that process.
        remains: Share of the excess error that it leaves: the excess of the fit's mean
            squared residual over the sensor's, with it, over that without it or of the
            bare model, whichever ratio is larger.
        guessed: Nats that elementary formulas in its place gain over it; -inf where
            none were asked, as along trajectories.
    """

    inclusion: float
    better: float
    gained: float
    remains: float
    guessed: float = -np.inf


@dataclass(frozen=True, kw_only=True)
class ModelError:
    """A model that was admitted, and its error on trials that it was not fitted to.

    Attributes:
        name: Effects joined by " + ", or "none".
        probability: Probability among the admitted models; 0 for one that was not
            admitted.
        left_out: Root mean square on left-out trials by channel, units of x, (c,).
        held_out: Root mean square on held-out trials, likewise; None without any.
        remains: Share of the bare model's excess error on left-out trials.
        parts: Mean squared error of each left-out trial, or part of one, in sensor
            variances, (f,); empty if not requested.
    """

    name: str
    probability: float
    left_out: Array
    held_out: Array | None
    remains: float
    parts: tuple[float, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Misfit:
    """Why the verdict is what it is where no model is right.

    Attributes:
        models: Admitted ones, most probable first; the bare model and that of the
            verdict are always there.
        helps: Effects with which a new trial is predicted better, of the verdict.
        named: Those of them that are probably the cause (:meth:`.Rule.is_cause`).
        support: What speaks for each that helps.
        open_forms: Family of each effect that is named as the nearest form of several,
            of which another may be the cause.
        sensor: Standard deviation of the sensor by channel, units of x, (c,).
        passes: Whether the chi-square of the verdict passes against the sensor.
        size: Size of the residual process beside the verdict's model, in sensor
            deviations.
        time_scale: Time scale of that process, in the unit of the sample times; NaN
            where x has no time axis, and each number an error of its own.
        left_out: Units that were left out: "trials" or "parts of trials".
        weights: Weights of models by their errors on left-out parts, where
            probabilities are too sure; by name, largest first, without those that
            hardly count. A next action is to tell these apart.
        instead: Effects that may stand in the place of an effect that helps: left-out
            trials are not surely predicted worse with it there.
    """

    models: tuple[ModelError, ...]
    helps: tuple[str, ...]
    named: tuple[str, ...]
    support: dict[str, Support]
    sensor: Array
    passes: bool
    size: float
    time_scale: float
    left_out: str = "trials"
    weights: dict[str, float] = field(default_factory=dict)
    instead: dict[str, tuple[str, ...]] = field(default_factory=dict)
    open_forms: dict[str, str] = field(default_factory=dict)

    def of(self, name: str) -> ModelError:
        """Return the errors of a model by its name."""
        return next(m for m in self.models if m.name == name)

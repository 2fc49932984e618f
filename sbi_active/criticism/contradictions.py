"""What speaks for and against a verdict: trials, bounds of the prior, actions.

Where every model misses by more than the sensor's error, :class:`Misfit` has it all.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sbi_active.arrays import Array


@dataclass(frozen=True, kw_only=True)
class MissedTrial:
    """A held-out trial far outside what the model of a verdict predicts.

    Attributes:
        position: Place among the held-out trials.
        name: Name of the trial in reports.
        size: Root mean square error in sensor deviations, or those of the prediction if
            the simulator is the draw; inf if the model is sure of no measurement.
        p_value: Probability of an error as large, if the model holds.
        by_both: Whether it is as far outside what the bare model predicts.
    """

    position: int
    name: str
    size: float
    p_value: float
    by_both: bool


@dataclass(frozen=True, kw_only=True)
class OutlyingTrial:
    """A fitted trial that errs far more than the others, where every model misses.

    Attributes:
        position: Place among the fitted trials.
        name: Name of the trial in reports.
        times: Error on the fit to the others, in medians of theirs.
    """

    position: int
    name: str
    times: float


@dataclass(frozen=True, kw_only=True)
class BoundParameter:
    """A parameter that the trials press against a bound of its prior.

    Attributes:
        name: Name of the parameter.
        model: Model in which it is: "none", or effects joined by " + ".
        side: "lower" or "upper".
        bound: Value at which the prior ends.
        beyond: Best fit with the bound moved; NaN where the simulator gives nothing
            beyond it.
    """

    name: str
    model: str
    side: str
    bound: float
    beyond: float


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """Parameters at bounds of the prior, and whether they make up for effects.

    Attributes:
        parameters: Parameters of the bare model, then of the model of the verdict.
        p_value: Tail probability of the chi-square of the bare model with its bounds
            moved; NaN where none of its parameters is at one.
        replaces: Effects that the verdict named, and that the bare model does without
            if its bounds are moved, or that nothing tells from it; "" for none.
    """

    parameters: tuple[BoundParameter, ...] = ()
    p_value: float = float("nan")
    replaces: str = ""


@dataclass(frozen=True, kw_only=True)
class SevereTest:
    """An action at which a verdict that names effects would be put to the test.

    Attributes:
        action: Action, shape (action_dim,).
        is_permitted: Whether it is among the permitted actions.
        difference: Least difference between the verdict's prediction and that without
            one of its effects, root mean square over the numbers of x, in standard
            deviations of the verdict's prediction, noise included.
    """

    action: Array
    is_permitted: bool
    difference: float


#: What is neither named nor declared.
UNDECLARED = "something undeclared"


@dataclass(frozen=True, kw_only=True)
class Support:
    """Evidence for an effect that helps, where every model misses.

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
    left_out: str = "trials"
    weights: dict[str, float] = field(default_factory=dict)
    instead: dict[str, tuple[str, ...]] = field(default_factory=dict)
    open_forms: dict[str, str] = field(default_factory=dict)

    def of(self, name: str) -> ModelError:
        """Return the errors of a model by its name."""
        return next(m for m in self.models if m.name == name)

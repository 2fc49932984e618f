"""Evidence against a verdict, or its tests: trials, bounds of the prior, actions."""

from __future__ import annotations

from dataclasses import dataclass

from sbi_active.arrays import Array


@dataclass(frozen=True, kw_only=True)
class MissedTrial:
    """A held-out trial far outside what the model of a verdict predicts.

    Attributes:
        position: Place among the held-out trials.
        name: Name of the trial in reports.
        size: Root mean square error; inf if the model is sure of no measurement.
        unit: Unit of ``size``: sensor deviations, or the simulator's where it is the
            draw.
        p_value: Probability of an error as large, if the model holds.
        by_both: Whether it is as far outside what the bare model predicts.
    """

    position: int
    name: str
    size: float
    p_value: float
    by_both: bool
    unit: str = "sensor deviations"


@dataclass(frozen=True, kw_only=True)
class OutlyingTrial:
    """A fitted trial that errs far more than the others, where every model misses.

    Attributes:
        position: Place among the fitted trials.
        name: Name of the trial in reports.
        times: Error on the fit to the others, in medians of theirs.
        size: Root mean square of that error, in sensor deviations.
    """

    position: int
    name: str
    times: float
    size: float


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
        difference: Difference between the verdict's prediction and that of a free
            residual, root mean square over the numbers of x, in standard deviations of
            the verdict's prediction, noise included.
    """

    action: Array
    is_permitted: bool
    difference: float

"""Results if every model misses by more than the sensor's error."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

Array = NDArray[Any]

#: What is neither named nor declared.
UNDECLARED = "something undeclared"


@dataclass(frozen=True, kw_only=True)
class OddsSettings:
    """Settings of the odds that an effect is a cause and no imitation.

    All are empirical: tuned on simulated worlds (``benchmarks/misfit``, whose judging
    seeds had no part), and so that measured machines whose cause was removed from the
    library are told right.

    Attributes:
        named: Probability of being the cause from which an effect is named.
        declared: Odds of each declared effect beforehand, over their number.
        enough: Number of effects of a library that leaves out as little as a larger
            one.
        further: Factor of each further effect that helps.
        at_bound: Factor of each parameter that is at its bound.
        weak: Nats gained by an effect that leave half of the odds.
        weak_untimed: Nats that leave a quarter, without a time axis.
        remaining: Share of the excess error from which what remains counts.
        steep: Power of that.
        far: Mean squared error on left-out trials that leaves half of the odds, in
            sensor variances.
        tempered: Power of the product, whose factors share what they know.
    """

    named: float = 0.5
    declared: float = 6.0
    enough: int = 9
    further: float = 0.7
    at_bound: float = 0.6
    weak: float = 50.0
    weak_untimed: float = 20.0
    remaining: float = 0.25
    steep: float = 2.0
    far: float = 200.0
    tempered: float = 0.6


@dataclass(frozen=True, kw_only=True)
class Odds:
    r"""Odds that an effect is a cause, and does not imitate an undeclared one.

    .. math::
        o = \left(6 \min(n, 9) \; .7^{k - 1} \; .6^b \; g
            \left(1 + \left(\frac{u}{.25}\right)^2\right)^{-2}
            \left(1 + \frac{M}{200}\right)^{-1}
            \left(1 + \frac{e^G}{6}\right)^{-1}\right)^{.6}, \quad
        g = \frac{\Delta}{\Delta + 50}, \text{ or }
            \left(\frac{\Delta}{\Delta + 20}\right)^2 \text{ without a time axis.}

    The more effects are declared, the less is left out, up to nine of them. What gains
    little and what leaves much may be an imitation, and little is a few nats more where
    a trial is a few numbers without a time axis; there elementary formulas, which stand
    for what was not declared, compete with it. Several effects imitate more easily than
    one, and so does one that drives parameters of the simulator to their bounds; and a
    simulator that still misses by tens of the sensor's deviations lacks something
    large. These factors share what they know, so that their product is tempered. All of
    these numbers are empirical: tuned on simulated worlds (``benchmarks/misfit``, where
    others judge them) and so that measured machines whose cause was removed from the
    library are told right; M decides on these alone.

    Attributes:
        declared: n, the effects of the library.
        helping: k, those that help.
        at_bounds: b, parameters of the simulator at a bound beside them.
        gained: :math:`\Delta`, nats that the verdict gains by the effect, beside
            something undeclared and with its prior.
        remains: u, the share of the excess of the fit's mean squared residual over the
            sensor's that the effect leaves of the excess without it, or of the bare
            model's, whichever is more.
        error: M, mean squared error of the verdict on left-out trials, in sensor
            variances.
        timed: Whether x has a time axis.
        guessed: G, nats that elementary formulas in the place of the effect gain over
            it; with a time axis they are not asked.
        own: Settings.
    """

    declared: int
    helping: int
    at_bounds: int
    gained: float
    remains: float
    error: float
    timed: bool
    guessed: float = -np.inf
    own: OddsSettings = OddsSettings()

    @property
    def value(self) -> float:
        """The product, tempered."""
        own = self.own
        likely = own.declared * min(self.declared, own.enough)
        imitated = own.further ** (self.helping - 1) * own.at_bound**self.at_bounds
        left = (1 + (self.remains / own.remaining) ** 2) ** own.steep
        far = 1 + self.error / own.far
        unguessed = expit(np.log(own.declared) - self.guessed)
        o = likely * imitated * self.by_gain / left / far * unguessed
        return float(o**own.tempered)

    @property
    def by_gain(self) -> float:
        """Factor of the nats gained, g."""
        if self.timed:
            return self.gained / (self.gained + self.own.weak)
        return (self.gained / (self.gained + self.own.weak_untimed)) ** 2

    @property
    def probability(self) -> float:
        """Probability of a cause, o / (1 + o)."""
        return self.value / (1 + self.value)


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
        cause: Probability that each of them is the cause: of being there, times that of
            its odds.
        better: Probability that each lowers the error on a new trial.
        odds: Odds that each of them is no imitation.
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
        least: Probability of being the cause from which an effect is named.
    """

    models: tuple[ModelError, ...]
    helps: tuple[str, ...]
    cause: dict[str, float]
    better: dict[str, float]
    odds: dict[str, Odds]
    sensor: Array
    passes: bool
    size: float
    time_scale: float
    left_out: str = "trials"
    weights: dict[str, float] = field(default_factory=dict)
    instead: dict[str, tuple[str, ...]] = field(default_factory=dict)
    least: float = OddsSettings().named

    @property
    def remains(self) -> dict[str, float]:
        """Share of the excess error that each of them leaves."""
        return {name: odds.remains for name, odds in self.odds.items()}

    @property
    def named(self) -> tuple[str, ...]:
        """Effects that are probably the cause."""
        return tuple(n for n in self.helps if self.cause[n] > self.least)

    def of(self, name: str) -> ModelError:
        """Return the errors of a model by its name."""
        return next(m for m in self.models if m.name == name)

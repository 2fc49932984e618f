"""What is found where every model misses by more than the sensor's error."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]

#: Probability of being the cause from which an effect is named.
NAMED = 0.5
#: What is neither named nor declared.
UNDECLARED = "something undeclared"


@dataclass(frozen=True, kw_only=True)
class ModelError:
    """A model that was admitted, and its error on trials that it was not fitted to.

    Attributes:
        name: Effects joined by " + ", or "none".
        probability: Among the admitted models; 0 for one that was not admitted.
        left_out: Root mean square on left-out trials by channel, units of x, (c,).
        held_out: The same on held-out trials; None without any.
        remains: Share of the bare model's excess error on left-out trials.
    """

    name: str
    probability: float
    left_out: Array
    held_out: Array | None
    remains: float


@dataclass(frozen=True, kw_only=True)
class Misfit:
    """Why the verdict is what it is where no model is right.

    Attributes:
        models: Admitted ones, most probable first; the bare model and that of the
            verdict are always there.
        helps: Effects with which a new trial is predicted better, of the verdict.
        cause: Probability that each of them is the cause.
        better: Probability that each lowers the error on a new trial.
        remains: Share of the excess error that each leaves.
        sensor: Its standard deviation by channel, units of x, (c,).
        passes: Whether the chi-square of the verdict passes against the sensor.
        size: Of the residual process beside the verdict's model, in sensor deviations.
        time_scale: Of that process, in the unit of the sample times; NaN where x has
            no time axis, and each number an error of its own.
        left_out: What was left out: "trials" or "parts of trials".
        weights: Of models by their errors on left-out parts, where probabilities are
            too sure; by name, largest first, without those that hardly count. A next
            action is to tell these apart.
        instead: What may stand in the place of an effect that helps: left-out trials
            are not surely predicted worse with it there.
    """

    models: tuple[ModelError, ...]
    helps: tuple[str, ...]
    cause: dict[str, float]
    better: dict[str, float]
    remains: dict[str, float]
    sensor: Array
    passes: bool
    size: float
    time_scale: float
    left_out: str = "trials"
    weights: dict[str, float] = field(default_factory=dict)
    instead: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def named(self) -> tuple[str, ...]:
        """Effects that are probably the cause."""
        return tuple(n for n in self.helps if self.cause[n] > NAMED)

    def of(self, name: str) -> ModelError:
        """Return the errors of a model by its name."""
        return next(m for m in self.models if m.name == name)

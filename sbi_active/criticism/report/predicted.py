"""Trials that were chosen to test a verdict: predicted, then measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sbi_active.arrays import Array


@dataclass(frozen=True, kw_only=True)
class Registered:
    """What a verdict predicts of a trial, written down before the trial is run.

    Attributes:
        index: Place of the trial in the order of execution.
        action: Action of the trial, shape (action_dim,).
        purpose: What the trial is to tell.
        verdict: Verdict that predicts.
        mean: Predicted numbers, shape (N,), in units of x.
        sd: Their standard deviations, noise included, shape (N,).
        position: Positions of these numbers in the flattened x, shape (N,).
        limit: Distance within which an outcome lies with a probability of .9, root mean
            square over x in ``sd``.
        bare: Numbers that the bare model predicts, shape (N,), in units of x.
        effects: Effects of the model that predicts, named by the verdict or not.
    """

    index: float
    action: Array
    purpose: str
    verdict: str
    mean: Array
    sd: Array
    position: Array
    limit: float
    bare: Array
    effects: tuple[str, ...] = ()

    def distance(self, x: Array) -> float:
        """Return the distance of an outcome; NaN if nothing was measured.

        Args:
            x: Measured numbers, of the shape of x.
        """
        z = (np.ravel(x)[self.position] - self.mean) / self.sd
        seen = np.isfinite(z)
        return float(np.sqrt(np.mean(z[seen] ** 2))) if seen.any() else float("nan")


@dataclass(frozen=True, kw_only=True)
class TestedTrial:
    """A trial that was run to test a verdict.

    Attributes:
        registered: Prediction, made before the trial was run.
        x: Measured numbers, of the shape of x.
        after: Verdict with the trial among the data.
    """

    registered: Registered
    x: Array
    after: str

    __test__ = False  # no test of pytest's

    @property
    def distance(self) -> float:
        """Distance of the outcome from the prediction, in its standard deviations."""
        return self.registered.distance(self.x)

    @property
    def is_measured(self) -> bool:
        """Whether it gave a number that was predicted; else it holds nothing to."""
        return bool(np.isfinite(self.distance))

    @property
    def held(self) -> bool:
        """Whether the outcome lies within the 90 % interval of the prediction."""
        return self.distance <= self.registered.limit

    def in_words(self) -> tuple[str, str]:
        """Return what was predicted and what was measured, in units of x."""
        own, is_one = self.registered, len(self.registered.mean) == 1
        half = own.limit * float(np.sqrt(np.mean(own.sd**2)))
        predicted = f"within {half:.3g} of its course"
        if is_one:
            predicted = f"{own.mean[0] - half:.4g} to {own.mean[0] + half:.4g}"
        if not self.is_measured:
            return predicted, "nothing"
        measured = f"{self._off(own.mean):.3g} off"
        if is_one:
            measured = f"{np.ravel(self.x)[own.position][0]:.4g}"
        if not np.array_equal(own.mean, own.bare):
            measured += f" (bare model: {self._off(own.bare):.3g} off)"
        return predicted, measured

    def _off(self, predicted: Array) -> float:
        """Return the root mean square by which a prediction missed, units of x."""
        x = np.ravel(self.x)[self.registered.position]
        return float(np.sqrt(np.nanmean((x - predicted) ** 2)))

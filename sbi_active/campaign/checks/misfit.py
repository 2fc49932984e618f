"""The misfit of a belief to the trials that it was fitted to."""

from __future__ import annotations

import math

from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.inference.refinement.regression_error import LARGE


def misfit(diagnostics: Diagnostics) -> float | None:
    """Return a belief's tail probability, of all trials or the worst, both counted.

    Args:
        diagnostics: Diagnostics of the belief. The result is None without tail
            probabilities, and where the belief is off by more than a test of the
            simulator can bear.
    """
    each, joint = diagnostics.tail_probability_of_trial, diagnostics.tail_probability
    if joint is None or error_nats(diagnostics) > LARGE:
        return None
    return min(1.0, 2 * min(joint, len(each) * min(each)))


def error_nats(diagnostics: Diagnostics) -> float:
    """Return the nats that a belief is off as its simulations are few, 0 if unknown."""
    modes = diagnostics.assumptions.get("few_modes")
    if modes is not None and not modes.holds:
        return math.inf  # whatever the other figures say of those that were found
    return diagnostics.error_nats_if_explained or 0.0

"""Numbers, names and actions in words."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.data.units import split


@dataclass(frozen=True, kw_only=True)
class Told:
    """How much of it a report tells; none of it decides anything.

    Attributes:
        names: Trials or models that a line names at most.
        trials: Trials that are listed, the worst.
        moves: Parameters whose moves are listed.
        entries: Entries of an action whose range is listed.
        pairs: Scored trials below which the pairs stand in place of an interval.
        share: Probability from which a set of effects, or a form, is listed.
        certain: Probability from which a form of a force is named.
        mass: Share of the probability that suspects of a gross error hold together.
        smallest_p: Value below which the digits of a p-value mean nothing.
        digits: Digits of a number that any deviation leaves.
        draws: Effective draws below which a deviation is none to print.
        prior_draws: Draws that a width is compared with.
        panels: Panels of a figure by entries of the action.
        ticks: Trials that have their names at an axis.
        logarithmic: Residual, in deviations, from which an axis is logarithmic.
    """

    names: int = 3
    trials: int = 6
    moves: int = 3
    entries: int = 3
    pairs: int = 8
    share: float = 0.01
    certain: float = 0.9
    mass: float = 0.9
    smallest_p: float = 1e-4
    digits: int = 6
    draws: float = 50.0
    prior_draws: int = 2_000
    panels: int = 3
    ticks: int = 16
    logarithmic: float = 12.0


TOLD = Told()


def stated(value: float) -> str:
    """Return a probability as an equation."""
    text = probability(value)
    return f"P {text}" if text[0] in "<>" else f"P = {text}"


def probability(value: float) -> str:
    """Return a probability in digits that mean something."""
    if value < 0.005:
        return "< .01"
    return "> .99" if value > 0.995 else f"{value:.2f}"


def number(value: float) -> str:
    """Return a number with three digits; nothing for NaN."""
    if np.isnan(value):
        return ""
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}"


def estimated(mean: float, sd: float, draws: float) -> str:
    """Return a mean with its deviation, or alone where few draws are behind them.

    The text is empty for NaN.

    Args:
        mean: Mean of the draws.
        sd: Standard deviation of the draws.
        draws: Effective number of the draws.

    Example:
        >>> estimated(0.35992, 0.00071, 400), estimated(0.35992, 0.00071, 3)
        ('0.35992 +- 0.00071', 'about 0.36')
    """
    if draws >= TOLD.draws or np.isnan(mean):
        return with_error(mean, sd)
    return f"about {mean:.2g}"


def with_error(mean: float, sd: float) -> str:
    """Return a mean to the second digit of its deviation; nothing for NaN.

    A mean that is known better than that has six digits.

    Example:
        >>> with_error(0.35992, 0.00071), with_error(1234.5, 56.7)
        ('0.35992 +- 0.00071', '1234 +- 57')
        >>> with_error(159.873313255, 2.8e-14)
        '159.873 +- 2.8e-14'
    """
    if np.isnan(mean):
        return ""
    size = abs(mean) + sd
    if not (sd > 0 and 1e-4 <= size < 1e6):  # powers of ten, or no deviation
        return f"{mean:.4g} +- {sd:.2g}"
    exponent = int(f"{sd:.1e}".split("e")[1])  # after rounding to two digits
    places = max(1 - exponent, 0)
    most = max(TOLD.digits - int(f"{mean:.{TOLD.digits - 1}e}".split("e")[1]) - 1, 0)
    if places > most:
        return f"{mean:.{most}f} +- {sd:.2g}"
    return f"{mean:.{places}f} +- {sd:.{places}f}"


def listed(names: Iterable[str], last: str = "and") -> str:
    """Return names in a row, as in "a, b and c"."""
    *first, end = names
    return f"{', '.join(first)} {last} {end}" if first else end


def called(names: Sequence[str], position: int) -> str:
    """Return the name of a trial, or its position without names."""
    return names[position] if names else str(position)


def setting(labels: Sequence[str], action: NDArray[np.float64]) -> str:
    """Return an action in words, each entry with its name and unit.

    Example:
        >>> setting(["speed [m/s]", "tilt"], np.array([2.5, 0.125]))
        'speed = 2.5 m/s, tilt = 0.125'
    """
    return ", ".join(
        f"{name} = {value:.4g} {unit}".rstrip()
        for (name, unit), value in zip(map(split, labels), action, strict=True)
    )

"""Numbers in words: as many digits as mean something."""

from __future__ import annotations

import numpy as np

#: Digits of a number that any deviation leaves.
MOST_DIGITS = 6
#: Effective draws below which a deviation is none to print.
FEWEST_DRAWS = 50.0


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
    if draws >= FEWEST_DRAWS or np.isnan(mean):
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
    most = max(MOST_DIGITS - int(f"{mean:.{MOST_DIGITS - 1}e}".split("e")[1]) - 1, 0)
    if places > most:
        return f"{mean:.{most}f} +- {sd:.2g}"
    return f"{mean:.{places}f} +- {sd:.{places}f}"

"""Templates of a report, and numbers and names as it writes them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from sbi_active.arrays import Array
from sbi_active.criticism.data.units import split
from sbi_active.criticism.results import FEW_DRAWS
from sbi_active.display.page import environment


def blocks(template: str, **values: Any) -> list[str]:
    """Return what a template says: paragraphs, items and titles, a line each.

    Args:
        template: Name of the template, without its ending.
        **values: Values of its names.
    """
    text = _templates().get_template(f"{template}.jinja").render(values)
    return [" ".join(b.split()) for b in re.split(r"\n\s*\n", text) if b.strip()]


@cache
def _templates() -> Any:
    made = environment("sbi_active.criticism", "report")
    for form in (number, probability, stated, listed, counted):
        made.filters[form.__name__] = form
    return made


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


def with_error(mean: float, sd: float, draws: float = np.inf) -> str:
    """Return a mean to the second digit of its deviation; nothing for NaN.

    A mean that is known better than that has six digits, and one with few draws behind
    it no deviation.

    Args:
        mean: Mean of the draws.
        sd: Standard deviation of the draws.
        draws: Effective number of the draws.

    Example:
        >>> with_error(0.35992, 0.00071), with_error(1234.5, 56.7)
        ('0.35992 +- 0.00071', '1234 +- 57')
        >>> with_error(159.873313255, 2.8e-14), with_error(0.35992, 0.00071, 3)
        ('159.873 +- 2.8e-14', 'about 0.36')
        >>> with_error(-0.003, 1.9)
        '0.0 +- 1.9'
    """
    if np.isnan(mean):
        return ""
    if draws < FEW_DRAWS:
        return f"about {mean:.2g}"
    size = abs(mean) + sd
    if not (sd > 0 and 1e-4 <= size < 1e6):  # powers of ten, or no deviation
        return f"{mean:.4g} +- {sd:.2g}"
    places = max(1 - int(f"{sd:.1e}".split("e")[1]), 0)  # after rounding
    most = max(5 - int(f"{mean:.5e}".split("e")[1]), 0)
    error = f"{sd:.{places}f}" if places <= most else f"{sd:.2g}"
    digits = min(places, most)
    return f"{round(mean, digits) + 0.0:.{digits}f} +- {error}"  # no "-0.0"


def listed(names: Sequence[str], last: str = "and") -> str:
    """Return names in a row, as in "a, b and c"."""
    *first, end = names or [""]
    return f"{', '.join(first)} {last} {end}" if first else end


def counted(trials: Sequence[Any], kind: str, what: str) -> str:
    """Return what trials are, as in "trials a and b are"; many by their number."""
    names = [trial.name for trial in trials]
    verb = f"{'is' if len(names) == 1 else 'are'} {what}"
    if len(names) > 3:
        return f"{len(names)} {kind}s {verb}"
    return f"{kind}{'s' * (len(names) > 1)} {listed(names)} {verb}"


def setting(labels: Sequence[str], action: Array) -> str:
    """Return an action in words, each entry with its name and unit.

    Example:
        >>> setting(["speed [m/s]", "tilt"], np.array([2.5, 0.125]))
        'speed = 2.5 m/s, tilt = 0.125'
    """
    return ", ".join(
        f"{name} = {value:.4g} {unit}".rstrip()
        for (name, unit), value in zip(map(split, labels), action, strict=True)
    )

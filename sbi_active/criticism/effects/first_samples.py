r"""Nuisances of each trial, centered on what its first samples show.

A polynomial in time is fitted to the first samples of each trial by least squares. Its
value and derivatives at the start are the center of the nuisance, and its deviation is
a few of their standard errors, which are those of the sensor:

.. math::
    \hat\beta = (A^\top A)^{-1} A^\top x, \qquad
    s_j = w\, \sigma\, j! \sqrt{\bigl[(A^\top A)^{-1}\bigr]_{jj}}, \qquad
    A_{ij} = (t_i - t_0)^j .

The factor w, three unless told, leaves room for what a polynomial misses. The samples
are fitted as well: at w = 3 they count 1 + 1/9 times at the start.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import factorial
from typing import Any

import numpy as np
import torch
from scipy.stats import chi2
from torch import Tensor
from torch.distributions import Independent, Normal

from sbi_active.arrays import Array
from sbi_active.criticism.data.arrays import repeated
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.effect import Context, Effect
from sbi_active.expected import require
from sbi_active.messages import warn

#: Standard errors in a deviation of the nuisance.
WIDTH = 3.0
#: Probability, over all trials, of warning of first samples that are a polynomial.
BENT = 1e-3


def start_from_first_samples(
    trials: Trials,
    start: Mapping[str, int | tuple[int, int]],
    *,
    within: float,
    sd: float | Sequence[float],
    at: float | None = None,
    width: float = WIDTH,
    name: str = "start",
) -> tuple[Trials, Effect]:
    """Return the trials with a start state, and the nuisance of each trial about it.

    The simulator takes the start state as its keyword ``start``, {name: (n,)}, as it
    does one that was measured.

    Args:
        trials: Trials with sample times. Held-out trials start from their own
            first samples.
        start: Start state by name: an entry of x's last axis, or this and the order of
            the derivative: {"angle": 0, "speed": (0, 1)}. The polynomial has the
            largest of these orders, and at least one.
        within: Time from its first sample in which a trial's motion is such a
            polynomial, in the unit of the sample times.
        sd: Standard deviation of the sensor, one for all entries of x or one each.
        at: Time at which the simulator starts; None for each trial's first sample.
        width: Standard errors in a deviation of the nuisance.
        name: Name of the nuisance.

    Returns:
        A copy of the trials with ``start``, beside what was measured of it, and an
        effect of scope "trial" with an entry of phi for each name.

    Warns:
        UserWarning: If first samples leave the polynomial by more than the sensor's
            error: a line, where speeds alone are named, does not know of gravity.

    Raises:
        ValueError: If there are no sample times, an entry of x is not there, a
            deviation is not positive, or a trial has too few first samples.

    Example:
        >>> times = torch.linspace(0, 1, 11)
        >>> trials = Trials([1.0, 2.0], torch.stack([3 + times, 4 - times]),
        ...     sample_times=times)
        >>> trials, nuisance = start_from_first_samples(
        ...     trials, {"place": 0, "speed": (0, 1)}, within=0.35, sd=0.01)
        >>> [round(v, 3) for v in trials.start["speed"].tolist()]
        [1.0, -1.0]
        >>> nuisance.scope, nuisance.phi_dim
        ('trial', 2)
    """
    wanted = [(v, 0) if isinstance(v, int) else v for v in start.values()]
    degree = max([1, *[order for _, order in wanted]])
    values, errors, p_value = _fitted(trials, wanted, degree, within, sd, at)
    if bent := np.flatnonzero(p_value < BENT / (len(trials) * len(wanted))).tolist():
        warn(
            f"SA211 the first samples of {trials.called(bent)} leave a "
            f"polynomial of order {degree} by more than the sensor's error, so that "
            "their start is wrong and hides what bends them, such as gravity: name a "
            f"derivative of order {degree + 1} as well, or pass a shorter within",
        )
    copy = trials.select(slice(None))
    shown = dict(zip(start, torch.from_numpy(values.T.copy()), strict=True))
    copy.start = {**(trials.start or {}), **shown}
    copy.repeat_of = repeated(copy.settings())
    scale = torch.from_numpy(width * errors.max(0))  # of the trial that tells least
    prior = Independent(Normal(torch.zeros_like(scale), scale), 1)
    shifted, own = _Shifted((*start,)), {"prior": prior, "scope": "trial"}
    return copy, Effect(name, hook="dynamics", null=0.0, apply=shifted, **own)


@dataclass(frozen=True)
class _Shifted:
    """Adds phi to the start state that the simulator is told."""

    names: tuple[str, ...]

    def __call__(
        self, value: dict[str, Any], phi: Tensor, action: Tensor, context: Context
    ) -> dict[str, Any]:
        start = value.get("start")
        if start is None:  # the simulator starts where it will
            return value
        own = dict(zip(self.names, phi.unbind(-1), strict=True))
        return {**value, "start": {k: v + own.get(k, 0) for k, v in start.items()}}


def _fitted(
    trials: Trials,
    wanted: Sequence[tuple[int, int]],
    degree: int,
    within: float,
    sd: float | Sequence[float],
    at: float | None,
) -> tuple[Array, Array, Array]:
    """Return derivatives of polynomials at the start of each trial, (n, k).

    Args:
        trials: Trials with sample times.
        wanted: Entry of x's last axis and order of the derivative, k of them.
        degree: Degree of the polynomials.
        within: Time from its first sample in which a trial is fitted.
        sd: Standard deviation of the sensor, one for all entries of x or one each.
        at: Time of the start; None for each trial's first sample.

    Returns:
        The derivatives, their standard errors, and the tail probability of what the
        polynomial leaves; the last by trial, the smallest of the k.
    """
    shape, times = tuple(trials.x.shape), trials.sample_times
    if times is None or len(shape) > 3:
        raise ValueError(
            "expected trials with sample times, and x of shape (n, k) or (n, k, "
            f"channels); got {'none' if times is None else shape}; pass "
            "Trials(sample_times=...), and what a sample has on one axis"
        )
    x = trials.x.double().numpy().reshape(*shape[:2], -1)
    wrong = [c for c, _ in wanted if not 0 <= c < x.shape[2]]
    expected = f"entries of x's last axis from 0 to {x.shape[2] - 1}"
    require(not wrong, expected, wrong, "number them from 0")
    sds = np.broadcast_to(np.asarray(sd, dtype=float), (x.shape[2],))
    expected = "a standard deviation > 0 of the sensor"
    require(bool((sds > 0).all()), expected, sd, "pass its error")
    stamps = times.double().expand(shape[:2]).numpy()
    values, errors, p_value = np.empty((3, len(trials), len(wanted)))
    for i, j in np.ndindex(values.shape):
        (channel, order), t = wanted[j], stamps[i]
        seen = np.isfinite(t) & np.isfinite(x[i, :, channel])
        first = seen & (t - t[seen].min(initial=np.inf) < within)
        apart = f", {np.median(np.diff(t[seen])):.3g} apart" if seen.sum() > 1 else ""
        require(
            bool(first.sum() > degree),
            f"{degree + 1} or more samples within {within:g} of the first",
            f"{int(first.sum())} in {trials.called([i])}{apart}",
            "pass a larger within, or name the unit of the times, as in time_ms",
        )
        t, own = t[first], x[i, first, channel]
        t = t - (t[0] if at is None else at)
        value, covariance = np.polyfit(t, own, degree, cov="unscaled")
        misfit = (own - np.polyval(value, t)) / sds[channel]
        freedom, place = max(len(t) - degree - 1, 1), degree - order
        p_value[i, j] = chi2.sf(np.sum(misfit**2), freedom)
        values[i, j] = factorial(order) * value[place]
        error = sds[channel] * np.sqrt(covariance[place, place])
        errors[i, j] = factorial(order) * error
    return values, errors, p_value.min(1)

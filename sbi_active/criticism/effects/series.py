r"""Actuators and sensors acting on a series, exactly between its samples.

An input is held between the points of its grid, and a simulator may read it once a
step. What a delay :math:`\tau` or a lag makes of it is therefore its mean over the step
that follows: the same in total, and a smooth function of :math:`\tau` down to 0, where
the lagged input at the grid's points alone would be flat,

.. math::
    \bar y_k = u_k + (y_k - u_k) \frac{\tau}{h} (1 - a), \qquad
    y_{k+1} = u_k + (y_k - u_k)\, a, \qquad a = e^{-h / \tau}.

The measured x is a line between its samples instead: with slope
:math:`s_k = (x_{k+1} - x_k) / h_k` the lagged sensor reads

.. math::
    y_{k+1} = x_{k+1} - \tau s_k + (y_k - x_k + \tau s_k)\, e^{-h_k / \tau}.

Recursions are evaluated for all samples in :math:`\log_2 m` passes.

References:
    Franklin, Powell & Workman, Digital Control of Dynamic Systems (1998), on sampled
    systems between holds; Blelloch, Prefix sums and their applications, CMU-CS-90-190.
"""

from __future__ import annotations

import torch
from torch import Tensor


def lagged_input(u: Tensor, tau: Tensor, step: Tensor) -> Tensor:
    """Return a held series behind a first-order lag, its mean over each step.

    Args:
        u: Series, shape (n, m), at rest before.
        tau: Time constant, 0 for none, shape (n, 1).
        step: Step of the grid.
    """
    tau = tau.clamp(min=0)
    keep = torch.exp(-step / tau)
    y = _affine(keep.expand_as(u[:, 1:]), (1 - keep) * u[:, :-1], u[:, :1])
    return u + (y - u) * (tau / step) * (1 - keep)


def delayed_input(u: Tensor, tau: Tensor, step: Tensor) -> Tensor:
    """Return a held series later by tau, its mean over each step.

    Args:
        u: Series, shape (n, m); its first value held before.
        tau: Delay, shape (n, 1).
        step: Step of the grid.
    """
    place = torch.arange(u.shape[1], dtype=u.dtype) - tau / step
    place = place.clamp(0, u.shape[1] - 1)
    low = place.long().clamp(max=u.shape[1] - 2)
    part = place - low
    return (1 - part) * u.gather(1, low) + part * u.gather(1, low + 1)


def played(u: Tensor, width: Tensor) -> Tensor:
    r"""Return a series behind a backlash, :math:`|y_k - u_k| \le w / 2`.

    Args:
        u: Series, shape (n, m); it starts in the middle of the play.
        width: w, shape (n, 1).
    """
    half = width.clamp(min=0) / 2
    low, high = u - half, u + half
    # To hold y within limits, and then within further ones, is to hold it within both.
    shift = 1
    while shift < u.shape[1]:
        first, later = slice(None, -shift), slice(shift, None)
        low, high = (
            torch.cat(
                [
                    part[:, :shift],
                    torch.minimum(
                        torch.maximum(part[:, first], low[:, later]), high[:, later]
                    ),
                ],
                1,
            )
            for part in (low, high)
        )
        shift *= 2
    return torch.minimum(torch.maximum(u[:, :1], low), high)


def lagged_samples(x: Tensor, tau: Tensor, times: Tensor) -> Tensor:
    """Return samples by a sensor with a first-order lag, at rest before the first.

    Args:
        x: Observations, shape (n, k, ...), a line between its samples.
        tau: Time constant, 0 for none, shape (n, 1).
        times: Times, shape (n, k); what pads a shorter trial has the time of its last
            sample.
    """
    if x.shape[1] < 2:
        return x
    tau = tau.clamp(min=0)
    gap = times.diff(dim=1)
    keep = torch.exp(-gap / tau).where(gap > 0, torch.ones_like(gap))
    gap = gap.where(gap > 0, torch.ones_like(gap))
    shape = (*keep.shape, *[1] * (x.ndim - 2))
    keep, gap = keep.reshape(shape), gap.reshape(shape)
    behind = tau.reshape(-1, *[1] * (x.ndim - 1)) * x.diff(dim=1) / gap
    # y - x follows the lag of what the slope leaves behind.
    rest = _affine(keep.expand_as(behind), -behind * (1 - keep), 0 * x[:, :1])
    return x + rest


def delayed_samples(x: Tensor, tau: Tensor, times: Tensor) -> Tensor:
    """Return samples of what was there tau before, the first value before it.

    Args:
        x: Samples, as in :func:`lagged_samples`.
        tau: Delay, shape (n, 1).
        times: Sample times, as in :func:`lagged_samples`.
    """
    if x.shape[1] < 2:
        return x
    wanted = torch.minimum((times - tau).clamp(min=times[:, :1]), times[:, -1:])
    return at_times(x, wanted, times)


def at_times(x: Tensor, wanted: Tensor, times: Tensor) -> Tensor:
    """Return samples at other times, linear between samples and beyond the ends.

    Args:
        x: Samples, as in :func:`lagged_samples`.
        wanted: Times that are wanted, shape (n, k).
        times: Sample times, as in :func:`lagged_samples`.
    """
    times, wanted = times.contiguous(), wanted.contiguous()
    last = times.shape[1] - 2
    low = (torch.searchsorted(times, wanted, right=True) - 1).clamp(0, last)
    gap = times.gather(1, low + 1) - times.gather(1, low)
    # What pads a shorter trial has the time of its last sample.
    gap = gap.where(gap > 0, torch.ones_like(gap))
    weight = (wanted - times.gather(1, low)) / gap
    shape = (*low.shape, *[1] * (x.ndim - 2))
    index, weight = low.reshape(shape).expand_as(x), weight.reshape(shape)
    return (1 - weight) * x.gather(1, index) + weight * x.gather(1, index + 1)


def rounded(x: Tensor, quantum: Tensor) -> Tensor:
    """Return samples to the nearest multiple of a quantum, 0 for as they are.

    Args:
        x: Observations, shape (n, ...).
        quantum: Quantum, of the shape of x or of one that broadcasts to it.
    """
    quantum = quantum.expand_as(x)
    safe = quantum.where(quantum > 0, torch.ones_like(quantum))
    return torch.where(quantum > 0, torch.round(x / safe) * safe, x)


def _affine(factor: Tensor, shift: Tensor, start: Tensor) -> Tensor:
    """Return y with y_0 = start and y_{k+1} = factor_k y_k + shift_k.

    Args:
        factor: Factors, shape (n, k - 1, ...).
        shift: Shift of each step, of the same shape.
        start: Start values, shape (n, 1, ...).
    """
    reach = 1
    while reach < factor.shape[1]:
        first, later = slice(None, -reach), slice(reach, None)
        shift = torch.cat(
            [shift[:, :reach], shift[:, later] + factor[:, later] * shift[:, first]], 1
        )
        factor = torch.cat([factor[:, :reach], factor[:, later] * factor[:, first]], 1)
        reach *= 2
    return torch.cat([start, factor * start + shift], 1)

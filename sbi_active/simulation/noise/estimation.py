"""The noise of a system from repeated measurements."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from sbi_active.expected import require
from sbi_active.messages import warn
from sbi_active.simulation.noise.autocorrelated import (
    AutocorrelatedNoise,
    innovations,
    time_stamps,
)
from sbi_active.simulation.noise.gaussian import GaussianNoise
from sbi_active.simulation.noise.posterior import (
    Cells,
    InverseChiSquare,
    NoisePosterior,
)

NoiseKind = Literal["gaussian", "autocorrelated"]

Array = Tensor | np.ndarray


def estimate_noise(
    repeats: Array | Sequence[Array],
    *,
    kind: NoiseKind = "gaussian",
    times: Tensor | None = None,
    pooled: bool = False,
) -> GaussianNoise | AutocorrelatedNoise:
    r"""Return a noise model with a posterior over its parameters.

    Every group of repeats has a mean of its own, which is integrated out under a flat
    prior, as is the standard deviation's :math:`p(\sigma) \propto 1 / \sigma`:

    * "gaussian": :math:`\nu s^2 / \sigma^2 \sim \chi^2_\nu`, exactly, with :math:`\nu`
      the number of measurements less that of means and :math:`\nu s^2` their sum of
      squares.
    * "autocorrelated": the same given :math:`\tau`, whose posterior is

      .. math::
          p(\tau | D) \propto p(\tau) \, |R_\tau|^{-1/2} \prod_c Q_c(\tau)^{-\nu_c / 2}

      on a grid, with R the correlation of the contrasts between repeats and Q their
      whitened sum of squares. The prior is uniform in :math:`\log \tau` from a tenth of
      the shortest time step to three times the recording.

    The point values in ``noise.parameters`` are s and medians.

    Args:
        repeats: Measurements of one action on one system, shape (k, *x_shape); or a
            sequence of such groups, of several actions. NaN masks a number, and a
            repeat of NaN alone is left out.
        kind: Kind of the noise.
        times: Time stamps of the first axis of x in seconds, shape (T,).
        pooled: Whether to use one standard deviation for all numbers, not one a channel
            (an entry of the last axis of x). Autocorrelated noise of x of shape (T,) is
            always so.

    Returns:
        The noise model, whose ``posterior`` is over its parameters.

    Raises:
        ValueError: If there are fewer than two repeats, or all are identical.

    References:
        Gelman et al., Bayesian Data Analysis, 3rd edition, section 3.2.

    Example:
        >>> x = torch.tensor([[1.0], [2.0], [4.0]])
        >>> noise = estimate_noise(x)
        >>> noise.parameters, noise.posterior.sample((5,)).shape
        (tensor([1.5275], dtype=torch.float64), torch.Size([5, 1]))
    """
    kinds = "gaussian", "autocorrelated"
    advice = "choose one of these, or declare StudentTNoise(sd, df)"
    require(kind in kinds, f"kind among {kinds}", repr(kind), advice)
    is_timed = kind == "autocorrelated"
    groups = _groups(repeats)
    contrast = torch.cat([_contrasts(group, whole=is_timed) for group in groups])
    shape = contrast.shape
    num_sd = 1 if pooled or (is_timed and len(shape) == 2) else shape[-1]
    freedom = (~contrast.isnan()).double().reshape(-1, num_sd).sum(0)
    advice = "repeat the trial, or set pooled=True"
    _require_channels(freedom > 0, "at least 2 repeats of every channel", advice)
    square = contrast.square().nan_to_num(0.0).reshape(-1, num_sd).sum(0)
    advice = "measure with more digits, or declare the noise, GaussianNoise(sd)"
    _require_channels(square > 0, "repeats that differ", advice)
    if is_timed:
        noise = _autocorrelated(contrast, freedom, times)
    else:
        sd = InverseChiSquare(freedom, (square / freedom)[None])
        noise = GaussianNoise(_point(sd, 0), posterior=NoisePosterior(sd))
    return noise if times is None else noise.at(times)


def _groups(repeats: Array | Sequence[Array]) -> list[Tensor]:
    """Return groups (k, *x_shape) of at least two repeats with a measurement."""
    single = isinstance(repeats, Tensor | np.ndarray)
    groups = [torch.as_tensor(g).double() for g in ([repeats] if single else repeats)]
    groups = [g[:, None] if g.ndim == 1 else g for g in groups]
    shapes = [tuple(g.shape) for g in groups]
    is_one = len({shape[1:] for shape in shapes}) == 1 and len(shapes[0]) > 1
    expected = "repeats of shape (k, *x_shape), or groups of such"
    require(is_one, expected, shapes, "give a list of tensors of one x_shape")
    groups = [g[g.flatten(1).isfinite().any(1)] for g in groups]
    freedom = sum(max(len(g) - 1, 0) for g in groups)
    advice = "repeat a trial: without repeats nothing separates noise from the system"
    num = len(groups[0])
    require(freedom > 0, "at least 2 repeats of one action", num, advice)
    if freedom == 1:
        warn(
            "SA212 expected at least 3 repeats to estimate noise; got 2, from which "
            "the standard deviation is known to a factor of 30; repeat the trial again"
        )
    return [g for g in groups if len(g) > 1]


def _contrasts(group: Tensor, *, whole: bool) -> Tensor:
    r"""Return independent numbers of mean zero that have the noise's own covariance.

    Each repeat less the mean of those before, times :math:`\sqrt{k / (k + 1)}`, by
    Helmert; NaN where there is none.

    Args:
        group: Repeats, shape (n, *x_shape).
        whole: Whether a number that one repeat lacks counts in none of them, so that
            all numbers of a contrast have the same weights.
    """
    seen = ~group.isnan()
    if whole:
        seen = seen.all(0).expand(group.shape)
    values = torch.where(seen, group, 0.0)
    count = seen.double().cumsum(0) - 1
    off = values - (values.cumsum(0) - values) / count
    off = off * (count / (count + 1)).sqrt()
    return torch.where(seen & (count > 0), off, torch.nan)


def _require_channels(holds: Tensor, expected: str, advice: str) -> None:
    channels = torch.nonzero(~holds)[:, 0].tolist()
    require(not channels, expected, f"none in channels {channels}", advice)


def _autocorrelated(
    contrast: Tensor,
    freedom: Tensor,
    times: Tensor | None,
    *,
    cells: int = 96,
    shortest: float = 0.1,
    longest: float = 3.0,
    negligible: float = 1e-7,
) -> AutocorrelatedNoise:
    """Return noise by a grid of the correlation time.

    It has ``cells`` between ``shortest`` times the shortest step, below which no
    correlation could be seen, and ``longest`` times the recording. Cells at its ends of
    less than a ``negligible`` share of the largest weight are left out.
    """
    shape = contrast.shape
    expected = "x with a time axis of at least 3 samples"
    advice = "estimate kind='gaussian'"
    require(shape[1] > 2, expected, f"x of shape {tuple(shape[1:])}", advice)
    stamps = time_stamps(times, (1, shape[1]))[0]
    edges = torch.logspace(
        math.log10(shortest * float(stamps.diff().min())),
        math.log10(longest * float(stamps[-1] - stamps[0])),
        cells + 1,
        dtype=torch.float64,
    )
    squares, log_weight = [], []
    for tau in (edges[1:] * edges[:-1]).sqrt().tolist():
        u, log_variance = innovations(contrast, tau, times)
        square = u.square().nan_to_num(0.0).reshape(-1, len(freedom)).sum(0)
        squares.append(square)
        log_det = log_variance.nansum() + (freedom * square.log()).sum()
        log_weight.append(-0.5 * log_det)
    weight = torch.stack(log_weight)
    heavy = (weight > weight.max() + math.log(negligible)).nonzero()[:, 0]
    kept = slice(int(heavy[0]), int(heavy[-1]) + 1)
    shared = Cells(edges[kept.start : kept.stop + 1], weight[kept].log_softmax(0))
    sd = InverseChiSquare(freedom, torch.stack(squares)[kept] / freedom)
    cell, tau = shared.quantile(torch.tensor(0.5, dtype=torch.float64))
    posterior = NoisePosterior(sd, shared=shared)
    return AutocorrelatedNoise(_point(sd, int(cell)), tau, posterior=posterior)


def _point(sd: InverseChiSquare, cell: int) -> Tensor:
    """Return s of a cell, a number where all channels have one."""
    s = sd.variance[cell].sqrt()
    return s[0] if len(s) == 1 else s

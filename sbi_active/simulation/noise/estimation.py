"""The noise of a system from repeated measurements."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal, TypeVar

import numpy as np
import torch
from scipy.linalg import helmert
from torch import Tensor

from sbi_active.expected import require
from sbi_active.messages import warn
from sbi_active.simulation.noise.autocorrelated import (
    AutocorrelatedNoise,
    innovations,
    time_stamps,
)
from sbi_active.simulation.noise.base import NoiseModel
from sbi_active.simulation.noise.gaussian import GaussianNoise
from sbi_active.simulation.noise.posterior import (
    Cells,
    InverseChiSquare,
    NoisePosterior,
)

Kind = TypeVar("Kind", bound=NoiseModel)
NoiseKind = Literal["gaussian", "autocorrelated"]

Array = Tensor | np.ndarray


def estimate_noise(
    repeats: Array | Sequence[Array],
    *,
    kind: NoiseKind = "gaussian",
    times: Tensor | None = None,
    pooled: bool = False,
) -> NoiseModel:
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
    require(
        kind in ("gaussian", "autocorrelated"),
        "kind among 'gaussian', 'autocorrelated'",
        repr(kind),
        "choose one of these, or declare StudentTNoise(sd, df)",
    )
    groups = _groups(repeats)
    shape = groups[0].shape[1:]
    trajectory = kind == "autocorrelated" and len(shape) == 1
    num_sd = 1 if pooled or trajectory else shape[-1]
    if kind == "gaussian":
        noise = _gaussian(groups, num_sd)
    else:
        noise = _autocorrelated(groups, num_sd, times)
    return noise if times is None else noise.at(times)


def _groups(repeats: Array | Sequence[Array]) -> list[Tensor]:
    """Return groups (k, *x_shape) of at least two repeats with a measurement."""
    single = isinstance(repeats, Tensor | np.ndarray)
    groups = [torch.as_tensor(g).double() for g in ([repeats] if single else repeats)]
    groups = [g[:, None] if g.ndim == 1 else g for g in groups]
    if not groups or any(
        g.ndim < 2 or g.shape[1:] != groups[0].shape[1:] for g in groups
    ):
        raise ValueError(
            "expected repeats of shape (k, *x_shape), or groups of such; got "
            f"{[tuple(g.shape) for g in groups]}; give a list of tensors of one "
            "x_shape"
        )
    groups = [g[g.flatten(1).isfinite().any(1)] for g in groups]
    freedom = sum(max(len(g) - 1, 0) for g in groups)
    if freedom == 0:
        raise ValueError(
            f"expected at least 2 repeats of one action; got {len(groups[0])}; "
            "repeat a trial: without repeats nothing separates noise from the system"
        )
    if freedom == 1:
        warn(
            "SA212 expected at least 3 repeats to estimate noise; got 2, from which "
            "the standard deviation is known to a factor of 30; repeat the trial again"
        )
    return [g for g in groups if len(g) > 1]


def _gaussian(groups: list[Tensor], num_sd: int) -> GaussianNoise:
    square, freedom = _sums_of_squares(groups, num_sd)
    sd = InverseChiSquare(freedom, (square / freedom)[None])
    return _noise(GaussianNoise, sd)


def _sums_of_squares(groups: list[Tensor], num_sd: int) -> tuple[Tensor, Tensor]:
    """Return squares around the means of groups and their degrees of freedom."""
    square = torch.zeros(num_sd, dtype=torch.float64)
    freedom = torch.zeros(num_sd, dtype=torch.float64)
    for group in groups:
        deviation = (group - group.nanmean(0)).square().nansum(0)
        count = ((~group.isnan()).sum(0) - 1).clamp_min(0)
        square += deviation.reshape(-1, num_sd).sum(0)
        freedom += count.reshape(-1, num_sd).sum(0)
    _require_scatter(square, freedom)
    return square, freedom


def _require_scatter(square: Tensor, freedom: Tensor) -> None:
    if bool((freedom == 0).any()):
        raise ValueError(
            "expected at least 2 repeats of every channel; got none for channels "
            f"{torch.nonzero(freedom == 0)[:, 0].tolist()}; repeat the trial, or "
            "set pooled=True"
        )
    if bool((square <= 0).any()):
        raise ValueError(
            "expected repeats that differ; got identical ones in channels "
            f"{torch.nonzero(square <= 0)[:, 0].tolist()}; measure with more "
            "digits, or declare the noise, GaussianNoise(sd)"
        )


def _autocorrelated(
    groups: list[Tensor],
    num_sd: int,
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
    # Contrasts are independent, of mean zero, and have the noise's own covariance.
    # A number missing in one repeat is missing in all contrasts of its group.
    contrast = torch.cat(
        [
            (torch.from_numpy(helmert(len(g))) @ g.flatten(1)).reshape(-1, *g.shape[1:])
            for g in groups
        ]
    )
    if contrast.shape[1] < 3:
        raise ValueError(
            "expected x with a time axis of at least 3 samples; got x of shape "
            f"{tuple(contrast.shape[1:])}; estimate kind='gaussian'"
        )
    stamps = time_stamps(times, (1, contrast.shape[1]))[0]
    edges = torch.logspace(
        math.log10(shortest * float(stamps.diff().min())),
        math.log10(longest * float(stamps[-1] - stamps[0])),
        cells + 1,
        dtype=torch.float64,
    )
    freedom = (~contrast.isnan()).double().reshape(-1, num_sd).sum(0)
    squares, log_weight = [], []
    for tau in (edges[1:] * edges[:-1]).sqrt():
        square, log_factor = innovations(contrast, tau.expand(len(contrast)), times)
        square = square.reshape(-1, num_sd).sum(0)
        _require_scatter(square, freedom)
        squares.append(square)
        log_weight.append(
            -0.5 * log_factor.sum() - 0.5 * (freedom * square.log()).sum()
        )
    weight = torch.stack(log_weight)
    heavy = (weight > weight.max() + math.log(negligible)).nonzero()[:, 0]
    kept = slice(int(heavy[0]), int(heavy[-1]) + 1)
    shared = Cells(edges[kept.start : kept.stop + 1], weight[kept].log_softmax(0))
    sd = InverseChiSquare(freedom, torch.stack(squares)[kept] / freedom)
    return _noise(AutocorrelatedNoise, sd, shared)


def _noise(
    kind: Callable[..., Kind], sd: InverseChiSquare, shared: Cells | None = None
) -> Kind:
    """Return noise with a posterior, at s and the median of what channels share."""
    cell, values = torch.tensor(0), list[Tensor]()
    if shared is not None:
        cell, *values = shared.quantile(torch.tensor(0.5, dtype=torch.float64))
    middle = sd.middle(cell)
    middle = middle[0] if len(middle) == 1 else middle
    return kind(middle, *values, posterior=NoisePosterior(sd, shared=shared))

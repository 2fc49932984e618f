r"""Information gain of outcomes of many numbers, as if linear in the parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from sbi_active.design.estimators.base import (
    CandidateSimulations,
    InformationGainEstimator,
    numbers_of,
)
from sbi_active.simulation import NoiseModel
from sbi_active.simulation.noise.whitening import whitened


class LinearGain(InformationGainEstimator):
    r"""Gauss-Newton entropies: the outcome is regressed on the parameters.

    .. math::
        I(\theta; x | \xi) \approx \tfrac12 \log \left| I + \mathrm{Cov}(y) \right|
        - \tfrac12 \log \left| I + \mathrm{Cov}(y - J \theta) \right|, \qquad
        y = C^{-1/2} \mu(\theta, \xi)

    with the noise-free outcomes :math:`\mu` at draws from the belief, the covariance C
    of the declared noise, and J the regression of y on theta. Where the outcome is
    linear this is :math:`\tfrac12 \log |I + \Sigma J^\top J|`, exact for a Gaussian
    belief; where it is bent, what the plane leaves counts as noise, so that it is what
    a linear estimate of theta would learn.

    Other estimators cannot exceed the logarithm of the number of simulations; this one
    has no such end, and a signal that a robot plays for half a minute tells tens of
    nats from a few dozen simulations. They must be 12 or more than four times the
    parameters (and a search of a box takes as many for a twelfth of ``num_samples``).
    Contributions are the jackknife's, whose mean is free of the largest bias.

    For a subset S of the parameters J is the regression on these alone: what the others
    do counts as noise, whose covariance is that which the belief gives them.

    For heavy tails the standard deviation counts. The loss of an outcome, or of a part
    of it, counts as no information.

    Args:
        index: Places of the parameters S, or a function of parameters (n, d) whose
            numbers (n, k) stand for them; None are all.

    Raises:
        ValueError: If no parameter or one twice is named.

    References:
        Chaloner & Verdinelli, Statistical Science 10 (1995), 273-304 (Bayesian D-
        optimality); Saerkkae, Bayesian Filtering and Smoothing (2013), section 5
        (statistical linearization); Efron & Stein, Annals of Statistics 9 (1981).

    Example:
        >>> from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
        >>> from sbi_active import InformationGainDesigner
        >>> prior = torch.distributions.MultivariateNormal(torch.zeros(2), torch.eye(2))
        >>> grid = torch.linspace(0, 1, 500)
        >>> swing = lambda t, a: a * (t[:, :1] + t[:, 1:] * grid)
        >>> designer = InformationGainDesigner(
        ...     DiscreteActions([1.0, 10.0]), num_samples=400, estimator="linear")
        >>> simulator = SimulatorModel(swing, noise=GaussianNoise(0.1))
        >>> design = designer.select(None, simulator, belief=prior, seed=0)
        >>> float(design.action), round(float(design.expected_information_gain[1]))
        (10.0, 14)
    """

    needs_noise = True
    needs_model = False

    def __init__(
        self, index: Sequence[int] | Callable[[Tensor], Tensor] | None = None
    ) -> None:
        self.target = None if index is None else numbers_of(index)

    @override
    def remarks(
        self, simulations: CandidateSimulations, *, max_bent: float = 1.0
    ) -> list[str]:
        mean, noise = simulations.mean, simulations.noise
        if mean is None or noise is None:
            return []
        bent, theta = [], simulations.theta.double()
        for row in mean:
            y = _rows(noise, row)
            complete = y.isfinite().all(1)
            off = _off_plane(theta[complete])
            rest = off @ y[complete]
            bent.append(float((rest.square().sum() / off.trace() / y.shape[1]).sqrt()))
        worst = max(bent, default=0.0)
        if worst <= max_bent:
            return []
        return [
            f"outcomes are up to {worst:.1f} noise deviations off what is linear in "
            "the parameters, which counts as noise"
        ]

    @override
    def _contributions(
        self, model: Any, simulations: CandidateSimulations, belief: Any
    ) -> Tensor:
        mean, noise = simulations.mean, simulations.noise
        if mean is None or noise is None:
            raise ValueError(
                "expected declared noise for LinearGain; got replicates; build "
                "SimulatorModel(fn, noise=...) around a noise-free fn"
            )
        theta = simulations.theta
        theta = (theta if self.target is None else self.target(theta)).double()
        gain = torch.full(mean.shape[:2], torch.nan, dtype=torch.float64)
        for a, row in enumerate(mean):
            y = _rows(noise, row)
            complete = y.isfinite().all(1)
            # What is lost counts as knowing nothing.
            gain[a] = 0.0
            gain[a, complete] = _jackknife(theta[complete], y[complete])
        return gain


def _rows(noise: NoiseModel, mean: Tensor) -> Tensor:
    """Return outcomes in deviations of their noise, shape (n, N)."""
    each = getattr(noise, "each", None)
    if each is None:
        return whitened(noise, mean).flatten(1)
    joint = whitened(each, mean.flatten(0, 1))  # of several actions
    return joint.reshape(len(mean), -1)


def _jackknife(
    theta: Tensor, y: Tensor, *, num_groups: int = 24, spare: int = 3
) -> Tensor:
    """Return pseudovalues of the information, shape (n,).

    Args:
        theta: Parameters, shape (n, d).
        y: Outcomes in deviations of their noise, shape (n, N).
        num_groups: Number of groups, each left out in turn.
        spare: Number of simulations beyond those that a plane takes.
    """
    n, d = theta.shape
    groups = min(n, num_groups)
    fewest = d + 1 + spare
    if n - -(-n // groups) < fewest:
        raise ValueError(
            f"expected {fewest + 1} or more outcomes of an action at a time for "
            f"LinearGain of {d} parameters; got {n}; pass num_samples of "
            f"{4 * (fewest + 2)} or more for a list, {12 * (fewest + 2)} for a box"
        )
    gram = (y - y.mean(0)) @ (y - y.mean(0)).T
    whole = _information(theta, gram)
    group = torch.arange(n) % groups
    without = torch.stack(
        [
            _information(theta[group != g], gram[group != g][:, group != g])
            for g in range(groups)
        ]
    )
    return (groups * whole - (groups - 1) * without)[group]


def _information(theta: Tensor, gram: Tensor) -> Tensor:
    """Return the information by inner products of the outcomes (n, n)."""
    n, d = theta.shape
    center = torch.eye(n, dtype=gram.dtype) - 1 / n
    off = _off_plane(theta)
    one = torch.eye(n, dtype=gram.dtype)
    total = torch.linalg.slogdet(one + center @ gram @ center / (n - 1))[1]
    rest = torch.linalg.slogdet(one + off @ gram @ off / (n - 1 - d))[1]
    return 0.5 * (total - rest)


def _off_plane(theta: Tensor) -> Tensor:
    """Return the projection (n, n) on what no linear function of theta follows."""
    ones = torch.ones(len(theta), 1, dtype=theta.dtype)
    basis, values, _ = torch.linalg.svd(
        torch.cat([ones, (theta - theta.mean(0)) / theta.std(0).clamp(min=1e-300)], 1),
        full_matrices=False,
    )
    basis = basis[:, values > 1e-9 * values[0]]
    return torch.eye(len(theta), dtype=theta.dtype) - basis @ basis.T

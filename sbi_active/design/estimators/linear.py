r"""Information gain of outcomes of many numbers, as if linear in the parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from sbi_active.design.estimators.base import (
    CandidateSimulations,
    InformationGainEstimator,
)

NUM_GROUPS = 24  # of simulations, each left out in turn


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
        target: Function of parameters (n, d) that gives theta_S or numbers that stand
            for it, (n, k); None are all.
        max_bent: Deviations of the noise that outcomes may be off a plane without a
            word.

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
        self,
        target: Callable[[Tensor], Tensor] | None = None,
        *,
        max_bent: float = 1.0,
    ) -> None:
        self.target = target or (lambda theta: theta)
        self.max_bent = max_bent

    def suits(self, simulations: CandidateSimulations, num_rows: int) -> bool:
        """Return whether outcomes are complete and on a plane that so many tell."""
        dim, complete = simulations.theta.shape[1], bool(simulations.complete.all())
        enough = _smallest(num_rows) >= _fewest(dim)
        return complete and enough and not self.remarks(simulations)

    @override
    def remarks(self, simulations: CandidateSimulations) -> list[str]:
        mean, noise = simulations.mean, simulations.noise
        if mean is None or noise is None:
            return []
        bent, theta = [], simulations.theta.double()
        for row in mean:
            y = noise.whiten(row).flatten(1)
            complete = y.isfinite().all(1)
            rest, rank = _off_plane(theta[complete], y[complete])
            freedom = (len(rest) - 1 - rank) * y.shape[1]
            bent.append(float((rest.square().sum() / freedom).sqrt()))
        worst = max(bent, default=0.0)
        if worst <= self.max_bent:
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
                "expected declared noise for LinearGain; got replicates; declare it, "
                "SimulatorModel(fn, noise=...)"
            )
        theta = self.target(simulations.theta).double()
        gain = torch.zeros(mean.shape[:2]).double()  # what is lost tells nothing
        for a, row in enumerate(mean):
            y = noise.whiten(row).flatten(1)
            complete = y.isfinite().all(1)
            gain[a, complete] = _jackknife(theta[complete], y[complete])
        return gain


def _fewest(dim: int, *, spare: int = 3) -> int:
    """Return the simulations that a plane takes, and some to spare."""
    return dim + 1 + spare


def _smallest(num: int) -> int:
    """Return the simulations that are left without one of the groups."""
    return num - -(-num // min(num, NUM_GROUPS))


def _jackknife(theta: Tensor, y: Tensor) -> Tensor:
    """Return pseudovalues of the information, shape (n,).

    Args:
        theta: Parameters, shape (n, d).
        y: Outcomes in deviations of their noise, shape (n, N).
    """
    n, d = theta.shape
    groups, fewest = min(n, NUM_GROUPS), _fewest(d)
    if _smallest(n) < fewest:
        raise ValueError(
            f"expected {fewest + 1} or more outcomes of an action at a time for "
            f"LinearGain of {d} parameters; got {n}; pass num_samples of "
            f"{4 * (fewest + 2)} or more for a list, {12 * (fewest + 2)} for a box"
        )
    y = y - y.mean(0)
    if y.shape[1] > n:  # along the span of the outcomes
        y = torch.linalg.qr(y.T).R.T
    group = torch.arange(n) % groups
    whole = _information(theta, y)
    each = [
        _information(theta[kept], y[kept])
        for kept in group != torch.arange(groups)[:, None]
    ]
    return (groups * whole - (groups - 1) * torch.stack(each))[group]


def _information(theta: Tensor, y: Tensor) -> Tensor:
    """Return the information of outcomes (n, N) as if linear in theta (n, d), nats."""
    rest, _ = _off_plane(theta, y)
    n, d = theta.shape
    spread = torch.cov(y.T).reshape(y.shape[1], -1), rest.T @ rest / (n - 1 - d)
    one = torch.eye(y.shape[1], dtype=y.dtype)
    both = torch.linalg.slogdet(one + torch.stack(spread)).logabsdet
    return 0.5 * (both[0] - both[1])


def _off_plane(theta: Tensor, y: Tensor) -> tuple[Tensor, int]:
    """Return what of outcomes (n, N) no linear function of theta follows.

    Also returns the rank of the parameters (n, d).
    """
    apart, off = (theta - theta.mean(0)) / theta.std(0).clamp(min=1e-300), y - y.mean(0)
    basis, values, _ = torch.linalg.svd(apart, full_matrices=False)
    basis = basis[:, values > 1e-9 * values[0]]
    return off - basis @ (basis.T @ off), basis.shape[1]

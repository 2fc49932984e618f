"""The information about some of the parameters, the others being nuisances."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.information_gain.base import (
    Bound,
    CandidateSimulations,
    InformationGainEstimator,
    distinct,
)
from sbi_active.information_gain.fits.conditional_density import (
    conditional_members,
    log_normal,
)
from sbi_active.information_gain.fits.cross_fitting import (
    cross_fit,
    patterns_of_numbers,
)
from sbi_active.information_gain.fits.nearest_neighbors import nearest_neighbor_entropy
from sbi_active.seeding import forked_generators

NUM_MARGINAL = 20_000  # draws of the belief for the marginal of the target
NUM_NEIGHBORS = 4  # a choice: fewer vary more, more blur more
NUM_QUANTILES = 33  # a choice: knots of the curve through the ranks, 3 % apart
NEARLY_NORMAL = 0.02  # nats of divergence
FEW = 24  # outcomes of one pattern whose numbers are not used


class ParameterGain(InformationGainEstimator):
    r"""Barber-Agakov bound for a subset S of the parameters.

    .. math::
        I(\theta_S; x | \xi) \ge
        E \left[ \log q(u | x, \xi) - \log \phi(u) \right]
        - \mathrm{KL}\left( p(u) \,\|\, \phi \right), \qquad
        u_j = \Phi^{-1}(F_j(\theta_{S_j}))

    The other parameters are marginalized by drawing them with the rest. Information
    does not change under a monotone map of each parameter, here to about the standard
    normal :math:`\phi`. What p(u) still differs from it by, such as the dependence of
    several parameters in the belief, comes from the nearest-neighbor entropy of 20 000
    draws of the belief, which cost no simulations; its standard error, about .01 nat,
    is common to all candidates and not in theirs.

    q is a Gaussian around a regression or a Gaussian mixture, fitted for each candidate
    to three quarters of the simulations, the rest scored, in turn; which kind scores a
    quarter is chosen on the others. Invalid outcomes count: q conditions on which
    numbers of x are present.

    Args:
        index: Parameters S.
        names: Names of the parameters, for errors.

    Raises:
        ValueError: If no parameter or one twice is named.

    References:
        Barber & Agakov, NeurIPS 2003; Foster et al., NeurIPS 2019 (variational bounds
        of the expected information gain).
    """

    bound: Bound = "lower"
    needs_noise = False
    needs_model = False

    def __init__(self, index: Sequence[int]) -> None:
        self.index = distinct(index)

    def _contributions(
        self, model: Any, simulations: CandidateSimulations, belief: Distribution
    ) -> Tensor:
        with forked_generators(0, "marginal"):
            draws = belief.sample(torch.Size([NUM_MARGINAL]))[:, self.index].double()
        scores = [NormalScores(column) for column in draws.T]
        dependence = _dependence(_map(scores, draws))
        u = _map(scores, simulations.theta[:, self.index].double())
        shape = simulations.x.shape[:2]
        gain = torch.full(shape, torch.nan, dtype=torch.float64)
        for a, counted in enumerate(simulations.counted):
            x = simulations.x[a].flatten(1).double()
            for rows, columns in patterns_of_numbers(x, counted, FEW):
                if len(rows) < 8:  # no density to fit: nothing is learned
                    gain[a, rows] = -dependence
                    continue
                given = x[rows][:, columns]
                log_q = _score(u[rows], given)
                gain[a, rows] = log_q - log_normal(u[rows]) - dependence
        return gain


class NormalScores:
    r"""A smooth monotone map of one parameter to about the standard normal.

    It is linear where the parameter is close to normal, else :math:`\Phi^{-1}(F)` with
    a distribution function F that interpolates a few quantiles monotonically.

    Args:
        draws: Draws of the parameter, shape (m,).

    References:
        Fritsch & Carlson, SIAM Journal on Numerical Analysis 1980.
    """

    def __init__(self, draws: Tensor) -> None:
        self.center, self.scale = draws.mean(), draws.std().clamp_min(1e-30)
        self.curve: PchipInterpolator | None = None
        z = (draws - self.center) / self.scale
        self.edge = 0.5 / len(draws)
        if _dependence(z[:, None]) < NEARLY_NORMAL:
            return
        share = torch.linspace(0, 1, NUM_QUANTILES).double()
        quantile, first = np.unique(z.quantile(share).numpy(), return_index=True)
        if len(quantile) > 2:
            self.curve = PchipInterpolator(quantile, share.numpy()[first])

    def __call__(self, theta: Tensor) -> Tensor:
        """Return the scores of parameters, shape (n,)."""
        z = (theta - self.center) / self.scale
        if self.curve is None:
            return z
        low, high = self.curve.x[0], self.curve.x[-1]
        share = torch.from_numpy(self.curve(z.clamp(low, high).numpy()))
        return torch.special.ndtri(share.clamp(self.edge, 1 - self.edge))


def _map(scores: list[NormalScores], theta: Tensor) -> Tensor:
    return torch.stack([f(t) for f, t in zip(scores, theta.T, strict=True)], 1)


def _score(u: Tensor, x: Tensor) -> Tensor:
    def score(train: Tensor, test: Tensor) -> Tensor:
        members = conditional_members(u[train], x[train])
        log_q = [log_normal(u[test])]
        log_q += [member(u[test], x[test]) for member in members]
        return torch.stack(log_q)

    return cross_fit(score, torch.arange(len(u)), torch.ones(len(u)))


def _dependence(u: Tensor) -> float:
    """Divergence of p(u) from the standard normal, nats, from draws (m, s)."""
    entropy = float(nearest_neighbor_entropy(u, NUM_NEIGHBORS).mean())
    return max(0.0, -float(log_normal(u).mean()) - entropy)

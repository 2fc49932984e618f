"""Information gain as a difference of entropies, from nearest neighbors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from scipy.spatial import KDTree
from scipy.special import digamma
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from sbi_active.design.estimators.base import (
    CandidateSimulations,
    InformationGainEstimator,
    at_least,
    noise_scale,
    whitening,
)
from sbi_active.seeding import forked_generators


class EntropyGain(InformationGainEstimator):
    r"""Entropy of the outcome less that of its noise.

    .. math::
        I(\theta; x | \xi) = H(x | \xi) - E_{\theta}\, H(x | \theta, \xi), \qquad
        \hat H(x) = \frac1n \sum_i \psi(n) - \psi(k) + \log V_d
        + d \log \rho_{k}(i) + \log \det L

    with :math:`\rho_k(i)` the distance from the whitened :math:`L^{-1} x_i` to its k-th
    neighbour and :math:`V_d` the volume of the unit ball (Kozachenko-Leonenko). No
    network, so nothing saturates; the error grows with the dimension of x, which
    should be at most three.

    The second entropy is that of the declared noise at the noise-free outcome. Without
    a declaration it is that of a Gaussian of one covariance, fitted to pairs of
    outcomes at the same theta; :func:`.problems_of_noise` tests normality, which noise
    that varies with theta fails as well.

    Where outcomes lack numbers,

    .. math::
        I(\theta; x) \ge I(\theta; v) + P(\text{complete})\,
        I(\theta; x \mid \text{complete}),

    with v what is present, see
    :func:`.presence_information`; equal where
    outcomes are complete or empty, as only the numbers of partly observed ones are left
    out. Given completeness, theta follows the belief conditioned on it, and the noise
    is taken to be what it is without.

    Args:
        num_neighbors: k; more have less variance and more bias at edges.

    References:
        Kozachenko & Leonenko, Problems of Information Transmission 1987; Kraskov,
        Stogbauer & Grassberger, Physical Review E 2004.
    """

    needs_noise = True
    needs_model = False
    fewest = 20

    def __init__(self, *, num_neighbors: int = 4) -> None:
        self.num_neighbors = at_least(num_neighbors, 1, "num_neighbors", 4)

    def _contributions(
        self, model: Any, simulations: CandidateSimulations, belief: Distribution
    ) -> Tensor:
        gain = presence_information(simulations)
        entropy, surprise = conditional_entropy(simulations)
        outcomes = simulations.outcomes()
        for x in outcomes:
            complete = x.flatten(2).isfinite().all(-1) & simulations.counted
            for a, rows in enumerate(complete):
                few = int(rows.sum()) <= max(self.num_neighbors, x[a, 0].numel())
                if few or bool(entropy[a, rows].isnan().any()):
                    continue  # too few measurements: what is present still counts
                own = x[a, rows].flatten(1).double()
                told = nearest_neighbor_entropy(own, self.num_neighbors)
                noise = entropy[a, rows]
                told = with_control(told - noise, surprise[a, rows] - noise)
                gain[a, rows] += told / len(outcomes)
        return gain

    @override
    def remarks(self, simulations: CandidateSimulations) -> list[str]:
        return presence_notes(simulations)

    @override
    def problems(self, simulations: CandidateSimulations) -> list[str]:
        return problems_of_noise(simulations) + self.steps(simulations)

    def steps(
        self, simulations: CandidateSimulations, *, most: float = 0.1, few: float = 3
    ) -> list[str]:
        """Say whether outcomes are on steps, each of too few of them.

        The neighbors of one lie on other steps then, and what is between counts as
        filled: of a hundred steps the gain was up to 1.7 nats too large.

        Args:
            simulations: Simulations to look at; nothing is said without declared noise.
            most: Share of an action's outcomes that may be on such steps.
            few: Outcomes of a step, in those of the neighbors, that are too few: an
                estimate rests on half of the simulations.
        """
        if simulations.mean is None:
            return []
        white = simulations.mean.flatten(2).double() / noise_scale(simulations)[:, None]
        worst, weight = 0.0, torch.arange(1, white.shape[2] + 1).double().sqrt()
        for own, rows in zip(white, simulations.complete, strict=True):
            # One number is the same where outcomes are, and sorted soon.
            one = (own[rows] @ weight).numpy()
            _, first, size = np.unique(one, return_index=True, return_counts=True)
            few_each = (size > 1) & (size <= few * self.num_neighbors)
            share = size[few_each].sum() / max(len(one), 1)
            if share > worst:
                step = own[rows][first]
                apart = torch.cdist(step, step).fill_diagonal_(torch.inf).amin(1)
                # else they are the same but for a rounding error
                worst = share if float(apart.median()) > 1 else worst
        if worst <= most:
            return []
        return [
            f"{worst:.0%} of an action's outcomes are on steps, so few on each that "
            "estimates are too high"
        ]


def conditional_entropy(
    simulations: CandidateSimulations, *, num_draws: int = 16
) -> tuple[Tensor, Tensor]:
    r"""Return the noise's entropy and surprise, :math:`-\log p(x_i | \theta_i)`.

    Without declared noise both are the entropy, :math:`H(x | \theta_i)`, with what the
    pair i adds to its estimate; NaN where pairs are too few. Both have shape (a, n), in
    nats, and a meaning where outcomes are complete. ``num_draws`` are those of declared
    noise.
    """
    mean, noise = simulations.mean, simulations.noise
    if mean is None or noise is None:
        complete, (factor, white) = simulations.complete, pair_noise(simulations)
        q = white.shape[2]
        entropy = factor.diagonal(dim1=1, dim2=2).log().sum(1)
        entropy = (entropy + 0.5 * q * (math.log(2 * math.pi) + 1))[:, None]
        # the noise is estimated: of mean zero, so that errors include it
        influence = torch.where(complete, 0.5 * (white.square().sum(2) - q), 0.0)
        share = simulations.completeness.mean(1) / complete.double().mean(1)
        entropy = entropy + share[:, None] * influence
        entropy[complete.sum(1) <= q + 1] = torch.nan
        return entropy, entropy
    mean = mean.flatten(0, 1).double()
    surprise = -noise.log_prob(simulations.x.flatten(0, 1), mean)
    entropy = torch.zeros(len(mean), dtype=torch.float64)
    with forked_generators(0):
        for _ in range(num_draws):
            entropy -= noise.log_prob(noise.sample(mean), mean) / num_draws
    shape = simulations.x.shape[:2]
    return entropy.reshape(shape), surprise.reshape(shape)


def pair_noise(simulations: CandidateSimulations) -> tuple[Tensor, Tensor]:
    r"""Fit Gaussian noise of one covariance a candidate to its complete pairs.

    .. math::
        S = \frac{1}{2n} \sum_i (x_i - x_i') (x_i - x_i')^\top = L L^\top

    Returns L, shape (a, q, q), and the pairs' differences in its units, (a, n, q), zero
    where they are incomplete.
    """
    assert simulations.replicate is not None
    x, again = (part.flatten(2).double() for part in simulations.outcomes())
    complete = simulations.complete
    difference = torch.where(complete[..., None], (x - again) / 2**0.5, 0.0)
    share = complete.sum(1).clamp_min(1)[:, None, None]
    rounding = torch.finfo(torch.float32).eps * x.abs().nan_to_num().amax(1)
    floor = torch.diag_embed(rounding.square() + 1e-300)
    factor = torch.linalg.cholesky(difference.mT @ difference / share + floor)
    white = torch.linalg.solve_triangular(factor, difference.mT, upper=False).mT
    return factor, white


def with_control(gain: Tensor, excess: Tensor) -> Tensor:
    """Return contributions (n,) less their regression on an excess (n,) of mean zero.

    The excess is the surprise of the noise less its entropy.
    """
    variance = excess.var()
    if len(gain) < 10 or not float(variance) > 1e-12:
        return gain
    covariance = ((gain - gain.mean()) * (excess - excess.mean())).mean()
    return gain - covariance / variance * excess


def nearest_neighbor_entropy(
    x: Tensor, num_neighbors: int, *, shared: float = 0.27
) -> Tensor:
    """Return each outcome's contribution to the entropy, (n, d) -> (n,), nats.

    Args:
        x: Outcomes.
        num_neighbors: Number of the neighbor whose distance counts.
        shared: Share of the jackknife's estimate of an outcome's effect on its
            neighbors. All of it is too much, as distances are not smooth in the
            outcomes; with .27 the variance of the mean was right for uniform outcomes,
            one to three dimensions, k = 1 to 10.
    """
    n, d = x.shape
    center, white = whitening(x)
    z = (x - center) @ white
    tree = KDTree(z.numpy())
    k = min(num_neighbors + 1, n - 1)
    found, index = tree.query(z.numpy(), k=k + 1)
    # outcomes are float32: no two are closer than their rounding
    rounding = torch.finfo(torch.float32).eps
    floor = rounding * float((x.abs().amax(0) / x.std(0).clamp_min(1e-30)).max())
    log_distance = d * torch.from_numpy(found).clamp_min(floor + 1e-300).log()
    log_ball = 0.5 * d * math.log(math.pi) - math.lgamma(0.5 * d + 1)
    log_det = -torch.linalg.slogdet(white).logabsdet
    constant = float(digamma(n) - digamma(num_neighbors)) + log_ball + log_det
    # a row shortens the distances of those that it is a neighbor of, an error that they
    # share: the balls around them would be larger without it
    larger = (log_distance[:, k] - log_distance[:, num_neighbors])[:, None]
    neighbor = torch.from_numpy(index)[:, 1 : num_neighbors + 1]
    effect = torch.zeros(n, dtype=torch.float64).index_add(
        0, neighbor.flatten(), larger.expand(neighbor.shape).flatten()
    )
    own = shared * (effect - effect.mean())
    return constant + log_distance[:, num_neighbors] - own


def presence_information(simulations: CandidateSimulations) -> Tensor:
    r"""Return contributions to what the presence of numbers tells, (a, n), nats.

    With v the pattern of NaN in x, a function of theta as it is of a noise-free
    simulator with declared noise, :math:`I(\theta; v) = H(v)`, from shares. Nothing is
    counted where replicates show v to be random, see :func:`problems_of_noise`.
    """
    present, counted = simulations.x.flatten(2).isfinite(), simulations.counted
    gain = torch.zeros(counted.shape, dtype=torch.float64)
    incomplete = (counted & (simulations.completeness < 1)).any(1)
    certain = ~random_presence(simulations)
    for a in torch.nonzero(incomplete & certain)[:, 0].tolist():
        rows = counted[a]
        _, label, count = torch.unique(
            present[a, rows], dim=0, return_inverse=True, return_counts=True
        )
        gain[a, rows] = -(count.double() / count.sum()).log()[label]
    return gain


def random_presence(simulations: CandidateSimulations) -> Tensor:
    """Return a mask of candidates whose outcomes differ in what is present, (a,).

    They differ from their replicates, or from what is without noise.
    """
    again = simulations.replicate
    again = simulations.mean if again is None else again
    assert again is not None
    differs = simulations.x.isfinite() != again.isfinite()
    return (differs.flatten(2).any(2) & simulations.counted).any(1)


def problems_of_noise(
    simulations: CandidateSimulations,
    *,
    few: int = EntropyGain.fewest,
    max_partly: float = 0.1,
    significant: float = 4.0,
    max_kurtosis: float = 0.3,
) -> list[str]:
    r"""Say what speaks against entropies of the noise, declared or of pairs.

    That is what of incomplete outcomes would not count, which leaves a lower bound, and
    undeclared noise that is not Gaussian: standardized differences of pairs have an
    excess kurtosis of zero then, with a standard error of :math:`\sqrt{24 / n}`.

    Args:
        simulations: Simulations to look at.
        few: Complete outcomes that are too few.
        max_partly: Share of partly observed outcomes that is negligible.
        significant: Number of standard errors of a kurtosis that is significant.
        max_kurtosis: Excess below which the error of the entropy is negligible.
    """
    complete, problems = simulations.complete, []
    if int(complete.sum(1).max()) < few:
        return [f"fewer than {few} complete outcomes a candidate"]
    if bool(random_presence(simulations).any()):
        problems.append(
            "whether there is a measurement is random given the parameters, which does "
            "not count"
        )
    share = float(simulations.partly_observed.double().mean())
    if share > max_partly:
        problems.append(
            f"{share:.0%} of the outcomes are partly observed, their numbers not used"
        )
    if simulations.noise is None and simulations.replicate is not None:
        enough = complete.sum(1, keepdim=True) >= few
        z = pair_noise(simulations)[1][complete & enough].flatten()
        excess = float((z**4).mean() / (z**2).mean() ** 2 - 3)
        if abs(excess) > max(significant * (24 / len(z)) ** 0.5, max_kurtosis):
            problems.append(
                f"noise is not Gaussian, excess kurtosis of pairs {excess:.1f}"
            )
    return problems


def presence_notes(simulations: CandidateSimulations) -> list[str]:
    """Return a note where some outcomes are partly observed; empty if none is."""
    partly = simulations.partly_observed
    if not bool(partly.any()):
        return []
    return [
        f"up to {float(partly.double().mean(1).max()):.0%} of an action's outcomes "
        "are partly observed: their numbers are not used, only which are present"
    ]

"""What the mere presence of a measurement tells about the parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from sbi_active.design.estimators.base import CandidateSimulations
from sbi_active.design.estimators.densities import cross_fit, held_out
from sbi_active.design.estimators.emulator import MeanEmulator, kernel, whitening

Ridges = tuple[float, ...]
RIDGES: Ridges = (0.1, 3.0, 100.0)


def presence_information(simulations: CandidateSimulations) -> Tensor:
    r"""Return contributions to what the presence of numbers tells, (a, n), nats.

    With v the pattern of NaN in x. Where v is a function of theta, as it is of a
    noise-free simulator with declared noise, :math:`I(\theta; v) = H(v)`, from shares.
    Where replicates show v to be random,

    .. math::
        I(\theta; v) \ge E \left[ \log q(v | \theta) - \log p(v) \right],

    with q a cross-fitted classifier. It is a lower bound for any q; the slack is the
    held-out divergence of q from :math:`p(v | \theta)`.
    """
    patterns = _patterns(simulations)
    counted = simulations.counted
    gain = torch.zeros(counted.shape, dtype=torch.float64)
    random = random_presence(simulations)
    incomplete = (counted & (simulations.completeness < 1)).any(1)
    for a in torch.nonzero(incomplete & ~random)[:, 0].tolist():
        rows = counted[a]
        gain[a, rows] = -_log_share(patterns[a, 0, rows])
    index = torch.nonzero(random)[:, 0]
    if len(index):
        gain[index] = _classified(
            simulations.theta.double(), patterns[index], counted[index]
        )
    return gain


def random_presence(simulations: CandidateSimulations) -> Tensor:
    """Return a mask of candidates whose outcomes differ in what is present, (a,)."""
    first, second = _patterns(simulations).unbind(1)
    return ((first != second) & simulations.counted).any(1)


def presence_problems(
    simulations: CandidateSimulations, *, max_partly: float = 0.1
) -> list[str]:
    """Say whether too many outcomes are partly observed to leave out their numbers."""
    share = float(simulations.partly_observed.double().mean())
    if share <= max_partly:
        return []
    return [f"{share:.0%} of the outcomes are partly observed, their numbers not used"]


def presence_notes(simulations: CandidateSimulations) -> list[str]:
    """Return notes where incomplete outcomes make the estimate a bound."""
    notes = []
    random = int(random_presence(simulations).sum())
    if random:
        notes.append(
            "whether there is a measurement is random given the parameters at "
            f"{random} of {len(simulations.action)} actions: what it tells is a lower "
            "bound by held-out classification"
        )
    partly = simulations.partly_observed
    if bool(partly.any()):
        notes.append(
            f"up to {float(partly.double().mean(1).max()):.0%} of an action's outcomes "
            "are partly observed: their numbers are not used, only which are present"
        )
    return notes


@dataclass(frozen=True)
class Completeness:
    """Probability of a complete outcome of one candidate, by the parameters.

    Attributes:
        share: Share of a row's outcomes that are complete, shape (n,).
        counted: Rows that are not missing, shape (n,).
        smooth: Log probability as a function of the parameters, where it is random.
    """

    share: Tensor
    counted: Tensor
    smooth: Callable[[Tensor], Tensor] | None

    @property
    def log_probability(self) -> Tensor:
        """Log of the share of complete outcomes."""
        return self.share[self.counted].mean().log()

    def __call__(self, z: Tensor, emulator: MeanEmulator) -> Tensor:
        """Return the log probability at coordinates, shape (k,)."""
        if self.smooth is not None:
            return self.smooth(emulator.parameters(z))
        if bool((self.share[self.counted] == 1).all()):
            return torch.zeros(len(z), dtype=z.dtype)
        nearest = torch.cdist(z, emulator.knots[self.counted]).argmin(1)
        return self.share[self.counted][nearest].log()


def completeness(simulations: CandidateSimulations) -> list[Completeness]:
    """Return the completeness of each candidate's outcomes."""
    theta = simulations.theta.double()
    num = len(simulations.outcomes())
    random = random_presence(simulations).tolist()
    both = zip(simulations.completeness, simulations.counted, random, strict=True)
    return [
        Completeness(
            share,
            counted,
            probability(theta, num * share, num * counted.double()) if lucky else None,
        )
        for share, counted, lucky in both
    ]


def _patterns(simulations: CandidateSimulations) -> Tensor:
    """Number the patterns of NaN of each outcome and its twin, shape (a, 2, n)."""
    again = simulations.replicate
    again = simulations.mean if again is None else again
    assert again is not None
    present = torch.stack(
        [part.flatten(2).isfinite() for part in (simulations.x, again)], 1
    )
    if bool(present.all()):
        return torch.zeros(present.shape[:3]).long()
    flat = present.flatten(0, 2)
    return torch.unique(flat, dim=0, return_inverse=True)[1].reshape(present.shape[:3])


def _classified(theta: Tensor, patterns: Tensor, counted: Tensor) -> Tensor:
    """Return contributions of random patterns, one class split off after the other."""
    label = torch.stack(
        [_by_share(p, c) for p, c in zip(patterns, counted, strict=True)]
    )
    weight, rows = counted[:, None].double(), torch.arange(len(theta))
    gain = torch.zeros(counted.shape, dtype=torch.float64)
    for k in range(int(label.max())):  # is it class k, given that it is none before
        hits = (weight * (label == k)).sum(1)
        misses = (weight * (label > k)).sum(1)
        share = hits.sum(1) / (hits + misses).sum(1).clamp_min(1)
        share = share[:, None].clamp(1e-12, 1 - 1e-12)
        baseline = hits * share.log() + misses * (1 - share).log()
        for row, h, m in zip(gain, hits, misses, strict=True):
            row += cross_fit(_scoring(theta, h, h + m), rows, torch.ones(len(rows)))
        gain -= baseline
    return gain / patterns.shape[1]


def _by_share(pattern: Tensor, counted: Tensor, most: int = 6) -> Tensor:
    """Relabel by falling share, the rarest beyond so many pooled, shape (2, n)."""
    values, count = torch.unique(pattern[:, counted], return_counts=True)
    label = torch.full(pattern.shape, min(len(values), most) - 1)
    for new, old in enumerate(count.argsort(descending=True)[: most - 1]):
        label[pattern == values[old]] = new
    return label


def _log_share(label: Tensor) -> Tensor:
    """Log share of each row's label, shape (n,)."""
    _, inverse, count = torch.unique(label, return_inverse=True, return_counts=True)
    return (count.double() / len(label)).log()[inverse]


def _scoring(
    theta: Tensor, hits: Tensor, total: Tensor, ridges: Ridges = RIDGES
) -> Callable[[Tensor, Tensor], Tensor]:
    """Return how logistic regressions with each ridge score hits (n,) among so many."""
    phi = features_of(theta)(theta)

    def score(train: Tensor, test: Tensor) -> Tensor:
        known = phi[train], hits[train], total[train]
        logit = torch.stack([fit_logistic(*known, r) for r in ridges]) @ phi[test].T
        misses = total[test] - hits[test]
        return hits[test] * logsigmoid(logit) + misses * logsigmoid(-logit)

    return score


def probability(
    theta: Tensor, hits: Tensor, total: Tensor, ridges: Ridges = RIDGES
) -> Callable[[Tensor], Tensor]:
    """Return a smooth log probability, of parameters (k, d) -> (k,).

    It is fitted to hits (n,) among so many outcomes (n,) at parameters (n, d).

    Args:
        theta: Parameters.
        hits: Number of outcomes of a kind at each.
        total: Number of outcomes at each.
        ridges: Precisions of the coefficients' prior, chosen by rows outside a fold.
    """
    scores = held_out(_scoring(theta, hits, total, ridges), torch.arange(len(theta)))
    ridge, features = ridges[int(scores.sum(1).argmax())], features_of(theta)
    coefficient = fit_logistic(features(theta), hits, total, ridge)
    return lambda new: logsigmoid(features(new) @ coefficient)


def features_of(theta: Tensor, num_knots: int = 12) -> Callable[[Tensor], Tensor]:
    """Return quadratic and some radial features of parameters, (k, d) -> (k, p)."""
    center, transform = whitening(theta)
    knots = (theta[:num_knots] - center) @ transform

    def features(theta: Tensor) -> Tensor:
        z = (theta - center) @ transform
        i, j = torch.triu_indices(z.shape[1], z.shape[1])
        one = torch.ones(len(z), 1, dtype=z.dtype)
        return torch.cat([one, z, z[:, i] * z[:, j], kernel(z, knots)], 1)

    return features


def fit_logistic(
    phi: Tensor,
    hits: Tensor,
    total: Tensor,
    ridge: float,
    *,
    num_steps: int = 25,
    max_move: float = 4.0,
) -> Tensor:
    r"""Return the penalized maximum of the binomial likelihood, (p,), by Newton.

    .. math::
        \sum_i h_i \log \sigma(\beta^\top \phi_i)
        + (t_i - h_i) \log \sigma(-\beta^\top \phi_i)
        - \tfrac\lambda2 \sum_{j > 0} \beta_j^2

    with features phi (n, p), the first a one, and hits h (n,) among t. A logit moves by
    ``max_move`` at most in a step, lest separable labels run away.

    References:
        Bishop, Pattern Recognition and Machine Learning, 2006, section 4.3.3.
    """
    penalty = torch.full((phi.shape[1],), ridge, dtype=phi.dtype)
    penalty[0] = 1e-3  # a label that never occurs has no maximum without it
    coefficient = torch.zeros_like(penalty)
    for _ in range(num_steps):
        mean = (phi @ coefficient).sigmoid()
        gradient = (hits - total * mean) @ phi - penalty * coefficient
        curvature = total * (mean * (1 - mean)).clamp_min(1e-9)
        hessian = (phi.T * curvature) @ phi + torch.diag(penalty)
        step = torch.linalg.solve(hessian, gradient)
        move = float((phi @ step).abs().max())
        coefficient = coefficient + step * (max_move / max(move, max_move))
        if move < 1e-6:
            break
    return coefficient

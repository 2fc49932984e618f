"""Information about the parameters in the mere presence of a measurement."""

from __future__ import annotations

import torch
from torch import Tensor

from sbi_active.information_gain.base import CandidateSimulations
from sbi_active.information_gain.fits.classification import cross_fitted

MAX_PARTLY = 0.1  # share of partly observed outcomes
MAX_PATTERNS = 6  # of a random presence; rarer ones are one pattern


def presence_information(simulations: CandidateSimulations) -> Tensor:
    r"""Return contributions to what the presence of numbers tells, (a, n), nats.

    With v the pattern of NaN in x. Where v is a function of theta, as it is of a
    noise-free simulator with declared noise, :math:`I(\theta; v) = H(v)`, from shares.
    Where replicates show v to be random,

    .. math::
        I(\theta; v) \ge E \left[ \log q(v | \theta, v') - \log p(v) \right],

    with q a cross-fitted classifier and v' the replicate's pattern, which given theta
    is independent of v. It is a lower bound for any q, at least as tight as
    :math:`I(v'; v)` for a q that learned it; the slack is the held-out divergence of q
    from :math:`p(v | \theta)`.
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


def presence_problems(simulations: CandidateSimulations) -> list[str]:
    """Say whether too many outcomes are partly observed to leave out their numbers."""
    share = float(simulations.partly_observed.double().mean())
    if share <= MAX_PARTLY:
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
    """Contributions of random patterns, one class split off after the other."""
    label = torch.stack(
        [_by_share(p, c) for p, c in zip(patterns, counted, strict=True)]
    )
    weight = counted[:, None].expand(label.shape).double()
    num = int(label.max()) + 1
    other = torch.nn.functional.one_hot(label.flip(1), num).double()[..., 1:]
    gain = torch.zeros(label.shape, dtype=torch.float64)
    for k in range(num - 1):  # is it class k, given that it is none before
        at_risk = weight * (label >= k)
        hit = (label == k).double()
        share = (hit * at_risk).sum((1, 2)) / at_risk.sum((1, 2)).clamp_min(1)
        share = share[:, None, None].clamp(1e-12, 1 - 1e-12)
        log_p = torch.where(hit > 0, share.log(), (1 - share).log())
        log_q = cross_fitted(theta, hit, other, at_risk)[0]
        gain += torch.where(at_risk > 0, log_q - log_p, 0.0)
    return gain.mean(1)


def _by_share(pattern: Tensor, counted: Tensor) -> Tensor:
    """Relabel by falling share, the rarest pooled, shape (2, n)."""
    values, count = torch.unique(pattern[:, counted], return_counts=True)
    label = torch.full(pattern.shape, min(len(values), MAX_PATTERNS) - 1)
    for new, old in enumerate(count.argsort(descending=True)[: MAX_PATTERNS - 1]):
        label[pattern == values[old]] = new
    return label


def _log_share(label: Tensor) -> Tensor:
    """Log share of each row's label, shape (n,)."""
    _, inverse, count = torch.unique(label, return_inverse=True, return_counts=True)
    return (count.double() / len(label)).log()[inverse]

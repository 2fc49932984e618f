"""What the mere presence of a measurement tells about the parameters."""

from __future__ import annotations

import torch
from torch import Tensor

from sbi_active.design.estimators.base import CandidateSimulations


def presence_information(simulations: CandidateSimulations) -> Tensor:
    r"""Return contributions to what the presence of numbers tells, (a, n), nats.

    With v the pattern of NaN in x, a function of theta as it is of a noise-free
    simulator with declared noise, :math:`I(\theta; v) = H(v)`, from shares. Nothing is
    counted where replicates show v to be random, see :func:`presence_problems`.
    """
    patterns, counted = _patterns(simulations), simulations.counted
    gain = torch.zeros(counted.shape, dtype=torch.float64)
    incomplete = (counted & (simulations.completeness < 1)).any(1)
    random = _random_presence(simulations)
    for a in torch.nonzero(incomplete & ~random)[:, 0].tolist():
        _, label, count = torch.unique(
            patterns[a, 0, counted[a]], return_inverse=True, return_counts=True
        )
        gain[a, counted[a]] = -(count.double() / count.sum()).log()[label]
    return gain


def has_random_presence(simulations: CandidateSimulations) -> bool:
    """Return whether outcomes at the same parameters differ in what is present."""
    return bool(_random_presence(simulations).any())


def presence_problems(
    simulations: CandidateSimulations, *, max_partly: float = 0.1
) -> list[str]:
    """Say what of incomplete outcomes would not count."""
    problems = []
    if has_random_presence(simulations):
        problems.append("whether there is a measurement is random given the parameters")
    share = float(simulations.partly_observed.double().mean())
    if share > max_partly:
        problems.append(
            f"{share:.0%} of the outcomes are partly observed, their numbers not used"
        )
    return problems


def presence_notes(simulations: CandidateSimulations) -> list[str]:
    """Return notes where incomplete outcomes make the estimate a bound."""
    notes = []
    if has_random_presence(simulations):
        notes.append(
            "whether there is a measurement is random given the parameters: what it "
            "tells is not counted, a lower bound"
        )
    partly = simulations.partly_observed
    if bool(partly.any()):
        notes.append(
            f"up to {float(partly.double().mean(1).max()):.0%} of an action's outcomes "
            "are partly observed: their numbers are not used, only which are present"
        )
    return notes


def _random_presence(simulations: CandidateSimulations) -> Tensor:
    """Return a mask of candidates whose outcomes differ in what is present, (a,)."""
    first, second = _patterns(simulations).unbind(1)
    return ((first != second) & simulations.counted).any(1)


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

"""What the mere presence of a measurement tells about the parameters."""

from __future__ import annotations

import torch
from torch import Tensor

from sbi_active.information_gain.base import CandidateSimulations

__all__ = ["presence_information"]


def presence_information(simulations: CandidateSimulations) -> Tensor:
    r"""Return contributions to the information in which numbers of x are present.

    With v the pattern of NaN in x and v' that of an independent outcome at the same
    parameters,

    .. math::
        I(\theta; v) \ge I(v'; v)
        = E \log \frac{p(v, v')}{p(v)\, p(v')},

    by the data processing inequality, with equality where v is a function of theta, as
    it is of a noise-free simulator with declared noise. Shares estimate probabilities.

    Args:
        simulations: With replicates or noise-free outcomes.

    Returns:
        Shape (a, n), nats; zero where nothing is missing.
    """
    again = simulations.replicate
    again = simulations.mean if again is None else again
    assert again is not None
    gain = torch.zeros(simulations.x.shape[:2], dtype=torch.float64)
    present = simulations.x.flatten(2).isfinite(), again.flatten(2).isfinite()
    for a in torch.nonzero(~simulations.complete.all(1))[:, 0].tolist():
        labels = torch.unique(
            torch.cat([p[a] for p in present]), dim=0, return_inverse=True
        )[1]
        first, second = labels.chunk(2)
        joint = first * (int(labels.max()) + 1) + second
        gain[a] = _log_share(joint) - _log_share(first) - _log_share(second)
    return gain


def _log_share(label: Tensor) -> Tensor:
    """Log share of each row's label, shape (n,)."""
    _, inverse, count = torch.unique(label, return_inverse=True, return_counts=True)
    return (count.double() / len(label)).log()[inverse]

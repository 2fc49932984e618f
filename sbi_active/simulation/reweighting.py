"""Old simulations for a new belief: importance weights over the rows of a bank."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.expected import require
from sbi_active.messages import warn
from sbi_active.simulation.bank.bank import Bank
from sbi_active.simulation.outcomes import Outcome, Simulations
from sbi_active.support import log_density

#: Below it an average over the rows has a standard error above a tenth of an sd.
FEW = 100


@dataclass(frozen=True)
class ReusedRows:
    r"""Rows of a bank, weighted for a target.

    Attributes:
        bank: Bank that has the rows.
        rows: Positions of the rows, shape (k,), int64.
        weights: Weights that sum to one, shape (k,), float64.
    """

    bank: Bank
    rows: Tensor
    weights: Tensor

    @property
    def effective_sample_size(self) -> float:
        r"""Kish's effective sample size, :math:`(\sum w)^2 / \sum w^2`."""
        return float(self.weights.sum() ** 2 / (self.weights**2).sum())

    def __len__(self) -> int:
        return len(self.rows)

    def simulations(self) -> Simulations:
        """Return the rows, in the order of the weights."""
        return self.bank.read(self.rows)


def reuse(bank: Bank, target: Distribution) -> ReusedRows:
    r"""Weight the rows of a bank so that their theta is distributed as a target.

    With the density of each row's own proposal, as it was noted in the bank,

    .. math::
        w_i \propto p(\theta_i) / q_{k(i)}(\theta_i),

    which is consistent where *each* proposal covers the target. The weights cannot tell
    whether they do.

    Invalid rows are part of the result, missing ones are not, nor are rows whose
    proposal is not known.

    Args:
        bank: The rows.
        target: A prior or belief, anything with ``log_prob``.

    Returns:
        The weighted rows; a warning is given where they amount to less than 100.

    Raises:
        ValueError: If no row can be used.

    References:
        Elvira, Martino, Luengo & Bugallo, Generalized multiple importance sampling,
        Statistical Science 2019 (their scheme N1).
    """
    table = bank.table()
    usable = (table["status"] != Outcome.MISSING) & np.isfinite(table["log_proposal"])
    rows = torch.from_numpy(usable.nonzero()[0])
    expected = (
        f"rows of {bank.path} from a known proposal, within the support of the target"
    )
    advice = "simulate from it with store=bank.drawn_from(prior)"
    require(len(rows) > 0, expected, "none whose proposal is known", advice)
    theta, log_own = (table[n][usable] for n in ("theta", "log_proposal"))
    log_target = log_density(target, torch.from_numpy(theta))
    log_weight = log_target - torch.from_numpy(log_own)
    is_covered = bool((log_weight > -torch.inf).any())
    require(is_covered, expected, f"{len(rows)} rows, all of density 0", advice)
    result = ReusedRows(bank, rows, log_weight.softmax(0))
    worth = result.effective_sample_size
    if worth < FEW:
        text = f"SA304 {len(rows)} rows of the bank are worth {worth:.1f} draws"
        advice = "simulate more rows from it or near it"
        warn(f"{text} from the target, fewer than {FEW}: {advice}")
    return result

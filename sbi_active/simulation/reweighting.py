"""Old simulations for a new belief: importance weights over the rows of a bank."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

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

#: Nats by which a proposal may differ from the density noted for its own rows.
TOLERANCE = 0.05


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


def reuse(
    bank: Bank,
    target: Distribution,
    *,
    proposals: Mapping[str, Distribution] | None = None,
) -> ReusedRows:
    r"""Weight the rows of a bank so that their theta is distributed as a target.

    With :math:`n_k` of n rows from proposal :math:`q_k`, the weights are those of the
    deterministic mixture, or balance heuristic,

    .. math::
        w_i \propto p(\theta_i) \Big/ \sum_k \frac{n_k}{n} q_k(\theta_i),

    where all proposals are given. Else only the density of each row's own proposal is
    known, as it was noted in the bank, and

    .. math::
        w_i \propto p(\theta_i) / q_{k(i)}(\theta_i),

    which is consistent only where *each* proposal covers the target, and of larger
    variance. Neither can tell whether the proposals cover the target.

    Weights are for the law of theta *given an action*, as a posterior estimator of
    q(theta | x, action) needs it. Proposals may have met with different actions, so the
    mixture is taken anew among the rows of each action. Where every action is another
    one, that amounts to the second formula.

    Invalid rows are part of the result, missing ones are not, nor are rows whose
    proposal is not known.

    Args:
        bank: The rows.
        target: A prior or belief, anything with ``log_prob``.
        proposals: Proposals by label, all of those in the bank that have one.

    Returns:
        The weighted rows; a warning is given where they amount to less than 100.

    Raises:
        ValueError: If no row can be used, a proposal is not given, or one given is not
            the one noted in the bank.

    References:
        Veach & Guibas, Optimally combining sampling techniques, SIGGRAPH 1995;
        Elvira, Martino, Luengo & Bugallo, Generalized multiple importance sampling,
        Statistical Science 2019 (their schemes N3 and N1).
    """
    column = bank.columns("theta", "action", "status", "label", "log_proposal")
    usable = (column["status"] != Outcome.MISSING) & column["log_proposal"].isfinite()
    rows = usable.nonzero()[:, 0]
    expected = f"rows of {bank} from a known proposal, within the support of the target"
    advice = "simulate from it with store=bank.drawn_from(prior, label='prior')"
    require(len(rows) > 0, expected, "none whose proposal is known", advice)
    known = {name: values[rows] for name, values in column.items()}
    log_denominator = known["log_proposal"]
    if proposals is not None:
        log_denominator = _log_mixture(known, proposals, bank.labels)
    log_weight = log_density(target, known["theta"]) - log_denominator
    is_covered = bool((log_weight > -torch.inf).any())
    require(is_covered, expected, f"{len(rows)} rows, all of density 0", advice)
    result = ReusedRows(bank, rows, log_weight.softmax(0))
    worth = result.effective_sample_size
    if worth < FEW:
        text = f"SA304 {len(rows)} rows of the bank are worth {worth:.1f} draws"
        advice = "simulate more rows from it or near it, or give all proposals="
        warn(f"{text} from the target, fewer than {FEW}: {advice}")
    return result


def _log_mixture(
    known: Mapping[str, Tensor], proposals: Mapping[str, Distribution], names: list[str]
) -> Tensor:
    """Return log sum_k n_k / n q_k of rows, counted among those of each action."""
    label, log_own = known["label"], known["log_proposal"]
    strata = torch.unique(known["action"], dim=0, return_inverse=True)[1]
    sizes = torch.bincount(strata).double()
    terms = []
    for code in label.unique():
        own, name = label == code, names[code]
        if name not in proposals:
            raise ValueError(
                f"expected proposals for all labels in the bank, {names}; got none for "
                f"{name!r}; give it, or none at all for weights by each row's own "
                "proposal"
            )
        log_prob = log_density(proposals[name], known["theta"])
        gap = (log_prob[own] - log_own[own]).abs().median()
        expected = f"proposals[{name!r}] to be what its rows were drawn from"
        got = f"log densities {gap:.3g} nats (median) from those in the bank"
        advice = "give the distribution that was passed to drawn_from"
        require(bool(gap <= TOLERANCE), expected, got, advice)
        share = torch.bincount(strata[own], minlength=len(sizes)) / sizes
        terms.append(log_prob + share.log()[strata])
    return torch.stack(terms).logsumexp(0)

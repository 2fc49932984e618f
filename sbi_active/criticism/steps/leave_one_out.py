r"""Leave-one-out density by Pareto-smoothed importance sampling, beside the evidence.

.. math::
    \mathrm{elpd} = \sum_t \log p(x_t | x_{-t}), \qquad
    p(x_t | x_{-t}) \approx \sum_i w_{it}\, p(x_t | z_i), \qquad
    w_{it} \propto 1 / p(x_t | z_i)

over posterior draws :math:`z_i`, the largest weights smoothed. It asks how well trials
are predicted from the others, and depends less on the priors of the effects than the
evidence does. Trials must be independent given z, so that the residual process, which
joins them, has none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.results import NONE, OUTLIER, UNEXPLAINED, ModelKey, Tracing
from sbi_active.criticism.steps.predictive import predict
from sbi_active.inference.sampling.weights import log_sum_exp

Array = NDArray[Any]

NUM_DRAWS = 400  # all that a model's record keeps
#: Pareto shape above which no number of draws helps.
LARGEST_SHAPE = 0.7


@dataclass(frozen=True, kw_only=True)
class LeaveOneOut:
    """Scores of one model's prediction of each trial from the others.

    Attributes:
        name: Name of the model.
        density: Log predictive density of each trial, shape (t,), nats.
        pareto_k: Shape of the largest weights, (t,).
        num_draws: Number of posterior draws.
        names: Names of the trials; empty for their positions.

    References:
        Vehtari, Gelman & Gabry, Statistics and Computing 27 (2017).
    """

    name: str
    density: Array
    pareto_k: Array
    num_draws: int
    names: tuple[str, ...] = ()

    @property
    def total(self) -> float:
        """Expected log predictive density, summed over the trials, nats."""
        return float(self.density.sum())

    @property
    def largest_k(self) -> float:
        r""":math:`\min(1 - 1 / \log_{10} n, .7)`, up to which weights average well."""
        return float(min(1 - 1 / np.log10(self.num_draws), LARGEST_SHAPE))

    @property
    def unreliable(self) -> tuple[int, ...]:
        """Positions of trials whose k exceeds the largest that the draws allow."""
        return (*np.flatnonzero(~(self.pareto_k <= self.largest_k)).tolist(),)


def leave_one_out(rivals: RivalSet, tracing: Tracing) -> tuple[LeaveOneOut, ...]:
    """Return the densities of the bare model and of the one that was chosen.

    Args:
        rivals: The models.
        tracing: Tracing with their verdict. "unexplained" and "outlier" have the bare
            model alone.
    """
    found = [_density(rivals, ModelKey())]
    if tracing.verdict not in (NONE, UNEXPLAINED, OUTLIER):
        found.append(_density(rivals, tracing.key))
    return (*found,)


def _density(rivals: RivalSet, key: ModelKey) -> LeaveOneOut:
    # ArviZ takes seconds to import.
    from sbi_active.arviz_versions import pareto_smoothed

    evidence = rivals.fit(key).evidence
    prediction = predict(rivals, key=key, num_draws=NUM_DRAWS)
    log_p = prediction.log_likelihood
    efficiency = np.clip(evidence.effective_sample_size, 1.0, NUM_DRAWS) / NUM_DRAWS
    log_w, k = pareto_smoothed(log_p, relative_efficiency=float(efficiency))
    return LeaveOneOut(
        name=evidence.name,
        density=log_sum_exp(log_w + log_p, axis=0),
        pareto_k=k,
        num_draws=NUM_DRAWS,
        names=rivals.trials.names,
    )

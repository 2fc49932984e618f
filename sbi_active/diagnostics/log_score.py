r"""The log-score gap: what a posterior loses against the right one, in nats.

.. math::
    G = E\big[\log p(\theta | x, \xi) - \log q(\theta | x, \xi)\big]
      = E\,\mathrm{KL}(p \| q) \ge 0

Ranks and coverage are uniform for the prior itself, whatever x says; G is not zero for
it. It is also the expected information gain less the network's own bound on it.

With declared noise, :math:`p(\theta | x) = b(\theta) p(x | \theta) / Z`. Z comes from
importance sampling with the truth among the draws, which makes Z too large on average
and G a lower bound. Otherwise a classifier tells truths from draws of q, and bounds the
same divergence from below on rows that it was not trained on.

References:
    Foster et al., AISTATS 2020, arXiv:1911.00294 (bounds with a proposal); Nguyen,
    Wainwright & Jordan, IEEE Trans. Inf. Theory 2010 (the bound by a classifier);
    Linhart et al., NeurIPS 2023, arXiv:2306.03580 (classifiers as a local check).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from sklearn.ensemble import HistGradientBoostingClassifier
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import Simulations, SimulatorModel, simulate
from sbi_active.support import within_support


def smooth(belief: Distribution, theta: Tensor) -> Tensor:
    """Return a belief's log density without simulations, (..., d) -> (...)."""
    log_prob: Any = getattr(belief, "smooth_log_prob", belief.log_prob)
    inside = within_support(belief, theta.reshape(-1, theta.shape[-1]))
    value = log_prob(theta).double()
    return torch.where(inside.reshape(theta.shape[:-1]), value, -torch.inf)


def gap_by_likelihood(
    simulator: SimulatorModel,
    belief: Distribution,
    simulated: Simulations,
    log_q: Callable[[Tensor], Tensor],
    draws: Tensor,
    *,
    num_contrastive: int = 64,
    seed: int,
) -> Tensor:
    r"""Return :math:`\log p(\theta|x,\xi) - \log q`, on average a lower bound.

    Args:
        simulator: Simulator with declared noise.
        belief: Belief over theta before x.
        simulated: Rows of truths, n of them.
        log_q: Log density of rows of draws, (m, n, d) -> (m, n).
        draws: Draws of q, shape (m, n, d).
        num_contrastive: Draws of q and of the belief, as many of each.
        seed: Seed of the belief's draws.

    Returns:
        Shape (n,), nats.
    """
    n, m = len(simulated), num_contrastive
    with forked_generators(derive_seed(seed, "contrast")):
        other = belief.sample(torch.Size([m * n])).reshape(m, n, -1).float()
    rows = torch.cat([simulated.theta[None], draws[:m], other])
    with torch.no_grad():
        q = log_q(rows).double()
    b = smooth(belief, rows)
    finite = b.isfinite()

    def repeated(part: Tensor) -> Tensor:
        return part.expand(len(rows), *part.shape)[finite]

    bare, x = simulator.without_noise(), repeated(simulated.x).double()
    action, own = repeated(simulated.action), derive_seed(seed, "mean")
    mean = simulate(bare, rows[finite], action, seed=own).x.double()
    assert simulator.noise is not None
    value = simulator.noise.log_prob(x, mean.nan_to_num(0.0)).double()
    # Where one alone is NaN it is impossible.
    agrees = (x.isnan() == mean.isnan()).flatten(1).all(1)
    value = torch.where(x.isnan().flatten(1).all(1), 0.0, value)
    likelihood = torch.full(b.shape, -torch.inf, dtype=torch.float64)
    likelihood[finite] = torch.where(agrees, value, -torch.inf)
    proposal = torch.logaddexp(q, b) - math.log(2)
    log_weight = (likelihood + b - proposal).nan_to_num(nan=-torch.inf)
    log_z = log_weight.logsumexp(0) - math.log(len(rows))
    return likelihood[0] + b[0] - q[0] - log_z


def gap_by_classifier(
    theta: Tensor,
    condition: Tensor,
    draws: Tensor,
    log_q: Any,
    *,
    seed: int,
    largest: float = 6.0,
) -> Tensor:
    r"""Return terms of a lower bound on the gap, by a classifier trained on half.

    .. math::
        G \ge E_p[T] - E_q[e^T] + 1

    with T the classifier's log ratio of truths over draws of q.

    Args:
        theta: Truths, shape (n, d).
        condition: Packed (x, action), shape (n, c).
        draws: Draws of q, shape (m, n, d), at least three.
        log_q: Log density of rows of draws, (m, n, d) -> (m, n).
        seed: Seed of the halves and the classifier.
        largest: Largest log ratio T, what thousands of rows can tell.

    Returns:
        Shape (n,), nats.
    """
    center = draws.mean(0)
    spread = draws.std(0).clamp_min(1e-12)

    def features(rows: Tensor) -> np.ndarray:
        with torch.no_grad():
            density = log_q(rows[None])[0]
        parts = [condition, (rows - center) / spread, rows, density[:, None]]
        return torch.cat(parts, 1).double().numpy()

    true, false = features(theta), [features(d) for d in draws[:2]]
    half = np.random.default_rng(derive_seed(seed, "half")).permutation(len(theta)) % 2
    terms = np.zeros(len(theta))
    options: Any = {"early_stopping": True, "max_iter": 60, "max_depth": 4}
    for k in (0, 1):
        on, off = half != k, half == k
        model = HistGradientBoostingClassifier(random_state=k, **options)
        rows = np.concatenate([true[on], false[0][on]])
        model.fit(rows, np.repeat([1, 0], int(on.sum())))
        ratios = (model.decision_function(f[off]) for f in (true, *false))
        p, *q = (np.clip(ratio, -largest, largest) for ratio in ratios)
        terms[off] = p - np.mean([np.exp(v) for v in q], 0) + 1
    return torch.from_numpy(terms)

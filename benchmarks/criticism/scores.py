"""Scores of one case, from the public report and the truth alone.

The error that remains when the true effect is known and only fitted.
"""

from __future__ import annotations

import json

import numpy as np
import torch
from sbi.utils import BoxUniform
from scipy.stats import multivariate_t
from torch import Tensor

from benchmarks.criticism.cases import Case
from benchmarks.fitting import local_fits
from sbi_active.criticism import Report, joint_prior
from sbi_active.criticism.contradictions import UNDECLARED
from sbi_active.seeding import derive_seed

NUM_DRAWS = 2_000
DEGREES = 5  # of freedom of the proposal
INFLATION = 1.5  # of its covariance
CLOSE = 20.0  # half sums of squares above the best fit that still get a component


def oracle_rmse(case: Case) -> float:
    """Return the root mean square error of the posterior predictive mean.

    Importance sampling around least-squares fits of the model with the true effects,
    under their priors, the true noise and its correlation: of the loop's own engine it
    uses nothing.

    Args:
        case: The case; its held-out trials are scored.
    """
    truth, trials = case.truth, case.problem.trials
    effects, held_out = truth.effects, trials.held_out
    assert held_out is not None
    target = trials.fit.x

    def residual(parameters: Tensor) -> Tensor:
        return truth.residual(parameters, effects, target)

    prior: BoxUniform = truth.world.prior
    fits = local_fits(residual, truth.starts(effects), prior=prior)
    best = min(fit.cost for fit in fits)
    width = truth.starts(effects).std(0).numpy()
    components: list[tuple[np.ndarray, np.ndarray]] = []
    for fit in sorted(fits, key=lambda fit: fit.cost):
        known = [np.all(np.abs(fit.x - mode) < 1e-3 * width) for mode, _ in components]
        if fit.cost < best + CLOSE and not any(known):
            precision = fit.jac.T @ fit.jac + np.diag(0.3 / width**2)
            components.append((fit.x, INFLATION * np.linalg.inv(precision)))

    rng = np.random.default_rng(derive_seed(truth.seed, "oracle"))
    share = NUM_DRAWS // len(components)
    proposals = [
        # A width far beyond the others leaves a covariance as good as singular.
        multivariate_t(loc=m, shape=c, df=DEGREES, allow_singular=True)  # type: ignore[arg-type]
        for m, c in components
    ]
    draws = np.concatenate([p.rvs(share, random_state=rng) for p in proposals])
    draws = draws.reshape(share * len(components), -1)
    log_q = np.logaddexp.reduce([p.logpdf(draws) for p in proposals], axis=0)
    z = torch.from_numpy(draws)
    log_p = joint_prior(prior, effects).log_prob(z).double()
    log_w = log_p - torch.from_numpy(log_q)
    inside = log_w.isfinite()
    z, log_w = z[inside], log_w[inside]
    weight = torch.softmax(log_w - 0.5 * residual(z).square().sum(-1), 0)
    x = truth.predict(z, effects, held_out.action, len(truth.action))
    mean = torch.einsum("n,n...->...", weight, x)
    return float((mean - held_out.x).square().mean().sqrt())


def score_case(case: Case, number: int, *, oracle: bool = False) -> dict[str, object]:
    """Run the loop on a case and return its row of the results.

    Args:
        case: The case.
        number: Its number, also the loop's seed.
        oracle: Also score the model that is given the true effect.
    """
    problem, truth = case.problem, case.truth
    row: dict[str, object] = {
        "effects": " + ".join(truth.names) or "none",
        "lambda": truth.non_centrality,
        "support": _support(case),
    }
    # No table needs a plan but that of active choice.
    report, cost = problem.counted_report(number, plan=False)
    row["rmse_oracle"] = oracle_rmse(case) if oracle else ""
    return row | read_report(report) | cost


def _support(case: Case) -> float | str:
    """Return what data say against less than both effects, or against the declared."""
    if len(case.truth.effects) > 1:
        return case.truth.support
    if case.truth.kind in ("removed", "inexpressible") and case.problem.effects:
        return case.truth.left_by_any(case.problem.effects)
    return ""


def read_report(report: Report) -> dict[str, object]:
    """Return a report's public figures as cells."""
    row: dict[str, object] = {
        "verdict": report.verdict,
        "probabilities": json.dumps(
            {k: round(float(p), 6) for k, p in report.probabilities.items()}
        ),
        "credible_set": json.dumps([*report.credible_set]),
        "equivalent": json.dumps([sorted(group) for group in report.equivalent]),
        "formula": report.guess or "",
        "undeclared": int(UNDECLARED in repr(report)),
    }
    for metric, before, after, *_ in report.before_after.itertuples(index=False):
        if metric in ("rmse", "coverage"):
            row |= {f"{metric}_before": before, f"{metric}_after": after}
    return row

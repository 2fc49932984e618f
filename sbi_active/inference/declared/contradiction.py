r"""Trials that contradict one another: how much wider the noise must be.

If even the best fit is far outside the declared noise, the posterior under that noise
has no width: it lies at the best fit, or at another place that the search found, with
deviations of 0. The noise is then inflated by one factor s for all trials,

.. math::
    s^2 = \max\Bigl(\frac{\sum_k |r_k|^2}{N - d},\;
    \frac{t}{t - 1}\, \lambda_{\max}\bigl(H^{-1} J\bigr)\Bigr), \qquad
    H = \sum_k J_k^\top J_k + I, \quad J = \sum_k g_k g_k^\top, \quad
    g_k = J_k^\top r_k,

with the whitened residuals r and their derivatives J_k at the best fit: Birge's ratio,
and the spread of the trials' own gradients about zero, which also counts residuals that
are alike within a trial.

References:
    Birge, Physical Review 40 (1932); Huber, Proc. Fifth Berkeley Symp. 1 (1967), for
    the spread of gradients; Pauli, Racugno & Ventura, Statistica Sinica 21 (2011), for
    a likelihood to a power that it gives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.stats import chi2
from torch import Tensor

from sbi_active.arrays import Array
from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.inference.engine.potential import SimulatedLikelihood


@dataclass(frozen=True)
class Contradiction:
    """The contradiction between trials.

    Attributes:
        inflation: Factor s of the noise's standard deviation.
        probability: Tail probability of all residuals under the declared noise.
        probability_of_trial: Tail probability of each trial's residuals.
        trials: The trials that contradict, in a clause.
    """

    inflation: float
    probability: float
    probability_of_trial: tuple[float, ...]
    trials: str

    def noted(self, diagnostics: Diagnostics) -> Diagnostics:
        """Return diagnostics of the wider belief that say so first."""
        text = (
            f"SA102 {self.trials}: the observations are unlike anything simulated "
            f"(tail probability {self.probability:.1g}), so that the noise was "
            f"inflated {self.inflation:.3g} times, to what the trials scatter; "
            "correct or withdraw what is wrong, or criticize the simulator"
        )
        return diagnostics.extended(
            warnings=(),
            tail_probability=self.probability,
            tail_probability_of_trial=self.probability_of_trial,
            noise_inflation=self.inflation,
        ).warned(text, *diagnostics.warnings)


def find_contradiction(
    likelihood: SimulatedLikelihood,
    theta: Tensor,
    residual: Array,
    jacobian: Array,
    *,
    rng: np.random.Generator,
    informed_above: float = 1e-3,
) -> Contradiction | None:
    """Return the contradiction at the best fit; None if the noise explains it.

    Args:
        likelihood: Likelihood of all trials under the declared noise.
        theta: Best fit, then parameters around it, shape (n, d).
        residual: Whitened residuals at the best fit, shape (N,), 0 where not observed.
        jacobian: Derivatives of the residuals in coordinates of a standard normal
            prior, (N, d).
        rng: Source of the draws of the noise.
        informed_above: Derivative below which no trial informs a parameter.
    """
    t = len(likelihood)
    squares = (residual.reshape(t, -1) ** 2).sum(1)
    found = compared(
        *(likelihood.action, likelihood.x, likelihood.noise.whiten),
        squares,
        num_fitted=int((np.abs(jacobian).max(0) > informed_above).sum()),
    )
    if found is None or not _beyond_noise(likelihood, theta, rng):
        return None
    if t == 1:
        return found
    d = jacobian.shape[1]
    precision = jacobian.T @ jacobian + np.eye(d)
    parts = residual.reshape(t, -1), jacobian.reshape(t, -1, d)
    measured: Any = likelihood.x.isfinite().flatten(1).any(1).numpy()
    gradient = np.einsum("kn,knd->kd", *parts) * measured[:, None]
    spread = np.linalg.eigvals(np.linalg.solve(precision, gradient.T @ gradient))
    by_trial = t / (t - 1) * float(spread.real.max())
    return replace(found, inflation=max(found.inflation, by_trial**0.5))


def compared(
    action: Tensor,
    x: Tensor,
    whiten: Callable[[Tensor], Tensor],
    squares: Array,
    *,
    num_fitted: int,
    level: float = 1e-6,
) -> Contradiction | None:
    """Return the contradiction by the squares alone; None if there is none.

    Args:
        action: Executed actions, shape (t, action_dim).
        x: Observed outcomes, shape (t, *x_shape); NaN where nothing was measured.
        whiten: Function that gives differences of outcomes, (n, *x_shape), in
            deviations of the noise.
        squares: Sum of squared whitened residuals of each trial, shape (t,).
        num_fitted: Number of parameters that the best fit adapts.
        level: Tail probability of the best fit's residuals, below which trials
            contradict. A right simulator crosses it once in a million updates; half and
            twice are the same in practice, since contradictions lie far below.
    """
    count = x.isfinite().flatten(1).sum(1).numpy()
    freedom = int(count.sum()) - num_fitted
    if freedom < 1:  # as few numbers as parameters meet at the edge of a prior alone
        return None
    probability = float(chi2.sf(squares.sum(), freedom))
    if probability >= level:
        return None
    trials = _repeats(action, x, whiten, level)
    if not trials:
        size = np.sqrt(squares / np.maximum(count, 1))
        worst = _listed([f"trial {k} by {size[k]:.3g}" for k in np.argsort(-size)])
        trials = (
            f"the best fit misses {worst} deviations of the noise (root mean square)"
        )
    each = chi2.sf(squares, np.maximum(count, 1)).tolist()
    inflation = float(np.sqrt(squares.sum() / freedom))
    return Contradiction(inflation, probability, (*each,), trials)


def _beyond_noise(
    likelihood: SimulatedLikelihood,
    theta: Tensor,
    rng: np.random.Generator,
    *,
    num: int = 2_000,
) -> bool:
    """Return whether the noise is never as unlikely as the trials, heavy tails too.

    Of parameters (n, d) those count at which the trials are likeliest: least squares
    do not find them where tails are heavy.
    """
    log_likelihood = likelihood(theta)
    best = int(log_likelihood.argmax())
    if not np.isfinite(log_likelihood[best]):
        return True
    drawn = np.zeros(num)
    for action, x in zip(likelihood.action, likelihood.x, strict=True):
        if not bool(x.isfinite().any()):
            continue
        mean = torch.from_numpy(likelihood.table.mean(theta[best, None], action)[0])
        mean = mean.expand(num, *mean.shape[1:])
        seeds = torch.from_numpy(rng.integers(2**62, size=num))
        outcome = likelihood.noise.sample(mean, seeds).double()
        outcome = torch.where(x.isfinite(), outcome, torch.nan)
        drawn += likelihood.noise.log_prob(outcome, mean).double().numpy()
    return bool((drawn > log_likelihood[best]).all())


def _repeats(
    action: Tensor, x: Tensor, whiten: Callable[[Tensor], Tensor], level: float
) -> str:
    """Return the repeats of one action that contradict most; "" if none does."""
    worst, text = level, ""
    for own in action.unique(dim=0):
        same = torch.nonzero((action == own).all(1)).flatten().tolist()
        if len(same) < 2:
            continue
        apart = whiten(x[same] - x[same].nanmedian(0).values).flatten(1)
        count = apart.isfinite().sum(1).clamp_min(1).numpy()
        # The median has noise of its own, as large as that of a trial of two.
        tails = chi2.sf(0.5 * apart.nan_to_num().square().sum(1).numpy(), count)
        if tails.min() >= worst:
            continue
        worst = float(tails.min())
        odd = same[int(tails.argmin())]
        others = [k for k in same if k != odd]
        listed = _listed([*map(str, others)], " and {} more")
        text = (
            f"trial {odd} gave {_shown(x[odd])}, and trial{'s' * (len(others) > 1)} "
            f"{listed} of the same action {_shown(own)} gave "
            f"{_shown(x[others].nanmedian(0).values)}"
        )
    return text


def _shown(values: Tensor) -> str:
    listed = _listed([f"{v:.4g}" for v in values.flatten().tolist()], ", ...")
    return listed if values.numel() == 1 else f"[{listed}]"


def _listed(texts: list[str], others: str = "", *, most: int = 3) -> str:
    """Return the first few texts, and of how many others there are."""
    left = len(texts) - most
    return ", ".join(texts[:most]) + (others.format(left) if left > 0 else "")

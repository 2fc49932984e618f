"""Diagnostics of a belief: what it takes for granted, and trials that contradict.

``doubts.md`` beside this file has what is said where an assumption does not hold.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import chi2
from torch import Tensor

from sbi_active.arrays import Array
from sbi_active.inference.beliefs.diagnostics import Assumption, Diagnostics
from sbi_active.inference.engine import Fit, Settings, SimulatedPotential
from sbi_active.inference.engine.potential import SimulatedLikelihood
from sbi_active.inference.sampling.coordinates import near_ends
from sbi_active.seeding import derive_seed, forked_generators


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
    r"""Return the contradiction at the best fit; None if the noise explains it.

    If even the best fit is far outside the declared noise, the posterior under that
    noise has no width. The noise is then inflated by one factor s for all trials,

    .. math::
        s^2 = \max\Bigl(\frac{\sum_k |r_k|^2}{N - d},\;
        \frac{t}{t - 1}\, \lambda_{\max}\bigl(H^{-1} J\bigr)\Bigr), \qquad
        H = \sum_k J_k^\top J_k + I, \quad J = \sum_k g_k g_k^\top, \quad
        g_k = J_k^\top r_k,

    with the whitened residuals r and their derivatives J_k at the best fit: Birge's
    ratio, and the spread of the trials' own gradients about zero, which also counts
    residuals that are alike within a trial.

    Args:
        likelihood: Likelihood of all trials under the declared noise.
        theta: Best fit, then parameters around it, shape (n, d).
        residual: Whitened residuals at the best fit, shape (N,), 0 where not observed.
        jacobian: Derivatives of the residuals in coordinates of a standard normal
            prior, (N, d).
        rng: Source of the draws of the noise.
        informed_above: Derivative below which no trial informs a parameter.

    References:
        Birge, Physical Review 40 (1932); Huber, Proc. Fifth Berkeley Symp. 1 (1967);
        Pauli, Racugno & Ventura, Statistica Sinica 21 (2011), for a likelihood to a
        power that it gives.
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

    Uses the most likely of the parameters (n, d), which least squares do not find
    where tails are heavy.
    """
    log_likelihood = likelihood(theta)
    best = int(log_likelihood.argmax())
    if not np.isfinite(log_likelihood[best]):
        return True
    trials = range(len(likelihood))
    with forked_generators(int(rng.integers(2**62))):
        drawn = [_noise_terms(likelihood, theta[[best]], k, num) for k in trials]
    return bool((np.sum(drawn, axis=0) > log_likelihood[best]).all())


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


#: Whether something that is taken for granted holds, and its figure.
Doubt = tuple[bool, float]


@cache
def texts() -> dict[str, str]:
    """Return what is said where an assumption does not hold, by its name."""
    text = Path(__file__).with_name("doubts.md").read_text(encoding="utf-8")
    entries = re.findall(r"^### (\w+)\n((?:.+\n)+)", text, re.MULTILINE)
    return {name: " ".join(own.split()) for name, own in entries}


def diagnose_fit(
    fit: Fit,
    potential: SimulatedPotential,
    declared: SimulatedLikelihood,
    seed: int,
    *,
    coarse: float = 60.0,
    tolerated: float = 0.1,
    moving: float = 0.02,
    remembered: float = 0.3,
    num_checked: int = 200,
) -> Diagnostics:
    """Return figures about a fit, what it assumes, and warnings in words.

    Args:
        fit: Posterior of the potential.
        potential: Potential whose noise may be inflated.
        declared: Likelihood under the noise as it was declared.
        seed: Seed of the draws behind tail probabilities.
        coarse: Number of effective draws below which a warning is due.
        tolerated: Divergence of a normal fit to the draws, nats, likewise.
        moving: Share of moves accepted below which particles are stuck.
        remembered: Correlation of particles with where they began that is too much.
        num_checked: Number of draws that tail probabilities rest on.
    """
    base, found, moved = potential.coordinates.base, fit.found, fit.particles
    z = potential.coordinates.to_z(fit.u)
    place = 0.5 * (1 + z[:, base.bounded])
    edge_mass = float(near_ends(place, fit.weight).sum(0).max(initial=0.0))
    rng = np.random.default_rng(derive_seed(seed, "tail"))
    rows = rng.choice(len(z), size=num_checked, p=fit.weight)
    effective, dim = fit.effective_sample_size, int((~fit.free).sum())
    needed = max(coarse, dim * (dim + 3) / (4 * tolerated))
    doubts: dict[str, Doubt] = {"enough_draws": (effective >= needed, effective)}
    if moved is None:
        is_light = fit.tail_shape <= Settings().largest_shape
        doubts["light_tails"] = is_light, fit.tail_shape
    else:
        moves = moved.acceptance >= moving and moved.memory <= remembered
        doubts["particles_move"] = moves, moved.acceptance
    if found is not None and not fit.is_rough:
        doubts["mode_found_twice"] = found.num_found >= 2, found.num_found
    error = float(max(effective, 1e-9) ** -0.5)
    num_starts = 0 if found is None else found.num_starts
    return judged(
        doubts,
        {"needed": needed, "dim": dim, "error": error, "num_starts": num_starts},
        _tail_probability(declared, base.to_theta(z[rows]), seed),
        edge_mass,
        effective_sample_size=effective,
        error_nats=error,
        figures={
            "likelihood": "simulated",
            "method": fit.method,
            "num_stages": fit.num_stages,
            "num_modes": 0 if found is None else len(found.modes),
            "num_uninformed": int(fit.free.sum()),
            "log_evidence": fit.log_evidence,
            "log_evidence_error": fit.standard_error,
            "prior_edge_mass": edge_mass,
        },
    )


def judged(
    doubts: Mapping[str, Doubt],
    details: Mapping[str, Any],
    tails: list[float],
    edge_mass: float,
    *,
    edge: float = 0.5,
    rare: float = 1e-3,
    **known: Any,
) -> Diagnostics:
    """Return diagnostics of a belief: what it takes for granted, and warnings.

    Args:
        doubts: Things that are taken for granted, by name.
        details: Further figures of what is said of these.
        tails: Tail probability of each trial, and of all.
        edge_mass: Mass of the belief near the edges of one parameter.
        edge: Such a mass that calls for a warning.
        rare: Tail probability of the observation that calls for a warning.
        known: Further diagnostics.
    """
    warnings = [
        texts()[name].format(figure=figure, **details)
        for name, (holds, figure) in doubts.items()
        if not holds
    ]
    *each, joint = tails
    if joint < rare or min(each) < rare / len(each):
        warnings.append(
            "SA102 the observations are unlike anything simulated (tail probability "
            f"{min(joint, *each):.1g}): the simulator lacks something, the prior "
            "excludes the truth, or a measurement is wrong"
        )
    if edge_mass > edge:
        warnings.append(
            f"SA103 {edge_mass:.0%} of the belief lies within 1 % of the prior's "
            "edge: the prior may exclude the truth"
        )
    return Diagnostics(
        trustworthy=not warnings,
        warnings=(*warnings,),
        assumptions={
            name: Assumption(bool(holds), float(figure))
            for name, (holds, figure) in doubts.items()
        },
        tail_probability=joint,
        tail_probability_of_trial=(*each,),
        **known,
    )


def _tail_probability(
    likelihood: SimulatedLikelihood, theta: Tensor, seed: int, *, num_repeats: int = 50
) -> list[float]:
    r"""Return the probability that noise is less likely than what was observed.

    .. math::
        P\big(p(x' | \theta) \le p(x_o | \theta)\big), \quad \theta \sim b,\;
        x' \sim p(x | \theta),

    a trial and, last, for all trials, by some draws of the noise at each theta.

    References:
        Gelman, Meng & Stern, Statistica Sinica 1996 (realized discrepancies).
    """
    size, tail = len(theta) * num_repeats, []
    total_observed, total_simulated = np.zeros(size), np.zeros(size)

    def exceeded(simulated: Array, observed: Array) -> float:
        return float(((simulated <= observed).sum() + 1) / (size + 1))

    for k in range(len(likelihood)):
        observed = np.repeat(likelihood.terms(theta, k), num_repeats)
        with forked_generators(derive_seed(seed, "tail", k)):
            simulated = _noise_terms(likelihood, theta, k, num_repeats)
        tail.append(exceeded(simulated, observed))
        total_observed += observed
        total_simulated += simulated
    return [*tail, exceeded(total_simulated, total_observed)]


def _noise_terms(
    likelihood: SimulatedLikelihood, theta: Tensor, trial: int, num_repeats: int
) -> Array:
    """Return log densities of draws of a trial's noise where it is seen, shape (n r,).

    Those of Gaussian noise are its peak less half a chi-square.
    """
    noise, x = likelihood.noise, likelihood.x[trial]
    if not bool(x.isfinite().any()):
        return np.zeros(len(theta) * num_repeats)
    if noise.is_known_gaussian:
        freedom = torch.tensor(0.5 * float(x.isfinite().sum()))
        half = torch.distributions.Gamma(freedom.double(), 1.0)
        drawn = half.sample(torch.Size([len(theta) * num_repeats]))
        return likelihood.peak[trial] - drawn.numpy()
    mean = torch.from_numpy(likelihood.table.mean(theta, likelihood.action[trial])[0])
    mean = mean.repeat_interleave(num_repeats, 0)
    draws = torch.where(x.isfinite(), noise.sample(mean).double(), torch.nan)
    return noise.log_prob(draws, mean).double().numpy()

"""How far a refined belief can be trusted, from the stages that led to it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import kurtosis

from sbi_active.inference.beliefs.diagnostics import Assumption, Diagnostics
from sbi_active.inference.declared.diagnosing import misplaced
from sbi_active.inference.engine.learned import LearnedFit
from sbi_active.inference.refinement.regression_error import (
    expected_error,
)
from sbi_active.inference.refinement.tails import tail_probability
from sbi_active.inference.regression.surrogate import MISFIT, LocalRegression, Surrogate

Array = NDArray[Any]

SETTLED = 0.03  # nats a dimension that the last stage may have changed
LIVE = 0.01  # mass below which a region is left out of the checks
MIN_EFFECTIVE = 0.05  # share of the particles
ROUGH = 0.5  # share of the variance that a cubic misses over the whole prior
HARD_NOISE = 0.03  # nats a number that a Gaussian loses on the noise
LIGHT_TAILS = -0.3  # excess kurtosis; -1.2 for uniform noise, 0 for Gaussian
SERIOUS_MISFIT = 1.5  # residual over noise variance, chance removed
UNSETTLED = 0.1  # nats a dimension
CORRELATED = 0.25  # across trials; misfit below MISFIT reaches half of it
UNTRUSTED = 0.1  # nats off, by the number of simulations, that call for a warning


@dataclass(frozen=True)
class Stage:
    """One stage: surrogate, its sample and its normalized log density.

    Attributes:
        surrogate: Fitted at this stage.
        fit: Its posterior.
        defensive: Share of the prior in the density.
        draws: Equally weighted particles, shape (n, d).
        excess: Worst misfit of a region with mass.
        mass: Of each region, shape (k,).
        entropy: Of the density, in nats.
        error: Expected divergence in nats, as the simulations are finite in number.
    """

    surrogate: Surrogate
    fit: LearnedFit
    defensive: float
    draws: Array
    excess: float
    mass: Array
    entropy: float
    error: float

    @staticmethod
    def of(
        surrogate: Surrogate,
        fit: LearnedFit,
        defensive: float,
        rng: np.random.Generator,
    ) -> Stage:
        """Return the stage of a fitted surrogate and its sample."""
        draws = fit.draws(1_000, rng)
        label = surrogate.assign(draws)
        mass = np.bincount(label[label >= 0], minlength=len(surrogate.regressions))
        mass = mass / max(mass.sum(), 1)
        live = [
            one.excess
            for one, share in zip(surrogate.regressions, mass, strict=True)
            if share > LIVE
        ]
        stage = Stage(
            surrogate,
            fit,
            defensive,
            draws,
            excess=max(live, default=np.inf),
            mass=mass,
            entropy=0.0,
            error=expected_error(surrogate, draws, rng),
        )
        return replace(stage, entropy=-float(stage.log_prob(draws).mean()))

    def log_prob(self, z: Array) -> Array:
        """Return the log density of the belief at this stage, shape (n,)."""
        log_prior = self.surrogate.coordinates.log_prior(z)
        log_likelihood = self.surrogate.log_likelihood(z)
        return log_prior + np.logaddexp(
            np.log1p(-self.defensive) + log_likelihood - self.fit.fit.log_evidence,
            np.log(self.defensive),
        )


@dataclass
class Course:
    """The stages so far and whether to go on.

    Attributes:
        small: Nats by which a settled belief may be off for want of simulations.
    """

    small: float
    stages: list[Stage] = field(default_factory=list)
    divergences: list[float] = field(default_factory=list)
    shrinkage: float = np.inf

    @property
    def divergence(self) -> float:
        """Nats by which the last stage changed the belief; inf of the first."""
        return self.divergences[-1]

    def append(self, stage: Stage) -> None:
        """Record a stage, and by how much it changed the belief."""
        self.divergences.append(np.inf)
        if self.stages:
            last = self.stages[-1]
            change = stage.log_prob(stage.draws) - last.log_prob(stage.draws)
            self.divergences[-1] = float(change.mean())
            self.shrinkage = last.entropy - stage.entropy
        self.stages.append(stage)

    def end_at_best(self) -> None:
        """Leave out last stages that err more than one without misfit before them.

        Unless the stage after that one differs from it by more than its own error: what
        is missed far off has no part in the expected error. It is settled if the stage
        after it, or it, changed nothing.
        """
        errors = [s.error if s.excess <= MISFIT else np.inf for s in self.stages]
        best = len(errors) - 1
        for k in range(1, len(errors) - 1):
            best = k if errors[k] < errors[best] else best
        if self.stages[-1].error <= self.small or best == len(errors) - 1:
            return
        allowed = UNSETTLED * self.stages[-1].draws.shape[1]
        if self.divergences[best + 1] > allowed + self.stages[best + 1].error:
            return
        self.divergences[best] = min(self.divergences[best : best + 2])
        del self.stages[best + 1 :], self.divergences[best + 1 :]

    @property
    def is_settled(self) -> bool:
        """Whether residuals are noise and the last stage changed nothing."""
        stage = self.stages[-1]
        d = stage.draws.shape[1]
        return (
            stage.excess <= MISFIT
            and self.divergence < SETTLED * d
            and self.shrinkage < 0.1 * d
            and stage.error <= self.small
        )

    @property
    def is_stuck(self) -> bool:
        """Whether misfit remains though the last stage learned nothing."""
        stage = self.stages[-1]
        return stage.excess > MISFIT and self.divergence < 0.3 and self.shrinkage < 0.3


def diagnose(
    course: Course,
    *,
    num_simulations: int,
    share_invalid: float,
    num_trials: int,
    rng: np.random.Generator,
) -> Diagnostics:
    """Return figures about the last stage, its assumptions and warnings in words."""
    last = course.stages[-1]
    fits = last.surrogate.regressions
    live = [fit for fit, mass in zip(fits, last.mass, strict=True) if mass > LIVE]
    dim = last.draws.shape[1]
    tail, joint = tail_probability(last.surrogate, last.draws, num_trials)
    edge = np.abs(last.draws[:, last.surrogate.coordinates.bounded]) > 0.98
    edge_mass = float(edge.mean(0).max(initial=0.0))
    effective = min(stage.fit.efficiency for stage in course.stages)
    roughness = course.stages[0].surrogate.regressions[0].roughness
    negentropy, is_gaussian = _noise_shape(live, rng)
    is_gaussian &= not _has_hard_edges(course.stages)
    correlation, is_independent = _trial_correlation(live, num_trials)
    ratio = max((fit.ratio for fit in live), default=np.inf)

    assumptions: dict[str, tuple[bool, float, str]] = {
        "gaussian_noise": (
            is_gaussian,
            negentropy,
            "SA110 the noise is not Gaussian (it differs by {:.2g} nats a number), "
            "and the belief, which takes it for Gaussian, may be too wide or too "
            "narrow; check against a belief of a trained network",
        ),
        "few_modes": (
            effective >= MIN_EFFECTIVE,
            effective,
            "SA111 at some stage only {:.1%} of the particles counted, as with "
            "many narrow modes, and a mode may be lost; raise num_histories",
        ),
        "smooth_response": (
            roughness <= ROUGH,
            roughness,
            "SA111 over the prior the outcomes have more turns than a cubic, which "
            "misses {:.0%} of their variance, so that four or more narrow modes "
            "are possible and one may be lost; check against another seed or a "
            "narrower prior",
        ),
        "no_misfit": (
            last.excess <= SERIOUS_MISFIT,
            ratio,
            "SA112 the residuals of the surrogate have {:.2g} times the variance "
            "of the noise, so that the belief is too wide; raise num_histories",
        ),
        "settled": (
            len(course.stages) > 1 and course.divergence <= UNSETTLED * dim,
            course.divergence if len(course.stages) > 1 else -1.0,
            "SA109 the last stage still changed the belief, by {:.2g} nats; raise "
            "num_histories",
        ),
        "independent_trials": (
            is_independent,
            correlation,
            "SA104 simulated trials correlate at the same parameters ({:.2f}), yet "
            "the likelihood is a product over trials; check how the simulator seeds "
            "its noise",
        ),
        "small_error": (
            last.error <= UNTRUSTED,
            last.error,
            "SA105 the belief is off by about {:.2g} nats, since its regressions "
            "rest on few simulations for so many parameters and numbers; raise "
            "num_histories",
        ),
    }
    warnings = [
        text.format(figure) for ok, figure, text in assumptions.values() if not ok
    ]
    warnings += misplaced(tail, joint, edge_mass)
    return Diagnostics(
        trustworthy=not warnings,
        warnings=(*warnings,),
        assumptions={
            name: Assumption(bool(ok), float(figure))
            for name, (ok, figure, _) in assumptions.items()
        },
        num_simulations=num_simulations,
        effective_sample_size=float(last.fit.fit.effective_sample_size),
        error_nats=last.error,
        error_nats_if_explained=expected_error(
            last.surrogate, last.draws, rng, explained=True
        ),
        tail_probability=joint,
        tail_probability_of_trial=(*tail,),
        figures={
            "num_stages": len(course.stages),
            "residual_to_noise": float(ratio),
            "num_regions": len(fits),
            "region_mass": [float(mass) for mass in last.mass],
            "prior_edge_mass": edge_mass,
            "surrogate_kl_last_stage": (
                course.divergence if len(course.stages) > 1 else -1.0
            ),
            "share_invalid": share_invalid,
        },
    )


def _noise_shape(
    fits: list[LocalRegression], rng: np.random.Generator
) -> tuple[float, bool]:
    r"""Return the negentropy of the residuals, nats a number, and whether it is chance.

    .. math::
        J = H[\mathcal N(0, s^2)] - H[e],

    with H from the spacings of the sorted residuals, calibrated on Gaussian numbers,
    for each outcome and for all together: .18 for uniform noise, .42 for exponential.

    References:
        Vasicek, J. R. Stat. Soc. B 1976.
    """
    if not fits:
        return np.inf, False
    residual = np.concatenate([fit.standardized for fit in fits])
    residual = residual[:, residual.var(0) > 1e-6]  # a constant outcome has no noise
    if residual.size == 0:
        return 0.0, True
    columns = [*residual.T, residual.ravel()]
    excess, clear = [], []
    for size, members in (
        (len(residual), columns[:-1]),
        (residual.size, columns[-1:]),
    ):
        chance = [_negentropy(rng.standard_normal(size)) for _ in range(20)]
        mean, deviation = np.mean(chance), np.std(chance)
        for member in members:
            excess.append(_negentropy(member) - mean)
            clear.append(excess[-1] > HARD_NOISE + 4 * deviation)
    return float(max(*excess, 0.0)), not any(clear)


def _has_hard_edges(stages: list[Stage]) -> bool:
    r"""Return whether the residuals of all stages have lighter tails than a Gaussian.

    A few hundred numbers tell by their kurtosis what their entropy cannot tell yet. Its
    standard error is :math:`\sqrt{24 / n}` for Gaussian numbers (Fisher, Proc. Lond.
    Math. Soc. 1930). Regressions with misfit are left out, whose error has edges too.
    """
    residuals = [
        fit.standardized[:, fit.standardized.var(0) > 1e-6].ravel()
        for stage in stages
        for fit, mass in zip(stage.surrogate.regressions, stage.mass, strict=True)
        if mass > LIVE and not fit.has_misfit
    ]
    values = np.concatenate([np.zeros(0), *residuals])
    if values.size < 100:
        return False
    margin = 3.5 * np.sqrt(24 / values.size)
    return bool(kurtosis(values) < LIGHT_TAILS - margin)


def _negentropy(values: Array) -> float:
    n = len(values)
    m = max(1, int(n**0.5 / 2))
    ordered = np.sort(values)
    spacing = ordered[2 * m :] - ordered[: -2 * m]
    entropy = np.log(spacing * n / (2 * m) + 1e-300).mean()
    return float(0.5 * np.log(2 * np.pi * np.e * values.var()) - entropy)


def _trial_correlation(
    fits: list[LocalRegression], num_trials: int
) -> tuple[float, bool]:
    """Return the correlation of residuals across trials beyond chance."""
    if num_trials == 1 or not fits:
        return 0.0, True
    excess, count = 0.0, 0
    for fit in fits:
        n, q = fit.standardized.shape
        freedom = n - len(fit.root)
        correlation = fit.standardized.T @ fit.standardized / freedom
        apart = np.kron(np.eye(num_trials), np.ones((q // num_trials,) * 2)) == 0
        apart &= np.outer(fit.used, fit.used)
        excess += (correlation[apart] ** 2 - 1 / freedom).sum()
        count += int(apart.sum())
    if count == 0:
        return 0.0, True
    correlation = max(excess / count, 0.0) ** 0.5
    has_misfit = any(fit.has_misfit for fit in fits)  # which correlates as well
    return float(correlation), correlation < CORRELATED or has_misfit

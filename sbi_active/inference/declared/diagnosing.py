"""Diagnostics of a belief: what it takes for granted, and how far that holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sbi_active.arrays import Array
from sbi_active.inference.beliefs.diagnostics import Assumption, Diagnostics
from sbi_active.inference.engine import Fit, Settings, SimulatedPotential
from sbi_active.inference.engine.potential import SimulatedLikelihood
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation.noise.whitening import is_known_gaussian

#: Whether something that is taken for granted holds, its figure, and what to say with
#: that where it does not.
Doubt = tuple[bool, float, str]


@dataclass(frozen=True, kw_only=True)
class FitChecks:
    """Limits beyond which a fit is doubted.

    Attributes:
        coarse: Number of effective draws below which a warning is due.
        tolerated: Divergence of a normal fit to the draws, nats, likewise.
        moving: Share of moves accepted below which particles are stuck.
        remembered: Correlation of particles with where they began that is too
            much.
        num_checked: Number of draws that tail probabilities rest on.
        edge: Mass within 1 % of the edge of one parameter that calls for a
            warning.
        rare: Tail probability of the observation that calls for a warning.
        num_repeats: Number of draws of the noise for each of these.
    """

    coarse: float = 60.0
    tolerated: float = 0.1
    moving: float = 0.02
    remembered: float = 0.3
    num_checked: int = 200
    edge: float = 0.5
    rare: float = 1e-3
    num_repeats: int = 50


def diagnose_fit(
    fit: Fit,
    potential: SimulatedPotential,
    declared: SimulatedLikelihood,
    seed: int,
    own: FitChecks = FitChecks(),
) -> Diagnostics:
    """Return figures about a fit, what it assumes, and warnings in words.

    Args:
        fit: Posterior of the potential.
        potential: Potential whose noise may be inflated.
        declared: Likelihood under the noise as it was declared.
        seed: Seed of the draws behind tail probabilities.
        own: Settings.
    """
    base = potential.coordinates.base
    z = potential.coordinates.to_z(fit.u)
    near_edge = np.abs(z[:, base.bounded]) > 0.98
    edge_mass = float((fit.weight @ near_edge).max(initial=0.0))
    rng = np.random.default_rng(derive_seed(seed, "tail"))
    rows = rng.choice(len(z), size=own.num_checked, p=fit.weight)
    *tails, joint = _tail_probability(declared, base.to_theta(z[rows]), seed, own)
    found = fit.found
    return judged(
        _doubts(fit, own),
        (tails, joint),
        edge_mass,
        own,
        effective_sample_size=fit.effective_sample_size,
        error_nats=float(max(fit.effective_sample_size, 1e-9) ** -0.5),
        figures={
            "likelihood": "simulated",
            "method": fit.method,
            "num_stages": len(fit.pool.proposals),
            "num_modes": 0 if found is None else len(found.modes),
            "num_uninformed": int(fit.free.sum()),
            "log_evidence": fit.log_evidence,
            "log_evidence_error": fit.standard_error,
            "prior_edge_mass": edge_mass,
        },
    )


def _doubts(fit: Fit, own: FitChecks) -> dict[str, Doubt]:
    """Return what a fit takes for granted, by name."""
    effective, dim = fit.effective_sample_size, int((~fit.free).sum())
    needed = max(own.coarse, dim * (dim + 3) / (4 * own.tolerated))
    doubts: dict[str, Doubt] = {
        "enough_draws": (
            effective >= needed,
            effective,
            "SA114 the belief rests on {:.0f} effective draws, fewer than the "
            f"{needed:.0f} that {dim} parameters ask for, so that its log density is "
            f"off by about {max(effective, 1e-9) ** -0.5:.2g} nats; raise "
            "num_histories",
        )
    }
    if fit.particles is None:
        doubts["light_tails"] = (
            fit.tail_shape <= Settings().largest_shape,
            fit.tail_shape,
            "SA116 few draws outweigh all others (tail shape {:.2g}), so that the "
            "belief may miss where they are from; raise num_histories",
        )
    else:
        moved = fit.particles
        doubts["particles_move"] = (
            moved.acceptance >= own.moving and moved.memory <= own.remembered,
            moved.acceptance,
            "SA117 {:.1%} of the moves of the particles were accepted, too few for "
            "them to reach the posterior; raise num_histories",
        )
    if fit.found is not None and not fit.is_rough:
        doubts["mode_found_twice"] = (
            fit.found.num_found >= 2,
            fit.found.num_found,
            f"SA118 the best mode was found by one of {fit.found.num_starts} searches, "
            "so that a better one may be missed; check against another seed",
        )
    return doubts


def judged(
    doubts: Mapping[str, Doubt],
    tails: tuple[list[float], float],
    edge_mass: float,
    own: FitChecks = FitChecks(),
    **known: Any,
) -> Diagnostics:
    """Return diagnostics of a belief: what it takes for granted, and warnings.

    Args:
        doubts: Things that are taken for granted, by name.
        tails: Tail probability of each trial, and of all.
        edge_mass: Mass of the belief near the edge of one parameter.
        own: Limits.
        known: Further diagnostics.
    """
    warnings = [text.format(f) for holds, f, text in doubts.values() if not holds]
    each, joint = tails
    if joint < own.rare or min(each) < own.rare / len(each):
        warnings.append(
            "SA102 the observations are unlike anything simulated (tail probability "
            f"{min(joint, *each):.1g}): the simulator lacks something, the prior "
            "excludes the truth, or a measurement is wrong"
        )
    if edge_mass > own.edge:
        warnings.append(
            f"SA103 {edge_mass:.0%} of the belief lies within 1 % of the prior's "
            "edge: the prior may exclude the truth"
        )
    return Diagnostics(
        trustworthy=not warnings,
        warnings=(*warnings,),
        assumptions={
            name: Assumption(bool(holds), float(figure))
            for name, (holds, figure, _) in doubts.items()
        },
        tail_probability=joint,
        tail_probability_of_trial=(*each,),
        **known,
    )


def _tail_probability(
    likelihood: SimulatedLikelihood,
    theta: Tensor,
    seed: int,
    own: FitChecks = FitChecks(),
) -> list[float]:
    r"""Return the probability that noise is less likely than what was observed.

    .. math::
        P\big(p(x' | \theta) \le p(x_o | \theta)\big), \quad \theta \sim b,\;
        x' \sim p(x | \theta),

    a trial and, last, for all trials.

    References:
        Gelman, Meng & Stern, Statistica Sinica 1996 (realized discrepancies).
    """
    size, tail = len(theta) * own.num_repeats, []
    total_observed, total_simulated = np.zeros(size), np.zeros(size)
    for k, x in enumerate(likelihood.x):
        observed = np.repeat(likelihood.terms(theta, k), own.num_repeats)
        simulated = np.zeros(size)
        if bool(x.isfinite().any()):
            with forked_generators(derive_seed(seed, "tail", k)):
                simulated = _noise_terms(likelihood, theta, k, own)
        tail.append(_share(simulated <= observed))
        total_observed += observed
        total_simulated += simulated
    return [*tail, _share(total_simulated <= total_observed)]


def _noise_terms(
    likelihood: SimulatedLikelihood,
    theta: Tensor,
    trial: int,
    own: FitChecks = FitChecks(),
) -> Array:
    """Return log densities of draws of a trial's noise where it is seen, shape (n r,).

    Those of Gaussian noise are its peak less half a chi-square.
    """
    noise, x = likelihood.noise, likelihood.x[trial]
    if is_known_gaussian(noise):
        freedom = torch.tensor(0.5 * float(x.isfinite().sum()))
        half = torch.distributions.Gamma(freedom.double(), 1.0)
        drawn = half.sample(torch.Size([len(theta) * own.num_repeats]))
        return likelihood.peak[trial] - drawn.numpy()
    mean = torch.from_numpy(likelihood.table.mean(theta, likelihood.action[trial])[0])
    mean = mean.repeat_interleave(own.num_repeats, 0)
    draws = torch.where(x.isfinite(), noise.sample(mean).double(), torch.nan)
    return noise.log_prob(draws, mean).double().numpy()


def _share(exceeds: NDArray[np.bool_]) -> float:
    return float((exceeds.sum() + 1) / (exceeds.size + 1))

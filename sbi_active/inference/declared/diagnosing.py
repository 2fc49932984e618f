"""Diagnostics of a belief: what it takes for granted, and how far that holds.

``doubts.md`` beside this file has what is said where something does not.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.arrays import Array
from sbi_active.inference.beliefs.diagnostics import Assumption, Diagnostics
from sbi_active.inference.engine import Fit, Settings, SimulatedPotential
from sbi_active.inference.engine.potential import SimulatedLikelihood
from sbi_active.seeding import derive_seed, forked_generators

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
    near_edge = np.abs(z[:, base.bounded]) > 0.98
    edge_mass = float((fit.weight @ near_edge).max(initial=0.0))
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
        edge_mass: Mass of the belief within 1 % of the edge of one parameter.
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

    for k, x in enumerate(likelihood.x):
        observed = np.repeat(likelihood.terms(theta, k), num_repeats)
        simulated = np.zeros(size)
        if bool(x.isfinite().any()):
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
    if noise.is_known_gaussian:
        freedom = torch.tensor(0.5 * float(x.isfinite().sum()))
        half = torch.distributions.Gamma(freedom.double(), 1.0)
        drawn = half.sample(torch.Size([len(theta) * num_repeats]))
        return likelihood.peak[trial] - drawn.numpy()
    mean = torch.from_numpy(likelihood.table.mean(theta, likelihood.action[trial])[0])
    mean = mean.repeat_interleave(num_repeats, 0)
    draws = torch.where(x.isfinite(), noise.sample(mean).double(), torch.nan)
    return noise.log_prob(draws, mean).double().numpy()

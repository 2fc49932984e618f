r"""Few parameters under declared noise: importance sampling from a Student mixture.

The mixture begins at the normal approximations of the modes and is fitted anew to all
weighted draws so far, each weighted under the mixture of all proposals,

.. math::
    w_i = \frac{p(u_i)\, L(u_i)}{\sum_k n_k\, q_k(u_i) / n} .

References:
    Cornuet, Marin, Mira & Robert, Scand. J. Stat. 2012 (adaptive multiple importance
    sampling); Veach & Guibas, SIGGRAPH 1995 (the balance heuristic).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.inference.declared.importance import WeightedPool
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.declared.simulated_likelihood import SimulatedLikelihood
from sbi_active.inference.sampling.bridge import NormalMixture
from sbi_active.inference.sampling.normal_coordinates import NormalCoordinates
from sbi_active.inference.sampling.population import GaussianMixture
from sbi_active.inference.sampling.student_mixture import StudentMixture
from sbi_active.inference.sampling.weights import log_sum_exp, systematic

Array = NDArray[Any]

NUM_DRAWS = 8  # times num_effective, a round
MIN_ROUNDS, MAX_ROUNDS = 3, 10
ENOUGH = 6.0  # times num_effective: with half of it, heavy tails are cut by a tenth
NUM_COMPONENTS = 4
WIDE, WIDER = 1.5, 1.2  # than the modes, and than the draws
JITTER = 0.1  # of repeated draws, in deviations


def mixture_sample(
    likelihood: SimulatedLikelihood,
    coordinates: NormalCoordinates,
    guess: NormalMixture,
    settings: RefinementOptions,
    rng: np.random.Generator,
) -> WeightedPool | None:
    """Return weighted draws of the posterior; None where too few are effective.

    Args:
        likelihood: Likelihood of all trials.
        coordinates: Coordinates in which the prior is nearly standard normal.
        guess: Normal approximations at the modes.
        settings: Number of effective draws.
        rng: Source of the draws.
    """
    base, num = coordinates.base, int(NUM_DRAWS * settings.num_effective)
    mixtures = [StudentMixture(guess.means, WIDE * guess.factors, guess.weights)]
    z, log_likelihood = np.zeros((0, coordinates.dim)), np.zeros(0)
    for number in range(1, MAX_ROUNDS + 1):
        new = coordinates.to_z(mixtures[-1].sample(num, rng))
        new = base.to_z(base.to_theta(new[base.inside(new)]))
        new = new[base.inside(new)]  # the parameters that are simulated
        z = np.concatenate([z, new])
        found = likelihood(base.to_theta(new))
        log_likelihood = np.concatenate([log_likelihood, found])
        u = coordinates.from_z(z)
        each = np.stack([mixture.log_prob(u) for mixture in mixtures])
        log_own = log_sum_exp(each, axis=0) - np.log(number)
        log_own = log_own + coordinates.log_slope(u)
        pool = WeightedPool(
            *(z, base.log_prior(z), log_likelihood, log_own, log_own),
            *(np.ones(len(z), dtype=bool), number * num, [], len(likelihood)),
        )
        if not np.isfinite(pool.log_evidence):
            return None
        effective = pool.effective_sample_size
        if number >= MIN_ROUNDS and effective >= ENOUGH * settings.num_effective:
            return pool
        u = u[systematic(pool.weight, num, rng.random())]
        u = u + JITTER * u.std(0) * rng.standard_normal(u.shape)
        fit = GaussianMixture.fit(u, NUM_COMPONENTS, rng)
        mixtures.append(
            StudentMixture(fit.mean, WIDER * fit.factor, np.exp(fit.log_weight))
        )
    return None

"""Draws of a posterior that is narrow where rows are and flat where none are."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.inference.emulation.likelihood import PooledLikelihood
from sbi_active.inference.regression.regions import PriorProposal
from sbi_active.inference.rounds.rows import UnexplainedOutcomeError
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.normal_coordinates import NormalCoordinates
from sbi_active.inference.sampling.population import (
    GaussianMixture,
    Particles,
    StudentProposal,
)
from sbi_active.inference.sampling.smc import bridge
from sbi_active.inference.sampling.student_mixture import (
    Defended,
    NormalMixture,
    Proposal,
)

Array = NDArray[Any]

NUM_PARTICLES, NUM_TEMPERED = 3_000, 2_000
NUM_COMPONENTS = 8
INFLATION = 4.0  # of the covariance of the last belief, where the next one begins
NUM_FITS, ENOUGH = 4, 0.4  # of importance samples; share of one that is effective
AGREE = 0.1  # nats of evidence


def around(
    points: Array, coordinates: PriorCoordinates, rng: np.random.Generator
) -> StudentProposal:
    """Return a proposal about points, shape (n, d), with a share of the prior."""
    base = PriorProposal(coordinates)
    return StudentProposal.fit(points, NUM_COMPONENTS, base, rng)


def sample_posterior(
    likelihood: PooledLikelihood, points: Array, rng: np.random.Generator
) -> Particles:
    """Return particles that came from about points (n, d) and from the prior.

    Far from its rows a process does not know, so that a wide plateau surrounds the peak
    that it knows. What comes from the prior may stay there, and say nothing: all its
    particles count. What begins at the last belief may miss another peak. Where their
    evidences differ, both places are drawn from.

    Args:
        likelihood: Of all trials.
        points: Draws of the last belief.
        rng: Source of randomness.

    Raises:
        UnexplainedOutcomeError: If nothing has a likelihood.
    """
    c = likelihood.coordinates
    u = NormalCoordinates(c, rng, keeps_edges=False)
    fit = GaussianMixture.fit(u.from_z(points), NUM_COMPONENTS, rng)
    wide = np.exp(fit.log_weight), fit.mean, INFLATION**0.5 * fit.factor
    flat = np.ones(1), np.zeros((1, u.dim)), np.eye(u.dim)[None]
    found: list[Particles] = []
    for where in (wide, flat):
        there = bridge(
            u.log_prior,
            lambda v: likelihood.log_likelihood(u.to_z(v)),
            NormalMixture(*where),
            rng,
            num_particles=NUM_TEMPERED,
        )
        if there is not None:
            found.append(_settled(likelihood, u.to_z(there.u), rng))
    found = [p for p in found if np.isfinite(p.log_normalizer)]
    if not found:
        raise UnexplainedOutcomeError(
            "expected outcomes that some parameters may explain; got none with a "
            "likelihood; correct the outcome, or leave the trial out"
        )
    evidence = [p.log_normalizer for p in found]
    if max(evidence) - min(evidence) > AGREE:
        both = Defended(found[0].proposal, found[1].proposal, 0.5)
        return _weighed(likelihood, both, 2 * NUM_PARTICLES, rng)
    return max(found, key=lambda p: p.effective_sample_size)


def _settled(
    likelihood: PooledLikelihood, points: Array, rng: np.random.Generator
) -> Particles:
    """Return the best of some importance samples, each from a fit to the last."""
    best = None
    for _ in range(NUM_FITS):
        proposal = around(points, likelihood.coordinates, rng)
        particles = _weighed(likelihood, proposal, NUM_PARTICLES, rng)
        size = particles.effective_sample_size
        if best is None or size > best.effective_sample_size:
            best = particles
        if size > ENOUGH * NUM_PARTICLES or not np.isfinite(particles.log_normalizer):
            break
        points = particles.resample(NUM_TEMPERED, rng)
    assert best is not None
    return best


def _weighed(
    likelihood: PooledLikelihood, proposal: Proposal, num: int, rng: np.random.Generator
) -> Particles:
    z = proposal.sample(num, rng)
    return Particles(z, likelihood.log_joint(z) - proposal.log_prob(z), proposal)

"""The belief under a learned likelihood: the prior times a product over trials."""

from __future__ import annotations

import numpy as np
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.inference.products.product import NUM_COMPONENTS, Product
from sbi_active.inference.refinement.learned_belief import LearnedBelief
from sbi_active.inference.regression.regions import PriorProposal
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.population import (
    GaussianMixture,
    StudentProposal,
    population_monte_carlo,
)
from sbi_active.inference.sampling.student_mixture import Proposal

#: Effective draws below which the normalizer is off by more than a tenth of a nat.
ENOUGH = 100.0


def sample_product(
    prior: Distribution,
    product: Product,
    hint: Tensor | None,
    rng: np.random.Generator,
    *,
    num_particles: int,
    defensive: float,
) -> LearnedBelief:
    r"""Return the belief of a product, by annealed importance sampling.

    .. math::
        b(\theta) = (1 - \epsilon)\, \frac{p(\theta)}{Z} \prod_k q(x_k | \theta, \xi_k)
        + \epsilon\, p(\theta)

    Args:
        prior: The original prior.
        product: The learned likelihood of all trials.
        hint: Draws around the posterior, shape (n, theta_dim), such as those of the
            belief before; None begins at the prior.
        rng: Source of randomness.
        num_particles: Of the importance sample.
        defensive: Share of the prior in the belief.
    """
    coordinates: PriorCoordinates = product.coordinates
    base: Proposal = PriorProposal(coordinates)
    if hint is not None:
        mixture = GaussianMixture.fit(coordinates.to_z(hint), NUM_COMPONENTS, rng)
        base = StudentProposal(mixture, base)
    particles, num_steps = population_monte_carlo(
        product.log_joint, base, rng, num_particles=num_particles
    )
    belief = LearnedBelief(prior, product, particles, defensive=defensive)
    belief.label = "product over trials"
    effective = particles.effective_sample_size
    belief.diagnostics = Diagnostics().extended(
        effective_sample_size=effective,
        likelihood="learned",
        log_normalizer=particles.log_normalizer,
        num_steps=num_steps,
    )
    if effective < ENOUGH:
        belief.diagnostics = belief.diagnostics.warned(
            f"the belief rests on {effective:.0f} effective draws; raise num_particles"
        )
    return belief

"""The belief under a learned likelihood: the prior times a product over trials."""

from __future__ import annotations

import numpy as np
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.inference.engine.learned import learned_fit
from sbi_active.inference.products.product import Product
from sbi_active.inference.refinement.learned_belief import LearnedBelief
from sbi_active.inference.rounds.rows import UnexplainedOutcomeError

#: Effective draws below which the normalizer is off by more than a tenth of a nat.
ENOUGH = 100.0


def sample_product(
    prior: Distribution,
    product: Product,
    hint: Tensor | None,
    rng: np.random.Generator,
    *,
    num_effective: float,
    defensive: float,
) -> LearnedBelief:
    r"""Return the belief of a product, sampled by :func:`.infer`.

    .. math::
        b(\theta) = (1 - \epsilon)\, \frac{p(\theta)}{Z} \prod_k q(x_k | \theta, \xi_k)
        + \epsilon\, p(\theta)

    Args:
        prior: The original prior.
        product: The learned likelihood of all trials.
        hint: Draws around the posterior, shape (n, theta_dim), such as those of the
            belief before; None begins at the prior.
        rng: Source of randomness.
        num_effective: Number of effective draws.
        defensive: Share of the prior in the belief.
    """
    near = None if hint is None else product.coordinates.to_z(hint)
    fit = learned_fit(product, rng, near=near, num_effective=num_effective)
    if fit is None:
        raise UnexplainedOutcomeError(
            "expected outcomes that some parameters may explain; got none with a "
            "density under the network; correct the outcome, or leave the trial out"
        )
    belief = LearnedBelief(prior, fit, defensive=defensive)
    belief.label = "product over trials"
    effective = fit.fit.effective_sample_size
    belief.diagnostics = Diagnostics().extended(
        effective_sample_size=effective,
        likelihood="learned",
        log_normalizer=fit.fit.log_evidence,
    )
    if effective < ENOUGH:
        belief.diagnostics = belief.diagnostics.warned(
            f"SA114 the belief rests on {effective:.0f} effective draws; raise "
            "num_particles"
        )
    return belief

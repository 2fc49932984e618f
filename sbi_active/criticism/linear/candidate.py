"""A model that was fitted."""

from __future__ import annotations

from dataclasses import dataclass

from sbi_active.criticism.linear.errors import Grams, Posterior
from sbi_active.criticism.linear.left_out import LeftOut
from sbi_active.criticism.linear.model import LinearModel


@dataclass
class Candidate:
    """A model that was fitted.

    Attributes:
        model: Linearized at its best fit.
        grams: Gram matrices of its rows.
        posterior: Posterior under the shared errors.
        left: Errors of the model on left-out parts of the trials.
        log_prior: Probability of its set of effects, nats.
    """

    model: LinearModel
    grams: Grams
    posterior: Posterior
    left: LeftOut
    log_prior: float

    @property
    def log_p(self) -> float:
        """Unnormalized log posterior probability with a residual process, nats."""
        return self.log_prior + self.posterior.log_process

    @property
    def log_p_sensor(self) -> float:
        """Unnormalized log posterior probability with the sensor's error, nats."""
        return self.log_prior + self.posterior.log_sensor

    @property
    def log_p_either(self) -> float:
        """Unnormalized log posterior probability with either, nats."""
        return self.log_prior + self.posterior.log_evidence

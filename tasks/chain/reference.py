"""The posterior of a chain by long tempered SMC from the prior."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.sampling.coordinates import (
    NormalCoordinates,
    PriorCoordinates,
)
from sbi_active.inference.sampling.mixtures import StudentMixture
from sbi_active.inference.sampling.smc import bridge
from sbi_active.inference.sampling.weights import (
    effective_sample_size,
    log_sum_exp,
    normalized,
    systematic,
)
from sbi_active.tasks.chain.model import NOISE_SD, mean

__all__ = ["ChainReference"]

FORGOTTEN = 0.01  # correlation with where particles were, after the moves of a step
MAX_MOVES = 200
NUM_WEIGHTED, WIDER = 20_000, 1.2  # draws of the normal fit, its covariance's factor


class ChainReference:
    r"""Particles that went from the prior to the posterior, from one seed.

    No derivative and no guess at the posterior enters: the first particles are draws of
    the prior, and the likelihood is the closed form. At the end, draws of a normal fit
    to the particles are weighted; where many of them count, they replace the
    particles, and their mean weight is the evidence. That of the particles alone is too
    low by half a nat, since their moves lag behind the temperature. Two seeds tell the
    error.

    Args:
        prior: Of the task.
        action: Shape (t, 2).
        x: Displacements in metres, shape (t, masses, 10).
        seed: Of the particles.
        num_particles: Their number.

    Attributes:
        draws: Equally weighted, shape (n, parameters), float64.
        log_evidence: Nats; 0 without trials.
        standard_error: Of log_evidence.

    Raises:
        RuntimeError: If the particles do not reach the posterior.
    """

    def __init__(
        self,
        prior: Distribution,
        action: Tensor,
        x: Tensor,
        *,
        seed: int = 0,
        num_particles: int = 2_000,
    ) -> None:
        rng = np.random.default_rng(seed)
        self._prior, self._action, self._x = prior, action.float(), x.double()
        u = NormalCoordinates(PriorCoordinates(prior, rng), rng)
        eye = np.eye(u.dim)
        found = bridge(
            u.log_prior,
            lambda v: self.log_likelihood(u.to_theta(v)).numpy(),
            StudentMixture(np.zeros((1, u.dim)), eye[None], freedom=np.inf),
            rng,
            num_particles=num_particles,
            max_moves=MAX_MOVES,
            forgotten=FORGOTTEN,
        )
        if found is None:
            raise RuntimeError(
                "expected particles at the posterior; got none; raise num_particles"
            )
        self.draws = u.to_theta(found.u).double()
        self.log_evidence = found.log_evidence
        self.standard_error = found.standard_error
        factor = np.linalg.cholesky(WIDER * np.cov(found.u.T))
        normal = StudentMixture(found.u.mean(0)[None], factor[None], freedom=np.inf)
        v = normal.sample(NUM_WEIGHTED, rng)
        theta = u.to_theta(v)
        log_w = self.log_likelihood(theta).numpy() + u.log_prior(v)
        log_w = log_w - normal.log_prob(v)
        effective = effective_sample_size(log_w)
        if effective > num_particles:
            self.log_evidence = float(log_sum_exp(log_w) - np.log(len(v)))
            self.standard_error = float(np.sqrt(1 / effective - 1 / len(v)))
            rows = systematic(normalized(log_w), len(v), rng.random())
            self.draws = theta[torch.from_numpy(rows)].double()

    def log_likelihood(self, theta: Tensor) -> Tensor:
        """Return the log likelihood of all trials, (n, parameters) -> (n,)."""
        total = torch.zeros(len(theta), dtype=torch.float64)
        for xi, x in zip(self._action, self._x, strict=True):
            y = mean(theta.double(), xi.expand(len(theta), -1))
            square = ((x - y) / NOISE_SD).square().flatten(1).sum(1)
            scale = np.log(NOISE_SD) + 0.5 * np.log(2 * np.pi)
            total += -0.5 * square - x.numel() * scale
        return total

    def log_prob(self, theta: Tensor) -> Tensor:
        """Return the log posterior density, (n, parameters) -> (n,)."""
        log_prior = self._prior.log_prob(theta.float()).double()
        return log_prior + self.log_likelihood(theta) - self.log_evidence

    def sample(self, num: int, *, seed: int = 0) -> Tensor:
        """Return particles, drawn again and again, shape (num, parameters)."""
        generator = torch.Generator().manual_seed(seed)
        return self.draws[torch.randint(len(self.draws), (num,), generator=generator)]

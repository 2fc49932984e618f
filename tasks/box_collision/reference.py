r"""Posterior of the box collision by adaptive importance sampling.

.. math::
    p(\theta \mid \mathcal D) = \frac{1}{Z}\, p(\theta) \prod_t
    p(x_t \mid \theta, \xi_t), \qquad
    p(x \mid \theta, \xi) = \begin{cases}
        \mathcal N(x; f_\xi(\theta), \sigma^2 I) & \text{on the table} \\
        1 & \text{both off the table} \\
        0 & \text{one of them off it}
    \end{cases}

Nothing is fitted to it but the proposals, so that the density is exact up to the error
of :math:`\log Z`, and the cost is simulations: one a trial and draw.
"""

from __future__ import annotations

import math
import warnings

import torch
from torch import Tensor

from sbi_active.simulation import SimulatorModel, simulate
from sbi_active.tasks.box_collision.proposal import (
    KernelMixture,
    effective_size,
    largest_power,
    log_normal,
)

__all__ = ["BoxCollisionReference"]

FEWEST = 100  # effective draws, below which a warning is due
FIRST_SHARE = 0.3  # of the draws, from the prior
STAGES = 10  # share the others


class BoxCollisionReference:
    r"""The posterior :math:`p(\theta \mid \mathcal D)` and the gain of a further trial.

    Draws come from the prior and then from kernel mixtures around the draws so far,
    weighted by a power of the likelihood that rises to 1; all of them count, under the
    mixture of all proposals (Cornuet et al. 2012, adaptive multiple importance
    sampling). They live in :math:`z = \Phi^{-1}(\theta)`, where the prior is N(0, I).

    Args:
        simulator: Of the task, with Gaussian noise of standard deviation > 0.
        action: Speeds, shape (t, 1); t = 0 gives the prior.
        x: Outcomes, shape (t, 3); NaN throughout off the table.
        num_simulations: To spend; num_simulations / t draws.
        seed: Of the draws.
        num_workers: Processes to simulate in. More than one gives positions in single
            precision, which moves log densities by about 1e-4.

    Raises:
        ValueError: If the noise is 0, the shapes do not fit, or no draw explains the
            trials.

    Attributes:
        log_evidence: :math:`\log Z`, nats.
        log_evidence_se: Its standard error by the delta method, nats.
        effective_sample_size: :math:`(\sum w)^2 / \sum w^2`.
        num_simulations: Spent so far, those of densities included.

    References:
        Cornuet, Marin, Mira & Robert, Scandinavian Journal of Statistics 2012.
    """

    def __init__(
        self,
        simulator: SimulatorModel,
        action: Tensor,
        x: Tensor,
        *,
        num_simulations: int = 60_000,
        seed: int = 0,
        num_workers: int = 1,
    ) -> None:
        noise = simulator.noise
        if noise is None or not bool((noise.parameters > 0).all()):
            raise ValueError(
                "expected noise > 0, without which there is no posterior density; got "
                "0; do choose get_task('box_collision', noise=0.005)"
            )
        self.action = torch.as_tensor(action, dtype=torch.float32).reshape(-1, 1)
        self.x = torch.as_tensor(x, dtype=torch.float32)
        if len(self.x) != len(self.action) or (
            len(self.x) and self.x.shape[1:] != (3,)
        ):
            raise ValueError(
                "expected action (t, 1) and x (t, 3); got "
                f"{tuple(self.action.shape)} and {tuple(self.x.shape)}; do give one "
                "row a trial"
            )
        self._simulator, self._noise = simulator, noise
        self._num_workers = num_workers
        self._generator = torch.Generator().manual_seed(seed)
        self.num_simulations = 0
        num = max(num_simulations // max(len(self.x), 1), 20 * STAGES)
        self._adapt(num)

    def log_prob(self, theta: Tensor) -> Tensor:
        """Return the log posterior density, (n, 3) -> (n,), by t simulations a row."""
        theta = torch.as_tensor(theta).double().reshape(-1, 3)
        inside = ((theta >= 0) & (theta <= 1)).all(-1)
        log_prob = torch.full((len(theta),), -torch.inf, dtype=torch.float64)
        log_prob[inside] = self._log_likelihood(theta[inside]) - self.log_evidence
        return log_prob

    def sample(self, num_samples: int, *, seed: int | None = None) -> Tensor:
        """Return draws, shape (n, 3), from the weighted ones, with replacement.

        Args:
            num_samples: Number n.
            seed: Of the choice; None goes on with the generator of the reference.
        """
        generator = (
            self._generator if seed is None else torch.Generator().manual_seed(seed)
        )
        index = torch.multinomial(self._weight, num_samples, True, generator=generator)
        return self._theta[index]

    def expected_information_gain(
        self, action: Tensor, *, num_samples: int = 400, seed: int = 0
    ) -> Tensor:
        r"""Return the gain of a further trial, (a, 1) -> (a,), nats.

        .. math::
            U(\xi) = \frac1n \sum_i \log \frac{p(x_i | \theta_i, \xi)}
            {\frac1n \sum_j p(x_i | \theta_j, \xi)}

        with draws from the posterior, a lower bound that is at most log n.

        Args:
            action: Candidates, shape (a, 1).
            num_samples: Draws n, each of them one simulation a candidate.
            seed: Of draws and noise.
        """
        theta = self.sample(num_samples, seed=seed)
        generator = torch.Generator().manual_seed(seed + 1)
        shape = (num_samples, 3)
        noise = torch.randn(shape, generator=generator, dtype=torch.float64)
        sd = self._noise.parameters.double().expand(3)
        gains = []
        for xi in torch.as_tensor(action, dtype=torch.float32).reshape(-1, 1):
            mean = self._mean(theta, xi)
            x = mean + sd * noise
            is_off = mean.isnan().any(-1)
            squares = ((x[:, None] - mean) / sd).square().sum(-1)
            log_density = (-0.5 * squares).nan_to_num(nan=-torch.inf)
            log_density[is_off[:, None] & is_off] = 0.0
            log_marginal = log_density.logsumexp(-1) - math.log(num_samples)
            gains.append((log_density.diagonal() - log_marginal).mean())
        return torch.stack(gains) if gains else torch.empty(0, dtype=torch.float64)

    def _adapt(self, num: int) -> None:
        """Draw, weigh and draw again; set the weighted draws and the evidence."""
        first = max(int(FIRST_SHARE * num), 100)
        z = torch.randn(first, 3, generator=self._generator, dtype=torch.float64)
        log_likelihood = self._log_likelihood(_theta(z))
        proposals: list[tuple[int, KernelMixture]] = []
        log_mixture = log_normal(z) + math.log(first)  # of draws by all proposals
        for _ in range(STAGES if len(self.x) else 0):
            if not bool(log_likelihood.isfinite().any()):
                raise ValueError(
                    "expected a draw of the prior that explains every trial's outcome; "
                    f"got none of {len(z)}; do raise num_simulations, or check which "
                    "trials are invalid"
                )
            log_ratio = log_normal(z) - log_mixture
            power = largest_power(log_ratio, log_likelihood)
            weight = (log_ratio + power * log_likelihood).softmax(0)
            mixture = KernelMixture.around(z, weight, self._generator)
            new = mixture.sample((num - first) // STAGES, self._generator)

            log_new = log_normal(new) + math.log(first)
            for size, earlier in proposals:
                log_new = torch.logaddexp(
                    log_new, earlier.log_prob(new) + math.log(size)
                )
            proposals.append((len(new), mixture))
            log_mixture = torch.cat([log_mixture, log_new])
            z = torch.cat([z, new])
            log_mixture = torch.logaddexp(
                log_mixture, mixture.log_prob(z) + math.log(len(new))
            )
            log_likelihood = torch.cat(
                [log_likelihood, self._log_likelihood(_theta(new))]
            )
        log_weight = log_normal(z) + log_likelihood - log_mixture
        self.log_evidence = float(log_weight.logsumexp(0))
        self.effective_sample_size = float(effective_size(log_weight))
        variance = 1 / self.effective_sample_size - 1 / len(z)
        self.log_evidence_se = max(variance, 0.0) ** 0.5
        self._theta, self._weight = _theta(z), log_weight.softmax(0)
        if self.effective_sample_size < FEWEST:
            warnings.warn(
                f"the posterior rests on {self.effective_sample_size:.0f} effective "
                f"draws of {len(z)}, so that its log densities are off by "
                f"{self.log_evidence_se:.1f} nats or more: the outcome of a rocking "
                "cube jumps with theta by more than the noise; do raise "
                f"num_simulations from {self.num_simulations}",
                stacklevel=3,
            )

    def _log_likelihood(self, theta: Tensor) -> Tensor:
        """Return the log likelihood of all trials, shape (n,)."""
        total = torch.zeros(len(theta), dtype=torch.float64)
        for xi, x in zip(self.action, self.x, strict=True):
            mean = self._mean(theta, xi)
            is_off = mean.isnan().any(-1)
            if bool(x.isnan().all()):
                total[~is_off] = -torch.inf
            else:
                log_density = self._noise.log_prob(x.expand(len(theta), 3), mean)
                total += log_density.masked_fill(is_off, -torch.inf)
        return total

    def _mean(self, theta: Tensor, action: Tensor) -> Tensor:
        """Return noise-free positions of one action, shape (n, 3)."""
        self.num_simulations += len(theta)
        if not len(theta):
            return torch.empty(0, 3, dtype=torch.float64)
        model, action = self._simulator, action.expand(len(theta), 1)
        if self._num_workers == 1:
            return model.mean(theta, action).double()
        bare = SimulatorModel(model.fn, setup=model.setup)
        rows = simulate(bare, theta, action, seed=0, num_workers=self._num_workers)
        return rows.x.double()


def _theta(z: Tensor) -> Tensor:
    return torch.special.ndtr(z)

r"""Posterior of the box collision by adaptive importance sampling.

.. math::
    p(\theta \mid \mathcal D) = \frac{1}{Z}\, p(\theta) \prod_t
    p(x_t \mid \theta, \xi_t), \qquad
    p(x \mid \theta, \xi) = \begin{cases}
        \mathcal N(x; f_\xi(\theta), \sigma^2 I) & \text{on the table} \\
        1 & \text{both off the table} \\
        0 & \text{one of them off it}
    \end{cases}

Nothing is fitted to it but the proposals: prior and likelihood are exact at every
parameter, so that :math:`\log p(\theta | \mathcal D)` has one error, that of
:math:`\log Z`, the same at all of them. The cost is simulations.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from sbi_active.simulation import SimulatorModel, simulate
from sbi_active.tasks.box_collision.draws import Draws, Evidence
from sbi_active.tasks.box_collision.proposal import (
    KernelMixture,
    effective_size,
    largest_power,
)

if TYPE_CHECKING:
    from sbi_active.tasks.box_collision.task import BoxCollisionTask

__all__ = ["BoxCollisionReference", "exact_posterior"]

FEWEST = 100  # effective draws, below which a warning is due
NUM_FIRST = 1_000  # draws from the prior
NUM_STAGE = 400  # draws from each proposal


def exact_posterior(
    task: BoxCollisionTask,
    trials: Sequence[Any],
    *,
    num_particles: int = 500,
    seed: int = 0,
    past: BoxCollisionReference | None = None,
) -> BoxCollisionReference:
    """Return the posterior of a campaign's trials, nearly exact.

    Args:
        task: With noise > 0.
        trials: With ``action`` (1,), ``x`` (3,) and ``status``; those that are missing
            or pending are left out.
        num_particles: Effective draws to reach, unless it takes more than 200,000
            simulations.
        seed: Of the draws.
        past: The posterior of some of these trials, whose draws are used again.

    Returns:
        The posterior: ``theta`` and ``weight``, ``log_evidence`` and
        ``log_evidence_se``, ``log_prob``.

    Example:
        >>> from sbi_active.campaign import Trial
        >>> from sbi_active.tasks import get_task
        >>> task = get_task("box_collision")
        >>> x = task.real_system(torch.tensor([5.0]), seed=0)
        >>> trial = Trial(0, torch.tensor([5.0]), x, "ok")
        >>> posterior = exact_posterior(task, [trial], num_particles=50)
        >>> bool(posterior.log_evidence_se < 0.2)
        True
    """
    used = [t for t in trials if t.status in ("ok", "invalid")]
    return BoxCollisionReference(
        task.simulator,
        torch.stack([t.action for t in used]) if used else torch.empty(0, 1),
        torch.stack([t.x for t in used]) if used else torch.empty(0, 3),
        num_effective=num_particles,
        num_simulations=200_000,
        seed=seed,
        past=past,
    )


class BoxCollisionReference:
    r"""The posterior :math:`p(\theta \mid \mathcal D)` and the gain of a further trial.

    Draws come from the prior and then from kernel mixtures around the draws so far,
    weighted by a power of the likelihood that rises to 1; all of them count, under the
    mixture of all proposals (Cornuet et al. 2012, adaptive multiple importance
    sampling). They live in :math:`z = \Phi^{-1}(\theta)`, where the prior is N(0, I).
    More are drawn until enough are effective.

    Args:
        simulator: Of the task, with Gaussian noise of standard deviation > 0.
        action: Speeds, shape (t, 1); t = 0 gives the prior.
        x: Outcomes, shape (t, 3); NaN throughout off the table.
        num_effective: Effective draws to reach.
        num_simulations: To spend at most; a stage that was begun is finished.
        seed: Of the draws.
        past: The posterior of fewer trials, or other ones, with this simulator: its
            draws and simulations are used again.
        num_workers: Processes to simulate in. More than one gives positions in single
            precision, which moves log densities by about 1e-4.

    Raises:
        ValueError: If the noise is 0, the shapes do not fit, ``past`` has another
            simulator, or no draw explains the trials.

    Attributes:
        theta: Draws, shape (n, 3).
        weight: Theirs, shape (n,), summing to 1.
        log_evidence: :math:`\log Z`, nats.
        log_evidence_se: Its standard error by the delta method, nats; that of every
            log density too. As the draws shape the proposals, log Z is too small by up
            to one standard error on average (measured on a closed form).
        effective_sample_size: :math:`(\sum w)^2 / \sum w^2`.
        num_simulations: Spent here, those of densities included.

    References:
        Cornuet, Marin, Mira & Robert, Scandinavian Journal of Statistics 2012.
    """

    def __init__(
        self,
        simulator: SimulatorModel,
        action: Tensor,
        x: Tensor,
        *,
        num_effective: int = 500,
        num_simulations: int = 60_000,
        seed: int = 0,
        past: BoxCollisionReference | None = None,
        num_workers: int = 1,
    ) -> None:
        noise = simulator.noise
        if noise is None or not bool((noise.parameters > 0).all()):
            raise ValueError(
                "expected noise > 0, without which there is no posterior density; got "
                "0; choose get_task('box_collision', noise=0.005)"
            )
        self.action = torch.as_tensor(action, dtype=torch.float32).reshape(-1, 1)
        self.x = torch.as_tensor(x, dtype=torch.float32)
        if len(self.x) != len(self.action) or (
            len(self.x) and self.x.shape[1:] != (3,)
        ):
            raise ValueError(
                "expected action (t, 1) and x (t, 3); got "
                f"{tuple(self.action.shape)} and {tuple(self.x.shape)}; give one "
                "row a trial"
            )
        if past is not None and past._simulator is not simulator:
            raise ValueError(
                "expected a past posterior with this simulator; got one with another; "
                "leave past out"
            )
        self._simulator, self._noise = simulator, noise
        self._num_workers = num_workers
        self._generator = torch.Generator().manual_seed(seed)
        self.num_simulations = 0
        self._trials = [
            Evidence(
                speed=float(xi),
                log_likelihood=partial(self._log_density, one),
                ceiling=float(self._log_density(one, one[None])),
            )
            for xi, one in zip(self.action, self.x.double(), strict=True)
        ]
        self._draws = Draws() if past is None else past._draws
        self._adapt(num_effective, num_simulations)

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
        index = torch.multinomial(self.weight, num_samples, True, generator=generator)
        return self.theta[index]

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

    def _adapt(self, num_effective: int, num_simulations: int) -> None:
        """Draw, weigh and draw again; set the weighted draws and the evidence."""
        if not len(self._draws):
            first = min(NUM_FIRST, max(num_simulations // 3, 100))
            self._draws = Draws().with_more(first, None, self._generator)
        while True:
            log_likelihood, is_exact = self._draws.log_likelihood(
                self._trials, self._at
            )
            log_ratio = self._draws.log_ratio
            if not bool(log_likelihood.isfinite().any()):
                raise ValueError(
                    "expected a draw of the prior that explains every trial's outcome; "
                    f"got none of {len(log_ratio)}; check which trials are invalid"
                )
            log_weight = (log_ratio + log_likelihood).where(is_exact, -torch.inf)
            self.effective_sample_size = float(effective_size(log_weight))
            if (
                self.effective_sample_size >= num_effective
                or self.num_simulations >= num_simulations
                or not self._trials
            ):
                break
            # A bound of the likelihood serves as well where proposals are concerned.
            power = largest_power(log_ratio, log_likelihood)
            weight = (log_ratio + power * log_likelihood).softmax(0)
            proposal = KernelMixture.around(self._draws.z, weight, self._generator)
            left = num_simulations - self.num_simulations
            num = min(NUM_STAGE, max(left // len(self._trials), 20))
            self._draws = self._draws.with_more(num, proposal, self._generator)
        self.log_evidence = float(log_weight.logsumexp(0))
        variance = 1 / self.effective_sample_size - 1 / len(log_weight)
        self.log_evidence_se = max(variance, 0.0) ** 0.5
        self.theta, self.weight = _theta(self._draws.z), log_weight.softmax(0)
        if self.effective_sample_size < FEWEST:
            warnings.warn(
                f"the posterior rests on {self.effective_sample_size:.0f} effective "
                f"draws of {len(log_weight)}, so that its log densities are off by "
                f"{self.log_evidence_se:.1f} nats or more: the outcome of a rocking "
                "cube jumps with theta by more than the noise; raise "
                f"num_simulations from {self.num_simulations}",
                stacklevel=3,
            )

    def _log_likelihood(self, theta: Tensor) -> Tensor:
        """Return the log likelihood of all trials, shape (n,)."""
        total = torch.zeros(len(theta), dtype=torch.float64)
        for trial in self._trials:
            total += trial.log_likelihood(self._mean(theta, trial.speed))
        return total

    def _log_density(self, x: Tensor, mean: Tensor) -> Tensor:
        """Return the log likelihood of one outcome (3,), means (n, 3) -> (n,)."""
        is_off = mean.isnan().any(-1)
        impossible = torch.full((len(mean),), -torch.inf, dtype=torch.float64)
        if bool(x.isnan().all()):
            return impossible.masked_fill(is_off, 0.0)
        log_density = self._noise.log_prob(x.expand(len(mean), 3), mean)
        return log_density.where(~is_off, impossible)

    def _at(self, z: Tensor, speed: float) -> Tensor:
        return self._mean(_theta(z), speed)

    def _mean(self, theta: Tensor, speed: float | Tensor) -> Tensor:
        """Return noise-free positions of one action, shape (n, 3)."""
        self.num_simulations += len(theta)
        if not len(theta):
            return torch.empty(0, 3, dtype=torch.float64)
        model = self._simulator
        action = torch.full((len(theta), 1), float(speed))
        if self._num_workers == 1:
            return model.mean(theta, action).double()
        bare = SimulatorModel(model.fn, setup=model.setup)
        rows = simulate(bare, theta, action, seed=0, workers=self._num_workers)
        return rows.x.double()


def _theta(z: Tensor) -> Tensor:
    return torch.special.ndtr(z)

r"""Exact inference and information gain for the oscillator, from its likelihood.

Nothing here is closed form, but every estimate is importance sampling with the known
likelihood, consistent, and carries its standard error.

All sampling happens in :math:`z = \Phi^{-1}(u)`, with :math:`u` the parameters scaled
to the unit cube, where the prior is :math:`\mathcal N(0, I)` and has no edges.

References:
    Cappe, Douc, Guillin, Marin & Robert, "Adaptive importance sampling in general
    mixture classes", Statistics and Computing 18 (2008), algorithm M-PMC.
    Rainforth, Cornish, Yang, Warrington & Wood, "On nesting Monte Carlo estimators",
    ICML 2018, for the bias of the nested estimate.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sbi_active.tasks.oscillator.model import NOISE_SD, PRIOR_HIGH, PRIOR_LOW, mean
from sbi_active.tasks.oscillator.proposal import (
    BLOCK,
    DIM,
    LOG_2PI,
    effective_size,
    fit_mixture,
    log_normal,
    next_power,
    standard_normal,
)

__all__ = ["OscillatorReference"]

OUTCOMES = 6
LOW, WIDTH = PRIOR_LOW.double(), (PRIOR_HIGH.double() - PRIOR_LOW.double())

MAX_STAGES = 200  # before giving up
FINAL_STAGES = 3  # with the whole likelihood, the last of which is reported
LOST_MASS = 2e-3  # of the posterior, by capping the weights in rejection sampling


class OscillatorReference:
    r"""The posterior :math:`p(\theta \mid \mathcal D)` and what the next trial tells.

    The likelihood is raised to a power that grows from 0 to 1; at each power a mixture
    of Student-t densities is fitted to weighted draws of the one before (M-PMC). The
    last mixture :math:`q` gives

    .. math::
        Z = \frac1n \sum_{i=1}^n w_i, \quad
        w_i = \frac{p(\mathcal D \mid \theta_i)\, p(\theta_i)}{q(\theta_i)}, \qquad
        \mathrm{se}(\log Z) = \sqrt{1 / \mathrm{ESS} - 1 / n}.

    Args:
        action: Actions :math:`(A, \Omega)`, shape (t, 2). No trials give the prior.
        x: Readings in cm, shape (t, 6).
        seed: Seed of the particles.
        num_particles: Draws n of the last stage; a tempered one has a fifth as many.
        noise_sd: Standard deviation of the readings, cm.

    Attributes:
        log_evidence: :math:`\log p(\mathcal D)` in nats, 0 without trials.
        log_evidence_se: Its standard error, and that of every log density.
        effective_sample_size: :math:`(\sum_i w_i)^2 / \sum_i w_i^2` of the last stage.

    Raises:
        ValueError: If shapes differ or a value is not finite.

    Example:
        >>> posterior = OscillatorReference([[1.0, 5.0]], [[0.1, 0.8, 0.2, -0.6, 0, 0]])
        >>> posterior.sample(3, seed=0).shape
        torch.Size([3, 4])
    """

    def __init__(
        self,
        action: object,
        x: object,
        *,
        seed: int = 0,
        num_particles: int = 20_000,
        noise_sd: float = NOISE_SD,
    ) -> None:
        self.action = _rows(action, "action", 2)
        self.x = _rows(x, "x", 6)
        if len(self.action) != len(self.x):
            raise ValueError(
                f"expected one x per action; got {len(self.action)} actions and "
                f"{len(self.x)} x; pass as many rows"
            )
        self.noise_sd = noise_sd
        self.log_evidence, self.log_evidence_se = 0.0, 0.0
        self.effective_sample_size = float(num_particles)
        self._proposal, self._cap = None, 0.0
        if len(self.x):
            self._adapt(num_particles, torch.Generator().manual_seed(seed))

    def log_prob(self, theta: Tensor) -> Tensor:
        """Log density with respect to theta.

        Args:
            theta: Parameters, shape (n, 4).

        Returns:
            Log density in nats, shape (n,), float64; -inf outside the box.
        """
        theta = _rows(theta, "theta", DIM)
        inside = ((theta >= LOW) & (theta <= LOW + WIDTH)).all(-1)
        clipped = theta.clamp(LOW, LOW + WIDTH)
        log_density = (
            self._log_likelihood(clipped) - self.log_evidence - WIDTH.log().sum()
        )
        return torch.where(inside, log_density, -math.inf)

    def sample(self, n: int, *, seed: int | None = None) -> Tensor:
        r"""Independent draws by rejection from the mixture.

        A draw is kept with probability :math:`\min(1, w / c)`, with c such that at
        most .002 of the posterior's mass lies where :math:`w > c`.

        Args:
            n: Number of draws.
            seed: None uses torch's global generator.

        Returns:
            Parameters, shape (n, 4), float64.
        """
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        return _theta(self.sample_normal(n, generator))

    def expected_information_gain(
        self,
        action: object,
        *,
        num_outer: int = 1_000,
        num_inner: int = 100_000,
        seed: int = 0,
    ) -> tuple[Tensor, Tensor]:
        r"""Expected information gain of one more trial, by nested Monte Carlo.

        .. math::
            \mathrm{EIG}(\xi) = -\frac1n \sum_{i=1}^n \log \hat p(x_i \mid \xi)
            - H[\varepsilon], \qquad
            \hat p(x_i \mid \xi) = \frac1m \sum_{j=1}^m p(x_i \mid \theta_j, \xi)

        with :math:`(\theta_i, x_i)` and :math:`\theta_j` from the belief, and
        :math:`|\varepsilon_i|^2` as a control variate of known mean. The same draws
        serve every action.

        By Jensen's inequality this is too high, by half the relative variance of
        :math:`\hat p`, averaged, to second order. That is estimated, and subtracted.

        Args:
            action: Actions :math:`(A, \Omega)`, shape (a, 2).
            num_outer: Number of outer draws n.
            num_inner: Number of inner draws m. A gain of g nats leaves
                about :math:`m e^{-g}` of them effective.
            seed: Seed of all draws.

        Returns:
            Gain in nats and its standard error, both (a,).
        """
        generator = torch.Generator().manual_seed(seed)
        outer = self.sample_normal(num_outer, generator)
        inner = self.sample_normal(num_inner, generator)
        noise = standard_normal((num_outer, OUTCOMES), generator)
        excess = 0.5 * noise.square().sum(-1) - OUTCOMES / 2
        entropy = OUTCOMES * (0.5 * LOG_2PI + 0.5 + math.log(self.noise_sd))
        found = []
        for xi in _rows(action, "action", 2):
            x, means = (
                self.mean(outer, xi) + self.noise_sd * noise,
                self.mean(inner, xi),
            )
            log_marginal, variance = self._log_marginal(x, means)
            gain = -log_marginal - entropy
            covariance = torch.cov(torch.stack([gain, excess]))
            gain = gain - covariance[0, 1] / covariance[1, 1] * excess
            error = ((gain.var() + variance.mean()) / num_outer).sqrt()
            found.append(torch.stack([gain.mean() - 0.5 * variance.mean(), error]))
        gains, errors = torch.stack(found).T if found else torch.empty(2, 0)
        return gains, errors

    def _log_marginal(self, x: Tensor, means: Tensor) -> tuple[Tensor, Tensor]:
        """Log means of p(x_i | theta_j) over j, and their variances, both (n,)."""
        values, variances = [], []
        for rows in x.split(64):  # 50 MB at a time
            squares = torch.cdist(rows, means).square()
            weight = (squares - squares.amin(-1, keepdim=True)) / self.noise_sd**2
            weight = (-0.5 * weight).exp()
            total = weight.sum(-1)
            top = self.log_noise(squares.amin(-1))
            values.append(top + total.log() - math.log(len(means)))
            share = torch.linalg.vecdot(weight, weight) / total.square()
            variances.append(share - 1 / len(means))
        return torch.cat(values), torch.cat(variances)

    def mean(self, z: Tensor, action: Tensor) -> Tensor:
        """Readings of one action, shape (*z.shape[:-1], 6)."""
        rows = _theta(z).reshape(-1, DIM).split(BLOCK)
        readings = torch.cat([mean(theta, action[None]) for theta in rows])
        return readings.reshape(*z.shape[:-1], OUTCOMES)

    def _log_likelihood(self, theta: Tensor) -> Tensor:
        """Of all trials, shape (n,)."""
        total = torch.zeros(len(theta), dtype=torch.float64)
        for xi, x in zip(self.action, self.x, strict=True):
            rows = [mean(block, xi[None]) for block in theta.split(BLOCK)]
            total += self.log_noise((x - torch.cat(rows)).square().sum(-1))
        return total

    def log_noise(self, squares: Tensor) -> Tensor:
        """Log density of a residual from its sum of squares."""
        scale = 0.5 * LOG_2PI + math.log(self.noise_sd)
        return -0.5 * squares / self.noise_sd**2 - OUTCOMES * scale

    def log_belief(self, z: Tensor) -> Tensor:
        """Log posterior density of z, shape (n,)."""
        log_likelihood = self._log_likelihood(_theta(z))
        return log_likelihood + log_normal(z) - self.log_evidence

    def _adapt(self, num_particles: int, generator: torch.Generator) -> None:
        """Fit the proposal and estimate the evidence (M-PMC with tempering)."""
        tempered = num_particles // 5
        z = standard_normal((tempered, DIM), generator)
        log_likelihood, log_ratio = self._log_likelihood(_theta(z)), torch.zeros(())
        power, left, mixture = 0.0, FINAL_STAGES, None
        for _ in range(MAX_STAGES):
            power = next_power(log_ratio, log_likelihood, power)
            left -= power == 1
            log_weight = log_ratio + power * log_likelihood
            mixture = fit_mixture(z, log_weight.softmax(0), mixture, generator)
            z = mixture.sample(tempered if left else num_particles, generator)
            log_likelihood = self._log_likelihood(_theta(z))
            log_ratio = log_normal(z) - mixture.log_prob(z)
            if not left:
                break
        else:
            raise RuntimeError(
                f"expected the full likelihood within {MAX_STAGES} stages; got to its "
                f"power {power:.3g}; raise num_particles from {num_particles}"
            )

        n, log_weight = len(z), log_ratio + log_likelihood
        self._proposal = mixture
        self.log_evidence = float(log_weight.logsumexp(0) - math.log(n))
        self.effective_sample_size = float(effective_size(log_weight))
        self.log_evidence_se = (1 / self.effective_sample_size - 1 / n) ** 0.5
        # largest weights first: mass above c falls as c grows
        weight = (log_weight - self.log_evidence).exp().sort(descending=True).values
        above = weight.cumsum(0) - weight * torch.arange(1, n + 1)
        self._cap = float(weight[int((above / n <= LOST_MASS).sum()) - 1])

    def sample_normal(self, n: int, generator: torch.Generator | None) -> Tensor:
        """Draw z from the posterior, shape (n, 4)."""
        if self._proposal is None:
            return standard_normal((n, DIM), generator)
        kept, num_kept = [torch.empty(0, DIM, dtype=torch.float64)], 0
        while num_kept < n:
            num_tried = int(1.1 * self._cap * (n - num_kept)) + 100
            z = self._proposal.sample(min(num_tried, 16 * BLOCK), generator)
            log_weight = self.log_belief(z) - self._proposal.log_prob(z)
            u = torch.rand(len(z), generator=generator, dtype=torch.float64)
            kept.append(z[self._cap * u < log_weight.exp()])
            num_kept += len(kept[-1])
        return torch.cat(kept)[:n]


def _theta(z: Tensor) -> Tensor:
    """Parameters of z: the normal distribution function, scaled to the box."""
    return LOW + WIDTH * torch.special.ndtr(z)


def _rows(values: object, name: str, dim: int) -> Tensor:
    rows = torch.as_tensor(values).double()
    if rows.numel() == 0:
        rows = rows.reshape(0, dim)
    if rows.ndim != 2 or rows.shape[1] != dim:
        raise ValueError(
            f"expected {name} of shape (n, {dim}); got {tuple(rows.shape)}; give "
            "one row each"
        )
    if not bool(rows.isfinite().all()):
        raise ValueError(f"expected finite {name}; got nan or inf; drop these rows")
    return rows

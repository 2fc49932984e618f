"""The log evidence of outcomes: simulations, and local draws through an emulator."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.design.estimators.base import whitening
from sbi_active.design.estimators.emulator import Emulated, MeanEmulator
from sbi_active.inference.sampling.mixtures import log_student
from sbi_active.seeding import forked_generators
from sbi_active.simulation import NoiseModel
from sbi_active.support import within_support


@dataclass
class Evidence:
    """The log evidence of outcomes of one candidate, log p(x_i).

    Outcomes near a simulation that the emulator misses are taken to be linear from its
    own, by the emulator's slope.

    Attributes:
        known: Simulations and the emulator of their outcomes without noise.
        candidate: Number of the candidate.
        share: Share of each simulation's outcomes that are complete, shape (n,).
        belief: Belief over the parameters.
        num_local: Number of local draws.
        degrees: Degrees of freedom of the Student-t proposals; even.
        wider: Width of the proposals, in those of the linearized posterior.
        enough: Effective draws of the belief that need no local ones.
        rare: Relative variance of an evidence that rests on a draw or two.
    """

    known: Emulated
    candidate: int
    share: Tensor
    belief: Distribution
    num_local: int
    degrees: int = 6
    wider: float = 1.2
    enough: int = 50
    rare: float = 0.5

    def __post_init__(self) -> None:
        simulations, a = self.known.simulations, self.candidate
        assert simulations.mean is not None
        assert simulations.noise is not None
        self.noise = simulations.noise
        self.x, self.mean = simulations.x[a].double(), simulations.mean[a].double()
        self.counted, self.scale = simulations.counted[a], self.known.scale[a]
        self.knots = self.known.emulator.knots

    @cached_property
    def log_belief(self) -> Tensor:
        """Log density of the belief at the simulations."""
        return _log_belief(self.belief, self.known.emulator, self.knots)

    def __call__(self, slope: Tensor, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        r"""Return log evidences without Jensen's bias, and what they rest on.

        That is the share of each simulation in them, summed over the outcomes, and the
        share of local draws in each, all of shape (n,). Where a draw or two are all
        that there is, as where a bound of the belief is near, the evidence is at least
        that of the linear model in an orthant at :math:`\theta_i`:

        .. math::
            p(x_i) \ge p(x_i | \theta_i)\, b(\theta_i)\, (\pi / 2)^{d / 2}
            \left| J^\top J + \Sigma^{-1} \right|^{-1/2} .
        """
        m, num_local = int(self.counted.sum()) - 1, self.num_local
        parts = []
        influence, local = torch.zeros(2, len(self.knots), dtype=torch.float64)
        with forked_generators(0):  # the same base draws for all candidates
            for some in rows.split(256):
                shared = self._shared(some)
                weight = shared.softmax(1)
                log_p, variance = _log_mean(shared, m, m)
                poor = torch.nonzero(~(variance + 1 / m <= 1 / self.enough))[:, 0]
                if len(poor):
                    i = some[poor]
                    terms, least = self._with_local(slope[i], i, shared[poor])
                    log_q, spread = _log_mean(terms, m, m + num_local)
                    own = terms.softmax(1).nan_to_num()
                    weight[poor] = own[:, :-num_local]
                    few = ~(spread <= self.rare) & ~(log_q >= least)
                    log_p[poor] = torch.where(few, least, log_q)
                    variance[poor] = torch.where(few, 0.0, spread)
                    local[i] = torch.where(few, 1.0, own[:, -num_local:].sum(1))
                parts.append(log_p + 0.5 * variance)
                influence += self.share[some] @ weight.nan_to_num()
        return torch.cat(parts), influence, local

    def _shared(self, rows: Tensor) -> Tensor:
        """Log density p(x_i | theta_j), -inf for j = i, shape (rows, n)."""
        x = self.x[rows]
        known = (self.share > 0).reshape(-1, *[1] * (x.ndim - 1))
        mean = torch.where(known, self.mean, 0)
        log_term = _pairwise(self.noise, x, mean)
        log_term += self.share.log()
        log_term[torch.arange(len(rows)), rows] = -torch.inf
        return log_term

    def _with_local(
        self, slope: Tensor, i: Tensor, shared: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Log terms of the sum of simulations and local draws, shape (i, n + l).

        The second result is a lower bound of the evidences, shape (i,).
        """
        x = self.x[i]
        location, precision = self._linearized(x, slope, i)
        factor = self.wider * torch.linalg.inv(torch.linalg.cholesky(precision)).mT
        (n, d), num_local = location.shape, self.num_local
        ratio = math.log(num_local / (len(self.knots) - 1))
        step = _student((n, num_local, d), self.degrees) @ factor.mT
        z = location[:, None] + step
        flat, outcome = z.flatten(0, 1), x.repeat_interleave(num_local, 0)
        log_b = _log_belief(self.belief, self.known.emulator, flat)
        mean = (self._outcomes(z, slope, i) * self.scale).reshape(outcome.shape)
        local = self.noise.log_prob(outcome, mean) + self._log_complete(flat)
        log_t = _log_student(step, factor, self.degrees).flatten()
        local = local - torch.nn.functional.softplus(ratio + log_t - log_b)
        log_t = _log_student(self.knots - location[:, None], factor, self.degrees)
        shared = shared - torch.nn.functional.softplus(ratio + log_t - self.log_belief)
        least = self.noise.log_prob(x, self.mean[i]) + self.log_belief[i]
        least += 0.5 * (d * math.log(math.pi / 2) - torch.logdet(precision))
        return torch.cat([shared, local.reshape(n, num_local)], 1), least

    def _outcomes(self, z: Tensor, slope: Tensor, i: Tensor) -> Tensor:
        """Noise-free outcomes at z (i, k, d) around simulations i, (i, k, q)."""
        found = self.known.emulator(z.flatten(0, 1), self.known.columns(self.candidate))
        found = found.unflatten(0, z.shape[:2])
        own = (self.mean[i].flatten(1) / self.scale)[:, None]
        straight = own + (z - self.knots[i][:, None]) @ slope.mT
        return torch.where(
            self.known.missed[self.candidate, i][:, None, None], straight, found
        )

    def _log_complete(self, z: Tensor) -> Tensor:
        """Log probability of a complete outcome, that of the nearest simulation."""
        share = self.share[self.counted]
        if bool((share == 1).all()):
            return torch.zeros(len(z), dtype=z.dtype)
        nearest = torch.cdist(z, self.knots[self.counted]).argmin(1)
        return share[nearest].log()

    def _linearized(self, x: Tensor, slope: Tensor, i: Tensor) -> tuple[Tensor, Tensor]:
        """Location and precision of the posterior given x, one step from theta_i.

        The belief enters as the Gaussian of its draws' moments.
        """
        z, (center, white) = self.knots[i], whitening(self.knots)
        prior = white @ white.mT
        residual = (x - self.mean[i]).flatten(1) / self.scale
        precision = slope.mT @ slope + prior
        gradient = (slope.mT @ residual[..., None])[..., 0] - (z - center) @ prior
        step = torch.linalg.solve(precision, gradient[..., None])[..., 0]
        return z + step, precision


def _pairwise(noise: NoiseModel, x: Tensor, mean: Tensor) -> Tensor:
    """Log density of every x (n, ...) at every mean (k, ...), shape (n, k)."""
    if noise.is_known_gaussian:  # one product
        white, other = (noise.whiten(part).flatten(1) for part in (x, mean))
        peak = noise.log_prob(mean[:1], mean[:1])
        return peak - 0.5 * torch.cdist(white, other).square_()
    n, k = len(x), len(mean)
    paired = noise.log_prob(
        x.repeat_interleave(k, 0), mean.repeat(n, *[1] * (x.ndim - 1))
    )
    return paired.reshape(n, k)


def _log_belief(belief: Distribution, emulator: MeanEmulator, z: Tensor) -> Tensor:
    """Log density of the belief in the emulator's coordinates, shape (n,)."""
    theta = emulator.parameters(z).float()
    inside = within_support(belief, theta)
    log_b = torch.full((len(theta),), -torch.inf).double()
    if bool(inside.any()):
        density = getattr(belief, "smooth_log_prob", belief.log_prob)
        log_b[inside] = density(theta[inside]).double()
    return log_b - torch.linalg.slogdet(emulator.transform).logabsdet


def _log_mean(log_term: Tensor, m: int, num: int) -> tuple[Tensor, Tensor]:
    """Log of the sum over m, and its variance from num draws; over the last axis."""
    top = log_term.amax(-1, keepdim=True)
    top = torch.where(top.isfinite(), top, 0.0)
    weight = (log_term - top).exp_()
    first, second = weight.sum(-1), torch.linalg.vecdot(weight, weight)
    return top[:, 0] + first.log() - math.log(m), second / first.square() - 1 / num


def _student(shape: tuple[int, ...], degrees: int) -> Tensor:
    uniform = torch.rand(*shape[:-1], degrees // 2, dtype=torch.float64)
    chi_square = -2 * torch.log1p(-uniform).sum(-1, keepdim=True)
    normal = torch.randn(shape, dtype=torch.float64)
    return normal * (degrees / chi_square).sqrt()


def _log_student(offset: Tensor, factor: Tensor, degrees: int) -> Tensor:
    """Log density at offsets (n, k, d) with triangular factors (n, d, d)."""
    square = (offset @ torch.linalg.inv(factor).mT).square().sum(-1)
    log_volume = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1, keepdim=True)
    known = square.numpy(), log_volume.numpy(), offset.shape[-1], degrees
    return torch.from_numpy(log_student(*known))

r"""Expected information gain of the oscillator's next trial, by nested Monte Carlo."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from sbi_active.tasks.oscillator.proposal import (
    DIM,
    LOG_2PI,
    draw_student,
    effective_size,
    invert,
    log_student,
    standard_normal,
)

if TYPE_CHECKING:
    from sbi_active.tasks.oscillator.reference import OscillatorReference

__all__ = ["NestedGain"]

OUTCOMES = 6
ENOUGH = 100  # effective inner draws that need no local proposal
NEWTON_STEPS = 2
WIDER = 1.4  # than the Laplace approximation, the proposal of the pilot draws
NUM_PILOT = 64  # inner draws that the local proposal is fitted to
NUM_LOCAL = 64  # inner draws from it
NEGLIGIBLE = 1e-6  # of the largest term of a sum


class NestedGain:
    """The estimate of :meth:`OscillatorReference.expected_information_gain`.

    Args:
        posterior: The belief.
    """

    def __init__(self, posterior: OscillatorReference) -> None:
        self._posterior = posterior

    def estimate(
        self, action: Tensor, num_outer: int, num_inner: int, seed: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Gain, standard error and the delta method's estimate of the bias."""
        generator = torch.Generator().manual_seed(seed)
        outer = self._posterior.sample_normal(num_outer, generator)
        noise = standard_normal((num_outer, OUTCOMES), generator)
        inner = self._posterior.sample_normal(num_inner, generator)
        inner_belief = self._posterior.log_belief(inner)
        excess = 0.5 * noise.square().sum(-1) - OUTCOMES / 2
        entropy = OUTCOMES * (0.5 * LOG_2PI + 0.5 + math.log(self._posterior.noise_sd))

        gains, errors, biases = [], [], []
        for xi in action:
            x = self._posterior.mean(outer, xi) + self._posterior.noise_sd * noise
            log_marginal, variance = self._log_marginal(
                x, xi, outer, inner, inner_belief, generator
            )
            bias = 0.5 * variance.mean()
            gain = -log_marginal - entropy
            covariance = torch.cov(torch.stack([gain, excess]))
            gain = gain - covariance[0, 1] / covariance[1, 1] * excess
            gains.append(gain.mean() - bias)
            errors.append(((gain.var() + variance.mean()) / num_outer).sqrt())
            biases.append(bias)
        gains, errors, biases = (
            torch.stack(column) if column else torch.empty(0, dtype=torch.float64)
            for column in (gains, errors, biases)
        )
        return gains, errors, biases

    def _log_marginal(
        self,
        x: Tensor,
        action: Tensor,
        outer: Tensor,
        inner: Tensor,
        inner_belief: Tensor,
        generator: torch.Generator,
    ) -> tuple[Tensor, Tensor]:
        """Log marginals log p(x_i | xi) and their variances, both (n,).

        Args:
            x: Shape (n, 6).
            action: Shape (2,).
            outer: The z that x came from, shape (n, 4).
            inner: Draws z of the belief, shape (m, 4).
            inner_belief: Their log density, shape (m,).
            generator: Of the local draws.
        """
        m = len(inner)
        # -|x - f|^2 / 2 sd^2 as one product of matrices
        left = torch.nn.functional.pad(x / self._posterior.noise_sd, (0, 2), value=1.0)
        right = self._posterior.mean(inner, action) / self._posterior.noise_sd
        right = torch.nn.functional.pad(right, (0, 2), value=1.0)
        left[:, -1] = -0.5 * left[:, :-2].square().sum(-1)
        right[:, -2] = -0.5 * right[:, :-2].square().sum(-1)

        log_marginal, variance, few, pairs = [], [], [], []
        for rows in torch.arange(len(x)).split(128):
            log_term = left[rows] @ right.T + self._posterior.log_noise(torch.zeros(()))
            top = log_term.amax(-1, keepdim=True)
            weight = (log_term - top).exp()
            first = weight.sum(-1)
            second = torch.linalg.vecdot(weight, weight) / first.square()
            log_marginal.append(top[:, 0] + first.log() - math.log(m))
            variance.append(second - 1 / m)
            poor = torch.nonzero(second * ENOUGH > 1)[:, 0]
            # of the belief's draws, only those near x_i weigh anything
            i, j = torch.nonzero(weight[poor] > NEGLIGIBLE, as_tuple=True)
            pairs.append((i + sum(map(len, few)), j, log_term[poor[i], j]))
            few.append(rows[poor])

        log_marginal, variance, few = map(torch.cat, (log_marginal, variance, few))
        if len(few):
            i, j, log_term = map(torch.cat, zip(*pairs, strict=True))
            log_marginal[few], variance[few] = self._add_local(
                x[few],
                action,
                outer[few],
                inner,
                inner_belief,
                (i, j),
                log_term,
                generator,
            )
        return log_marginal, variance

    def _add_local(
        self,
        x: Tensor,
        action: Tensor,
        outer: Tensor,
        inner: Tensor,
        inner_belief: Tensor,
        pairs: tuple[Tensor, Tensor],
        log_term: Tensor,
        generator: torch.Generator,
    ) -> tuple[Tensor, Tensor]:
        r"""Log marginals where draws from a Student-t t_i join those of the belief.

        With m draws from the belief b and l from :math:`t_i`, fitted to weighted draws
        around the mode given :math:`x_i`,

        .. math::
            \hat p(x_i) = \frac1m \sum_{j=1}^{m + l} \frac{p(x_i \mid z_j)}
            {1 + \frac{l}{m} t_i(z_j) / b(z_j)}.

        Args:
            x: Outcomes, as in _log_marginal.
            action: Of each outcome, as there.
            outer: Parameters behind the outcomes, as there.
            inner: Draws of the belief, as there.
            inner_belief: Their log densities, as there.
            pairs: Rows i and draws j of the belief that matter to them, both (p,).
            log_term: log p(x_i | z_j) of these, shape (p,).
            generator: Of the local draws.
        """
        n, m, (i, j) = len(x), len(inner), pairs

        def draw(location: Tensor, scale: Tensor, num: int) -> tuple[Tensor, ...]:
            location, scale = location[:, None], scale[:, None]
            z = draw_student(location, scale, (n, num, DIM), generator)
            log_local = log_student(z - location, invert(scale))
            squares = (x[:, None] - self._posterior.mean(z, action)).square().sum(-1)
            log_belief = self._posterior.log_belief(z.reshape(-1, DIM)).reshape(n, num)
            return z, self._posterior.log_noise(squares), log_local - log_belief

        location, scale = self._laplace(x, action, outer, inner)
        scale = WIDER * scale
        z, log_likelihood, log_ratio = draw(location, scale, NUM_PILOT)
        log_weight = log_likelihood - log_ratio
        effective = effective_size(log_weight)[:, None, None]
        weight = log_weight.softmax(-1)[..., None]
        location = (weight * z).sum(1)
        offset = z - location[:, None]
        spread = (weight * offset).mT @ offset
        spread = (effective * spread + DIM * scale @ scale.mT) / (effective + DIM)
        scale = torch.linalg.cholesky(spread)

        share, inverse = NUM_LOCAL / m, invert(scale)
        _, log_likelihood, log_ratio = draw(location, scale, NUM_LOCAL)
        top = log_likelihood.amax(-1).scatter_reduce(0, i, log_term, "amax")
        weight = (log_likelihood - top[:, None]).exp() / (1 + share * log_ratio.exp())
        log_ratio = log_student(inner[j] - location[i], inverse[i]) - inner_belief[j]
        shared = (log_term - top[i]).exp() / (1 + share * log_ratio.exp())

        first = weight.sum(-1).index_add(0, i, shared)
        second = weight.square().sum(-1).index_add(0, i, shared.square())
        variance = second / first.square() - 1 / (m + NUM_LOCAL)
        return top + first.log() - math.log(m), variance

    def _laplace(
        self, x: Tensor, action: Tensor, z: Tensor, inner: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Mode and Cholesky factor given x, by Gauss-Newton steps from z.

        The belief enters as the Gaussian of its draws' moments.
        """
        posterior = self._posterior
        center, prior = inner.mean(0), torch.linalg.inv(torch.cov(inner.T))

        def linearize(z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            columns = [
                torch.func.jvp(
                    lambda z: self._posterior.mean(z, action),
                    (z,),
                    (axis.expand_as(z),),
                )
                for axis in torch.eye(DIM, dtype=torch.float64)
            ]
            residual = (x - columns[0][0]) / posterior.noise_sd
            jacobian = torch.stack([c[1] for c in columns], -1) / posterior.noise_sd
            offset = z - center
            misfit = residual.square().sum(-1) + (offset @ prior * offset).sum(-1)
            slope = (jacobian.mT @ residual[..., None])[..., 0] - offset @ prior
            return misfit, slope, jacobian.mT @ jacobian + prior

        misfit, slope, precision = linearize(z)
        for _ in range(NEWTON_STEPS):
            moved = z + torch.linalg.solve(precision, slope)
            new = linearize(moved)
            better = new[0] < misfit
            z = torch.where(better[:, None], moved, z)
            slope = torch.where(better[:, None], new[1], slope)
            precision = torch.where(better[:, None, None], new[2], precision)
            misfit = torch.where(better, new[0], misfit)
        return z, torch.linalg.cholesky(torch.linalg.inv(precision))

r"""Information gain by nested Monte Carlo, local draws through an emulator."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from sbi_active.design.estimators.base import (
    CandidateSimulations,
    InformationGainEstimator,
    at_least,
)
from sbi_active.design.estimators.emulator import MeanEmulator, declare, fill
from sbi_active.design.estimators.entropy import (
    EntropyGain,
    conditional_entropy,
    presence_information,
    presence_notes,
    presence_problems,
    with_control,
)
from sbi_active.design.estimators.evidence import Evidence, log_belief
from sbi_active.simulation import NoiseModel


class NestedGain(InformationGainEstimator):
    r"""Log likelihood less an importance-sampled log evidence.

    .. math::
        I(\theta; x | \xi) = E \left[ \log p(x_i | \theta_i) - \log p(x_i) \right],
        \qquad
        \hat p(x_i) = \frac1m \left[ \sum_{j \ne i} \frac{p(x_i | \theta_j)}
        {1 + \frac lm \frac{t_i(\theta_j)}{b(\theta_j)}}
        + \sum_{k=1}^{l} \frac{p(x_i | \theta_{ik})}
        {1 + \frac lm \frac{t_i(\theta_{ik})}{b(\theta_{ik})}} \right]

    The m = n - 1 other simulations are draws of the belief b with their exact
    noise-free outcomes. Where fewer than 50 of them are effective, l draws of a
    Student-t :math:`t_i` around the linearized posterior given :math:`x_i` join, every
    fourth of them close to :math:`\theta_i` instead, where the outcome is known. Their
    outcomes come from a :class:`.MeanEmulator` of
    the noise-free outcomes of all simulations, so no further ones are run.

    Jensen's bias, half the relative variance of :math:`\hat p`, is subtracted. The
    estimate is too large where the posterior has modes that neither the simulations
    nor the local draws find, and is off by the emulator's error, for which
    :meth:`problems` looks.

    Where noise is not declared, mean and noise are first learned from pairs of outcomes
    at the same parameters (:func:`.declare`):
    Gaussian noise of one covariance a candidate, and an outcome smooth in theta. The
    estimate is then the information of the learned model; its standard errors are
    without the error of learning.

    Where outcomes lack numbers, those that are complete are compared under the belief
    given completeness. The noise-free outcomes decide which parameters give complete
    ones, and elsewhere the nearest simulation does.

    Args:
        num_local: l.

    References:
        Rainforth et al., ICML 2018 (nested estimators); Owen & Zhou, JASA 2000 (the
        mixture weights); Ryan, JCGS 2003 (the expected information gain).
    """

    needs_noise = True
    needs_model = False

    def __init__(self, *, num_local: int = 16) -> None:
        self.num_local = at_least(num_local, 2, "num_local", 16)

    def _contributions(
        self, model: Any, simulations: CandidateSimulations, belief: Distribution
    ) -> Tensor:
        gain = presence_information(simulations)
        shares, counted = simulations.completeness, simulations.counted
        enough = _enough(simulations).tolist()
        learned = declare(simulations) if simulations.noise is None else None
        if learned is not None:
            simulations = learned.simulations
        mean, noise = _declared(simulations)
        entropy, surprise = conditional_entropy(simulations)
        q = mean[0, 0].numel()
        if learned is None:
            scale = noise_scale(simulations)
            emulator = _emulator(simulations, scale)
        else:
            scale, emulator = torch.ones(len(mean), q).double(), learned.emulator
        slopes = emulator.slope(emulator.knots)
        for a, share in enumerate(shares):
            if not enough[a]:
                continue  # too few measurements: what is present still counts
            rows = share > 0
            evidence = Evidence(
                emulator=emulator,
                columns=slice(a * q, (a + 1) * q),
                mean=mean[a].double(),
                scale=scale[a],
                share=share,
                counted=counted[a],
                noise=noise,
                belief=belief,
                log_belief=log_belief(belief, emulator, emulator.knots),
                num_local=self.num_local,
            )
            log_p, influence = evidence(
                simulations.x[a].double(),
                slopes[:, evidence.columns],
                torch.nonzero(rows)[:, 0],
            )
            log_p -= share[counted[a]].mean().log()
            gain[a, rows] += share[rows] * with_control(
                -log_p - entropy[a, rows], surprise[a, rows] - entropy[a, rows]
            )
            # What a simulation does to the evidence of others has mean zero: it adds to
            # errors and leaves the estimate.
            effect = torch.where(counted[a], share - influence, 0.0)
            gain[a] += effect - counted[a] * effect[counted[a]].mean()
        return gain

    @override
    def remarks(self, simulations: CandidateSimulations) -> list[str]:
        notes = presence_notes(simulations)
        few = int((~_enough(simulations)).sum())
        if few:
            notes.append(
                f"too few complete outcomes at {few} of {len(simulations.action)} "
                "actions: only which numbers are present counts, a lower bound"
            )
        if simulations.noise is None:
            notes.append(
                "noise not declared: it and the mean are learned from pairs, which can "
                "be off by 1 nat where x varies fast with theta"
            )
        return notes

    def problems(
        self, simulations: CandidateSimulations, *, few: int = 20, num_rows: int = 256
    ) -> list[str]:
        """Compare leave-one-out errors of emulator or smoothing with the noise.

        At most a quarter of the outcomes may be off by more than the noise's standard
        deviation, or half of their numbers by smoothing. Without declared noise, test
        as well whether it is Gaussian.

        Args:
            simulations: Simulations to look at.
            few: Complete outcomes that are too few for an emulator; five pairs for each
                number of x are needed to estimate its noise.
            num_rows: Number of rows to fit the emulator to.
        """
        needed = few
        if simulations.noise is None:
            needed = max(few, 5 * simulations.x[0, 0].numel())
        if int(simulations.complete.sum(1).max()) < needed:
            return [f"fewer than {needed} complete outcomes a candidate"]
        if simulations.noise is None:
            problems = EntropyGain().problems(simulations)
            missed = declare(simulations).score > 2
            share = float(missed.double().mean())
            if share > 0.5:
                problems.append(f"smoothing misses {share:.0%} of the numbers of x")
            return problems
        share = float(_is_missed(simulations, num_rows).double().mean())
        problems = presence_problems(simulations)
        if share <= 0.25:
            return problems
        return [
            *problems,
            f"the emulator misses {share:.0%} of outcomes by more than the noise",
        ]

    def doubts(
        self,
        simulations: CandidateSimulations,
        *,
        num_rows: int = 256,
        most: float = 0.6,
    ) -> list[str]:
        """Say where the emulator misses outcomes, whose gains are then too large.

        Args:
            simulations: Simulations with declared noise.
            num_rows: Number of rows to fit the emulator to.
            most: Share of an action's outcomes of which it may miss some number by more
                than the noise. Gains are right with .54 in a saturated oscillator, and
                twice to four times too large with .72 of a two-joint arm.
        """
        if simulations.noise is None:
            return []
        share = float(_is_missed(simulations, num_rows).any(2).double().mean(0).max())
        if share <= most:
            return []
        return [
            f"the emulator misses {share:.0%} of the outcomes of an action by more "
            "than the noise: its gain is too large, by tens of nats where noise is "
            "small; take it for an order of actions, and allow more num_samples"
        ]


def _is_missed(simulations: CandidateSimulations, num_rows: int) -> Tensor:
    """Return which numbers the emulator misses by more than the noise, (n, a, q)."""
    some = simulations.samples(slice(num_rows))
    error = _emulator(some, noise_scale(simulations)).error
    return (error.abs() > 1).reshape(len(error), len(simulations.x), -1)


def _emulator(simulations: CandidateSimulations, scale: Tensor) -> MeanEmulator:
    """Return the emulator of declared outcomes in units of their noise (a, q)."""
    theta, (mean, _) = simulations.theta.double(), _declared(simulations)
    filled = fill(theta, mean.flatten(2).double()) / scale[:, None]
    return MeanEmulator.fit(theta, filled.transpose(0, 1).flatten(1))


def noise_scale(simulations: CandidateSimulations) -> Tensor:
    """Root mean square of the noise, shape (a, numbers of x)."""
    mean, _ = _declared(simulations)
    square = (simulations.x - mean).flatten(2).double().square()
    finite = square.isfinite()
    square = torch.where(finite, square, 0.0).sum(1) / finite.sum(1).clamp_min(1)
    return torch.where(square > 0, square, 1.0).sqrt()


def _enough(simulations: CandidateSimulations, fewest: int = 8) -> Tensor:
    """Whether complete outcomes suffice to compare, or to learn from, shape (a,)."""
    needed = fewest
    if simulations.noise is None:
        needed = max(fewest, simulations.x[0, 0].numel() + 2)
    return simulations.complete.sum(1) >= needed


def _declared(simulations: CandidateSimulations) -> tuple[Tensor, NoiseModel]:
    assert simulations.mean is not None
    assert simulations.noise is not None
    return simulations.mean, simulations.noise

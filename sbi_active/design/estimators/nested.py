r"""Information gain by nested Monte Carlo, local draws through an emulator."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from sbi_active.design.estimators.base import (
    CandidateSimulations,
    InformationGainEstimator,
    at_least,
    whitening,
)
from sbi_active.design.estimators.emulator import emulated, learned
from sbi_active.design.estimators.entropy import (
    EntropyGain,
    conditional_entropy,
    presence_information,
    presence_notes,
    problems_of_noise,
    with_control,
)
from sbi_active.design.estimators.evidence import Evidence


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
    Student-t :math:`t_i` around the linearized posterior given :math:`x_i` join. Their
    outcomes come from a :class:`.MeanEmulator` of the noise-free outcomes of all
    simulations, so no further ones are run.

    Jensen's bias, half the relative variance of :math:`\hat p`, is subtracted. The
    estimate is too large where the posterior has modes that neither the simulations
    nor the local draws find.

    Where the emulator misses a left-out outcome by more than the noise, outcomes near
    it are linear from its own, :math:`f_i + \hat J_i (\theta - \theta_i)`, by the
    emulator's slope. If it misses most outcomes of an action (:meth:`needs_slopes`),
    the simulator gives slopes J of its own at some parameters, by steps of these, and

    .. math::
        \frac1k \sum_i w_i \left( \tfrac12 \log | \hat J_i^\top \hat J_i +
        \Sigma^{-1} | - \tfrac12 \log | J_i^\top J_i + \Sigma^{-1} | \right)

    is subtracted, with the covariance :math:`\Sigma` of the belief and the share
    :math:`w_i` of local draws in the evidence. It assumes that outcomes are smooth over
    three thousandths of the belief.

    Where noise is not declared, mean and noise are first learned from pairs of outcomes
    at the same parameters (:func:`.learned`):
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
        shares, fisher = simulations.completeness, simulations.fisher
        known = emulated(simulations)
        entropy, surprise = conditional_entropy(known.simulations)
        slopes = known.emulator.slope(known.emulator.knots)
        # Too few measurements: what is present still counts.
        for a in torch.nonzero(_enough(simulations))[:, 0].tolist():
            share, counted = shares[a], simulations.counted[a]
            rows = share > 0
            own = slopes[:, known.columns(a)]
            evidence = Evidence(known, a, share, belief, self.num_local)
            log_p, influence, local = evidence(own, torch.nonzero(rows)[:, 0])
            log_p -= share[counted].mean().log()
            gain[a, rows] += share[rows] * with_control(
                -log_p - entropy[a, rows], surprise[a, rows] - entropy[a, rows]
            )
            if fisher is not None:
                slope, theta = own @ known.emulator.transform.T, simulations.theta
                every = fisher[a].sum(1)  # what noise of their own blurs adds up
                gain[a] -= _excess(slope, every, theta.double(), local)
            # What a simulation does to the evidence of others has mean zero: it adds to
            # errors and leaves the estimate.
            effect = torch.where(counted, share - influence, 0.0)
            gain[a] += effect - counted * effect[counted].mean()
        return gain

    @override
    def remarks(self, simulations: CandidateSimulations) -> list[str]:
        notes = presence_notes(simulations)
        if simulations.fisher is not None:
            notes.append(
                "the emulator misses most outcomes of an action by more than the "
                "noise; slopes of the simulator correct its gain"
            )
        if few := int((~_enough(simulations)).sum()):
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
        self, simulations: CandidateSimulations, *, few: int = 20
    ) -> list[str]:
        """Say what speaks against the estimator here.

        Without declared noise, at most half of the numbers may be off by more than the
        noise after smoothing, and the noise must be Gaussian.

        Args:
            simulations: Simulations to look at.
            few: Complete outcomes that are too few for an emulator; five pairs for each
                number of x are needed to estimate its noise.
        """
        declared, numbers = simulations.noise is not None, simulations.x[0, 0].numel()
        needed = few if declared else max(few, 5 * numbers)
        problems = problems_of_noise(simulations, few=needed)
        if numbers > 1:  # of one it is .2 nat too high at most
            problems += EntropyGain().steps(simulations)
        if declared or problems:
            return problems
        missed = learned(simulations).emulator.error.square().mean(0) > 1
        share = float(missed.double().mean())
        return [f"smoothing misses {share:.0%} of the numbers of x"] * (share > 0.5)

    @override
    def needs_slopes(
        self,
        simulations: CandidateSimulations,
        *,
        num_rows: int = 256,
        most: float = 0.6,
    ) -> bool:
        """Return whether the emulator misses the outcomes of an action.

        Args:
            simulations: Simulations to look at.
            num_rows: Number of rows to fit the emulator to.
            most: Share of an action's outcomes of which it may miss some number by more
                than the noise. Gains are right with .54 in a saturated oscillator, and
                one to six nats too large with .65 to 1 of two-joint arms.
        """
        if simulations.noise is None or EntropyGain().steps(simulations, few=math.inf):
            return False  # steps have none
        some = simulations.samples(slice(num_rows))
        error = emulated(some).emulator.error
        missed = (error.abs() > 1).unflatten(1, (len(simulations.x), -1)).any(2)
        return float(missed.double().mean(0).max()) > most


def _excess(slope: Tensor, fisher: Tensor, theta: Tensor, local: Tensor) -> Tensor:
    """Return contributions to what gains are too large by, shape (n,), of an emulator.

    Args:
        slope: Slopes of the emulator by the parameters, shape (n, q, d).
        fisher: Information matrices of the simulator, shape (n, d, d), NaN for most.
        theta: Parameters, shape (n, d).
        local: Share of local draws in each evidence, shape (n,).
    """
    known = fisher.isfinite().all((1, 2))
    if int(known.sum()) < 2:
        return torch.zeros_like(local)
    scale = theta.std(0)
    _, white = whitening(theta / scale)
    prior = white @ white.mT
    both = torch.stack([slope[known].mT @ slope[known], fisher[known]])
    entropy = 0.5 * torch.logdet(both * scale[:, None] * scale + prior)
    excess = local[known] * (entropy[0] - entropy[1])
    mean = excess.mean()
    found = mean.expand(len(theta)).clone()
    found[known] += len(theta) / len(excess) * (excess - mean)
    return found


def _enough(simulations: CandidateSimulations, fewest: int = 8) -> Tensor:
    """Whether complete outcomes suffice to compare, or to learn from, shape (a,)."""
    needed = fewest
    if simulations.noise is None:
        needed = max(fewest, simulations.x[0, 0].numel() + 2)
    return simulations.complete.sum(1) >= needed

"""Every way to a belief or an evidence: a function, and a line that registers it.

``claims`` says which problems a way is made for. Sizes are the library's defaults,
except where networks are trained, whose defaults take minutes.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.actions import BoxActions
from sbi_active.campaign import Campaign, CampaignOptions
from sbi_active.campaign.options import CampaignDetails
from sbi_active.criticism import Criticism, Trials, identify
from sbi_active.inference import MixtureDensity, RefinementOptions, refine
from sbi_active.simulation import SimulatorModel, simulate
from tests.oracles.judging import Found
from tests.oracles.problem import Normal, Problem, Student
from tests.oracles.reference import Students, Weighted, covariance, searched

#: Draws of each belief.
NUM_DRAWS = 5_000
#: The share of the prior in a refined belief, whose draws would decide moments.
DEFENSIVE = 1e-6

Run = Callable[[Problem, SimulatorModel, int], Found]


@dataclass(frozen=True)
class Way:
    """A way to a belief or an evidence.

    Attributes:
        run: From problem, simulator and seed to what it finds.
        claims: Whether it is made for a problem.
        is_declared: Whether the noise is declared to it, or drawn by the simulator.
    """

    run: Run
    claims: Callable[[Problem], bool]
    is_declared: bool = True


WAYS: dict[str, Way] = {}


def declared(own: Problem) -> bool:
    """Return whether the library has the noise."""
    return own.error.declared() is not None


def few(own: Problem) -> bool:
    """Return whether parameters and numbers are few enough for networks."""
    return own.dim <= 4 and own.x.shape[1] <= 10 and not np.isnan(own.x).any()


def few_declared(own: Problem) -> bool:
    """Return whether networks may be trained on noise that the library has."""
    return few(own) and declared(own)


def scalar(own: Problem) -> bool:
    """Return whether outcomes are one number of two parameters at most."""
    return few(own) and own.dim <= 2 and own.x.shape[1] == 1


def trials_of(own: Problem) -> tuple[Tensor, Tensor]:
    """Return executed actions and outcomes."""
    action, x = (torch.from_numpy(v).float() for v in (own.action, own.x))
    return action, own.shaped(x)


def found(belief: Any) -> Found:
    """Return draws of a belief and what it says of itself."""
    theta = belief.sample(torch.Size([NUM_DRAWS])).double().numpy()
    says = belief.diagnostics.trustworthy
    says = None if says is None else bool(says)
    known = belief.diagnostics.figures
    return Found(
        theta=theta,
        log_evidence=known.get("log_evidence"),
        error=known.get("log_evidence_error", 0.0),
        trustworthy=says,
        kind=type(belief).__name__,
    )


# --------------------------------------------------------------- beliefs of trials


def refined(own: Problem, simulator: SimulatorModel, seed: int, **sizes: int) -> Found:
    """Return the belief of :func:`.refine`."""
    settings = RefinementOptions(defensive=DEFENSIVE, **sizes)
    belief = refine(simulator, own.prior, *trials_of(own), settings=settings, seed=seed)
    return found(belief)


def in_campaign(**options: Any) -> Run:
    """Return the belief of a campaign to which all trials are attached.

    Args:
        options: Of the campaign, and its method.
    """
    method = options.pop("method", "asbi")

    def run(own: Problem, simulator: SimulatorModel, seed: int) -> Found:
        low, high = own.action.min(0), own.action.max(0)
        space = BoxActions(low.tolist(), (high + (high <= low)).tolist())
        given = {"method": method, "options": CampaignOptions(**options), "seed": seed}
        campaign = Campaign(simulator, own.prior, space, **given)
        for action, x in zip(*trials_of(own), strict=True):
            campaign.attach(action, x)
        return found(campaign.update())

    return run


SMALL: dict[str, Any] = {
    "num_simulations": 2_000,
    "details": CampaignDetails(num_scored=200),
    "density_estimator": MixtureDensity(num_iterations=600),
}

WAYS["refine"] = Way(refined, declared)
WAYS["refine, noise drawn"] = Way(refined, lambda own: True, is_declared=False)
#: Too few, so that beliefs are wrong and shall say so.
WAYS["refine, 200 histories"] = Way(
    partial(refined, num_histories=200),
    lambda own: own.closed_form is not None,
    is_declared=False,
)
WAYS["campaign"] = Way(
    in_campaign(
        network="on demand",
        details=CampaignDetails(num_scored=200),
        refinement=RefinementOptions(defensive=DEFENSIVE),
    ),
    declared,
)
WAYS["max_simulations=1000"] = Way(
    in_campaign(max_simulations=1_000, planned_trials=4), few_declared
)
# Networks alone: with refine=True every method gives the belief of "campaign".
WAYS["asbi, chained"] = Way(
    in_campaign(method="asbi", refine=False, **SMALL), few_declared
)
WAYS["alhi"] = Way(in_campaign(method="alhi", refine=False, **SMALL), few_declared)
WAYS["seqbed"] = Way(
    in_campaign(method="seqbed", refine=False, num_simulations=2_000),
    lambda own: scalar(own) and declared(own),
)


# ----------------------------------------------------------------- criticism, pyro


def bare(own: Problem, simulator: SimulatorModel, seed: int) -> Found:
    """Return the bare model's posterior and evidence in the closed loop."""
    action, x = trials_of(own)
    trials = Trials(action, x, sample_times=own.times)
    criticism = Criticism(simulator, own.prior, trials, thin=False, seed=seed)
    fit = criticism.rivals.fit()
    u = fit.sample.draws(NUM_DRAWS, np.random.default_rng(seed))
    theta, _ = fit.rival.coordinates.split(u)
    # Errors of trajectories may last there, which is another model: no evidence of it.
    is_same = own.times is None
    return Found(
        theta=np.asarray(theta, dtype=float),
        log_evidence=fit.evidence.log_evidence if is_same else None,
        error=fit.evidence.standard_error,
    )


def identified(own: Problem, simulator: SimulatorModel, seed: int) -> Found:
    """Return the belief of :func:`.identify`."""
    action, x = trials_of(own)
    trials = Trials(action, x, sample_times=own.times)
    return found(identify(simulator, own.prior, trials, seed=seed))


def robust(own: Problem, simulator: SimulatorModel, seed: int) -> Found:
    """Return the chained belief of :class:`.RobustASBI`, a round a trial."""
    from sbi_active.pyro import RobustASBI

    torch.manual_seed(seed)
    inference = RobustASBI(own.prior, MixtureDensity(num_iterations=600))
    for action, x in zip(*trials_of(own), strict=True):
        belief = own.prior if inference.belief is None else inference.belief
        theta = belief.sample(torch.Size([2_000]))
        rows = simulate(simulator, theta, action.expand(2_000, -1), seed=seed)
        inference.append_simulations(theta, rows.x, action=rows.action).train()
        inference.update(x, action=action, simulator=simulator, seed=seed)
    return found(inference.belief)


WAYS["RobustASBI"] = Way(robust, scalar, is_declared=False)
WAYS["close_loop, bare model"] = Way(
    bare, lambda own: declared(own) and len(own.action) > 1
)
WAYS["identify"] = Way(
    identified, lambda own: own.times is not None and isinstance(own.error, Normal)
)


# ------------------------------------------------------------------------- experts


def by_least_squares(own: Problem, simulator: SimulatorModel, seed: int) -> Found:
    """Return what an expert writes in an afternoon.

    Least squares from eight places, a Student t at each mode that is near the best,
    importance sampling from it, and twice from a mixture fitted to what it gave.
    """
    rng = np.random.default_rng(seed)
    best, *others = searched(own, 8, rng)
    near = [best, *(fit for fit in others if fit.cost < best.cost + 10)]
    proposal = Students(
        np.full(len(near), 1 / len(near)),
        np.array([fit.x for fit in near]),
        np.linalg.cholesky(1.5 * np.array([covariance(fit) for fit in near])),
    )
    for _ in range(2):
        u = Weighted.drawn(own, proposal, 2_000, rng).draws(2_000, rng)
        u = u + 0.02 * u.std(0) * rng.standard_normal(u.shape)
        proposal = Students.fitted(u, wider=1.5)
    sample = Weighted.drawn(own, proposal, 4_000, rng)
    theta = own.to_theta(sample.draws(NUM_DRAWS, rng))
    says = sample.effective > 200
    z, error = sample.log_evidence, sample.error
    return Found(theta=theta, log_evidence=z, error=error, trustworthy=says)


def by_emcee(own: Problem, simulator: SimulatorModel, seed: int) -> Found:
    """Return an ensemble of walkers that began at the best of eight searches.

    References:
        Foreman-Mackey et al., PASP 125 (2013).
    """
    import emcee

    rng, num = np.random.default_rng(seed), max(32, 2 * own.dim + 8)
    best, *_ = searched(own, 8, rng)
    moves = [(emcee.moves.DEMove(), 0.8), (emcee.moves.StretchMove(), 0.2)]
    sampler = emcee.EnsembleSampler(
        num, own.dim, own.log_density, vectorize=True, moves=moves
    )
    sampler.random_state = np.random.RandomState(seed).get_state()
    state: Any = rng.multivariate_normal(best.x, covariance(best), num)
    for _ in range(10):
        state = sampler.run_mcmc(state, 400)
        half = sampler.iteration // 2
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tau = np.max(sampler.get_autocorr_time(discard=half, tol=0))
        if half > 50 * tau:
            break
    chain: Any = sampler.get_chain(discard=half, flat=True)
    theta = own.to_theta(chain[rng.choice(len(chain), NUM_DRAWS)])
    return Found(theta=theta, trustworthy=bool(half > 50 * tau))


def smooth(own: Problem) -> bool:
    """Return whether least squares makes sense."""
    return own.is_smooth and isinstance(own.error, Normal | Student)


WAYS["least squares + importance sampling"] = Way(by_least_squares, smooth)
WAYS["emcee"] = Way(by_emcee, smooth)

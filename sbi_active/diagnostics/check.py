"""Check an amortized posterior by fresh simulations, action by action."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions.discrete import Actions, action_space
from sbi_active.diagnostics.calibration import (
    Calibration,
    judge,
    worst,
)
from sbi_active.diagnostics.log_score import (
    gap_by_classifier,
    gap_by_likelihood,
    smooth,
)
from sbi_active.diagnostics.rows import draws_within, stratified_actions
from sbi_active.expected import require, suggests
from sbi_active.inference.beliefs.belief import names_of
from sbi_active.inference.engine.potential import declares_noise
from sbi_active.inference.models.posterior import ActionPosterior
from sbi_active.inference.rounds.condition import outcome_rows, pack
from sbi_active.seeding import derive_seed, forked_generators, kept_generators
from sbi_active.simulation import SimulatorModel, simulate
from sbi_active.threads import single_thread


@suggests
def check_calibration(
    inference: Any,
    simulator: Callable[..., Any] | None = None,
    *,
    actions: Actions | None = None,
    belief: Distribution | None = None,
    num_simulations: int = 1_000,
    num_posterior_samples: int = 200,
    max_strata: int = 24,
    gap: str = "auto",
    level: float = 0.05,
    seed: int = 0,
) -> Calibration:
    r"""Return whether an amortized posterior is right, by strata of actions.

    Parameters are drawn from the belief that the network was trained under, actions
    from the space, and outcomes simulated. In every stratum and over all of them the
    truths' ranks (SBC), the coverage of the network's smallest regions and the
    log-score gap (:mod:`.log_score`) are judged, each with its interval.
    A calibrated network may still be blunt: ranks and coverage of the prior itself are
    perfect. The gap tells.

    Intervals hold together with probability 1 - ``level`` (Bonferroni), and a figure
    counts only where its interval lies beyond the tolerance: networks that are a
    little off are not flagged the more simulations there are.

    Args:
        inference: A trained :class:`.ASBI`, an :class:`.ActionPosterior`, or a campaign
            of the methods "asbi" or "nsbi" (its current network).
        simulator: ``simulator(theta, action)``; None takes the campaign's.
        actions: Actions at which to check; None takes the campaign's.
        belief: Belief that parameters are drawn from; None is each posterior's own.
        num_simulations: Number of rows; at least 100.
        num_posterior_samples: Draws of the network a row.
        max_strata: Groups of actions at most; listed actions up to as many stand alone.
        gap: "likelihood" (declared noise), "classifier", or "auto".
        level: Probability that a perfect network is flagged anywhere, at most.
        seed: Seed of all draws.

    Returns:
        Figures and the verdict.

    Raises:
        TypeError: If there is no amortized posterior in what is given.
        ValueError: If sizes are too small, actions are missing, or the gap is asked by
            a likelihood that the simulator does not declare.

    References:
        Talts et al. 2018, arXiv:1804.06788; Deistler et al. 2022, arXiv:2210.04815.
    """
    num = min(num_simulations, num_posterior_samples)
    what = "at least 100 simulations and posterior samples"
    require(num >= 100, what, num, "use 1000 and 200")
    ways = "auto", "likelihood", "classifier"
    require(gap in ways, f"gap among {ways}", repr(gap), "pass one of these")
    if is_campaign(inference):
        simulator = inference.simulator if simulator is None else simulator
        actions = inference.actions if actions is None else actions
    posterior = amortized(inference)
    belief = posterior.belief if belief is None else belief
    if simulator is None or actions is None or belief is None:
        raise ValueError(
            "expected a simulator, actions and the belief that the network was trained "
            f"under; got {simulator}, {actions} and {belief}; pass what is None"
        )
    space = action_space(actions)
    own = derive_seed(seed, "round", 0)
    with single_thread(), kept_generators(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Number of .* samples should be")
        action, label, strata = stratified_actions(
            space, num_simulations, max_strata, own
        )
        with forked_generators(derive_seed(own, "theta")):
            theta = belief.sample(torch.Size([len(action)])).float()
        by_likelihood = gap != "classifier" and declares_noise(
            simulator, theta[:8], action[:8]
        )
        require(
            by_likelihood or gap != "likelihood",
            "a simulator that declares its noise for gap='likelihood'",
            "none",
            "pass a SimulatorModel(noise=) or gap='classifier'",
        )
        rows = simulate(simulator, theta, action, seed=derive_seed(own, "x"))
        condition = pack(outcome_rows(rows.x, posterior.x_shape), rows.action.float())
        direct: Any = posterior.packed()
        network: Any = direct.posterior_estimator
        kept = rows.status != 2  # a fault is no outcome
        if not hasattr(network, "knows"):
            kept &= condition.isfinite().all(1)  # sbi's networks take no NaN
        rows, condition, label = rows.at(kept), condition[kept], label[kept]

        def log_q(values: Tensor) -> Tensor:
            with torch.no_grad():
                return network.log_prob(values.float(), condition).double()

        def drawn(num: int) -> Tensor:
            return draws_within(network, direct.prior, num, condition)

        with forked_generators(derive_seed(own, "draws")), torch.no_grad():
            draws = drawn(num_posterior_samples)
            raw = network.sample(draws.shape[:1], condition)
            # Draws of a flat density are as likely: these are ranked at random.
            density = log_q(torch.cat([rows.theta[None], draws]))
            density += 1e-5 * torch.rand(density.shape)
        below = [
            (draws < rows.theta).sum(0),
            (density[1:] < density[0]).sum(0)[:, None],
        ]
        ranks = torch.cat(below, 1)
        inside = smooth(belief, raw).isfinite().double().mean(0)
        correction = inside.clamp_min(0.5 / num_posterior_samples).log()
        gained = log_q(rows.theta[None])[0] - correction - smooth(belief, rows.theta)
        if by_likelihood:
            assert isinstance(simulator, SimulatorModel)
            gaps = gap_by_likelihood(simulator, belief, rows, log_q, raw, seed=own)
            gaps = gaps + correction
        else:
            with forked_generators(derive_seed(own, "classifier")), torch.no_grad():
                false = drawn(12)
            known = condition.nan_to_num(0.0)
            gaps = gap_by_classifier(rows.theta, known, false, log_q, seed=own)
    dim = rows.theta.shape[1]
    names = getattr(simulator, "parameter_names", None) or names_of(belief, dim)
    options: Any = {
        "num_posterior_samples": num_posterior_samples,
        "names": names,
    }
    overall = judge("all", ranks, gaps, gained, level=level / 2, **options)
    options["level"] = level / 2 / len(strata)
    judged = [
        judge(name, ranks[row], gaps[row], gained[row], **options)
        for k, name in enumerate(strata)
        for row in [label == k]
    ]
    reasons = [f"{s.name}: {text}" for s in (overall, *judged) for text in s.reasons]
    return Calibration(
        verdict=worst([overall.verdict, *(s.verdict for s in judged)]),
        reasons=(*reasons,),
        overall=overall,
        strata=(*judged,),
        parameter_names=(*names,),
        gap_method="likelihood" if by_likelihood else "classifier",
        num_invalid=int((~kept).sum()),
        num_simulations=num_simulations,
        ranks=ranks,
        num_posterior_samples=num_posterior_samples,
    )


def is_campaign(given: Any) -> bool:
    """Return whether something has trials, actions and a simulator of its own."""
    return all(hasattr(given, name) for name in ("ask", "tell", "history"))


def amortized(given: Any) -> ActionPosterior:
    """Return the amortized posterior of a trainer, a campaign or itself."""
    if is_campaign(given):
        return given.posterior
    if hasattr(given, "build_posterior"):
        given = given.build_posterior()
    if not isinstance(given, ActionPosterior):
        raise TypeError(
            "expected a trained ASBI, an ActionPosterior or a campaign; got "
            f"{type(given).__name__}; pass inference or inference.build_posterior(), "
            "and sbi's own diagnostics for the others"
        )
    return given

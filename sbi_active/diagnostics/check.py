"""Check an amortized posterior by fresh simulations, action by action."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from sbi.diagnostics import check_tarp, run_sbc, run_tarp
from sbi.inference.posteriors.direct_posterior import DirectPosterior
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions.discrete import Actions, action_space
from sbi_active.diagnostics.calibration import (
    Calibration,
    Stratum,
    Tolerance,
    judge,
    worst,
)
from sbi_active.diagnostics.log_score import (
    gap_by_classifier,
    gap_by_likelihood,
    smooth,
)
from sbi_active.diagnostics.rows import RowPosterior, stratified_actions
from sbi_active.expected import require, suggests
from sbi_active.inference.engine.potential import declares_noise
from sbi_active.inference.models.posterior import ActionPosterior, at_conditions
from sbi_active.inference.rounds.condition import outcome_rows, pack
from sbi_active.seeding import derive_seed, forked_generators, kept_generators
from sbi_active.simulation import SimulatorModel, simulate
from sbi_active.threads import single_thread


@dataclass(frozen=True)
class _Round:
    """One network on its fresh rows, of parameters theta and groups of actions."""

    theta: Tensor
    label: Tensor
    names: list[str]
    posterior: RowPosterior
    ranks: Tensor
    gap: Tensor
    gained: Tensor
    num_invalid: int
    gap_method: str


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
    tolerance: Tolerance | None = None,
    level: float = 0.05,
    parameter_names: Sequence[str] | None = None,
    seed: int = 0,
) -> Calibration:
    r"""Return whether an amortized posterior is right, by strata of action and round.

    Parameters are drawn from the belief that the network was trained under, actions
    from the space, and outcomes simulated. In every stratum and over all of them the
    truths' ranks (SBC), the coverage of the network's smallest regions and the
    log-score gap (:mod:`.log_score`) are judged, each with its interval; TARP over all.
    A calibrated network may still be blunt: ranks and coverage of the prior itself are
    perfect. The gap tells.

    Intervals hold together with probability 1 - ``level`` (Bonferroni), and a figure
    counts only where its interval lies beyond the tolerance: networks that are a
    little off are not flagged the more simulations there are.

    Args:
        inference: A trained :class:`.ASBI`, an :class:`.ActionPosterior`, a campaign of
            the methods "asbi" or "nsbi" (its current network), or a sequence of
            trainers or posteriors, one a round.
        simulator: ``simulator(theta, action)``; None takes the campaign's.
        actions: Actions at which to check; None takes the campaign's.
        belief: Belief that parameters are drawn from; None is each posterior's own.
        num_simulations: Rows a round; at least 100.
        num_posterior_samples: Draws of the network a row.
        max_strata: Groups of actions at most; listed actions up to as many stand alone.
        gap: "likelihood" (declared noise), "classifier", or "auto".
        tolerance: Tolerance of the verdict; None is ``Tolerance()``.
        level: Probability that a perfect network is flagged anywhere, at most.
        parameter_names: Names of the parameters; None takes the simulator's.
        seed: Seed of all draws.

    Returns:
        Figures and the verdict.

    Raises:
        TypeError: If there is no amortized posterior in what is given.
        ValueError: If sizes are too small, actions are missing, or the gap is asked by
            a likelihood that the simulator does not declare.

    References:
        Talts et al. 2018, arXiv:1804.06788; Deistler et al. 2022, arXiv:2210.04815;
        Lemos et al. 2023, arXiv:2302.03026.
    """
    sizes = num_simulations, num_posterior_samples
    require(
        min(sizes) >= 100,
        "at least 100 simulations and posterior samples",
        f"{sizes[0]} and {sizes[1]}",
        "use 1000 and 200",
    )
    ways = "auto", "likelihood", "classifier"
    require(gap in ways, f"gap among {ways}", repr(gap), "pass one of these")
    if is_campaign(inference):
        simulator = inference.simulator if simulator is None else simulator
        actions = inference.actions if actions is None else actions
    if simulator is None or actions is None:
        raise ValueError(
            "expected a simulator and actions, which only a campaign brings; got none; "
            "pass simulator and actions="
        )
    given = inference if isinstance(inference, list | tuple) else [inference]
    posteriors, space = [amortized(one) for one in given], action_space(actions)
    with single_thread(), kept_generators(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Number of .* samples should be")
        rounds = [
            _check_round(
                *(posterior, simulator, belief, gap),
                actions=stratified_actions(space, sizes[0], max_strata, seed=own),
                num_draws=num_posterior_samples,
                seed=own,
            )
            for r, posterior in enumerate(posteriors)
            for own in [derive_seed(seed, "round", r)]
        ]
        last = rounds[-1]
        with forked_generators(derive_seed(seed, "tarp")), torch.no_grad():
            tarp = run_tarp(
                last.theta,
                torch.arange(float(len(last.theta)))[:, None],
                last.posterior,
                num_posterior_samples=num_posterior_samples,
                show_progress_bar=False,
            )
    dim = last.theta.shape[1]
    if parameter_names is None:
        parameter_names = getattr(simulator, "parameter_names", None)
    names = [*(parameter_names or [f"theta_{k + 1}" for k in range(dim)])]
    require(len(names) == dim, f"{dim} parameter names", names, "give one a parameter")
    options: Any = {
        "num_posterior_samples": num_posterior_samples,
        "tolerance": Tolerance() if tolerance is None else tolerance,
        "names": names,
    }
    parts = zip(*((one.ranks, one.gap, one.gained) for one in rounds), strict=True)
    ranks, gaps, gained = map(torch.cat, parts)
    overall = judge("all", 0, ranks, gaps, gained, level=level / 2, **options)
    options["level"] = level / 2 / sum(len(one.names) for one in rounds)
    strata: list[Stratum] = []
    labels = []
    for r, one in enumerate(rounds):
        labels.append(one.label + len(strata))
        for k, name in enumerate(one.names):
            name = name if len(rounds) == 1 else f"round {r + 1}, {name}"
            row = one.label == k
            own = one.ranks[row], one.gap[row], one.gained[row]
            strata.append(judge(name, r + 1, *own, **options))
    reasons = [f"{s.name}: {text}" for s in (overall, *strata) for text in s.reasons]
    return Calibration(
        verdict=worst([overall.verdict, *(s.verdict for s in strata)]),
        reasons=(*reasons,),
        overall=overall,
        strata=(*strata,),
        parameter_names=(*names,),
        gap_method=rounds[0].gap_method,
        num_invalid=sum(one.num_invalid for one in rounds),
        num_simulations=num_simulations * len(rounds),
        ranks=ranks,
        num_posterior_samples=num_posterior_samples,
        label=torch.cat(labels),
        tarp=tarp,
        tarp_area=check_tarp(*tarp)[0],
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
            "expected a trained ASBI, an ActionPosterior or a campaign, or a list of "
            f"them; got {type(given).__name__}; pass inference or "
            "inference.build_posterior(), and sbi's own diagnostics for the others"
        )
    return given


def _check_round(
    posterior: ActionPosterior,
    simulator: Callable[..., Any],
    belief: Distribution | None,
    gap: str,
    *,
    actions: tuple[Tensor, Tensor, list[str]],
    num_draws: int,
    seed: int,
    ties: float = 1e-5,
) -> _Round:
    """Return the figures of a network, densities within ``ties`` ranked at random."""
    action, label, names = actions
    belief = posterior.belief if belief is None else belief
    if belief is None:
        raise ValueError(
            "expected the belief that the network was trained under; got none; pass "
            "belief="
        )
    with forked_generators(derive_seed(seed, "theta")):
        theta = belief.sample(torch.Size([len(action)])).float()
    few = theta[:8], action[:8]
    by_likelihood = gap != "classifier" and declares_noise(simulator, *few)
    require(
        by_likelihood or gap != "likelihood",
        "a simulator that declares its noise for gap='likelihood'",
        "none",
        "pass a SimulatorModel(noise=) or gap='classifier'",
    )
    rows = simulate(simulator, theta, action, seed=derive_seed(seed, "x"))
    condition = pack(outcome_rows(rows.x, posterior.x_shape), rows.action.float())
    direct = posterior.packed()
    assert isinstance(direct, DirectPosterior)
    kept = rows.status != 2  # a fault is no outcome
    if not hasattr(direct.posterior_estimator, "knows"):
        kept &= condition.isfinite().all(1)  # sbi's networks take no NaN
    rows, condition = rows.at(kept), condition[kept]
    at_rows, index = at_conditions(direct, condition, RowPosterior)
    network: Any = at_rows.posterior_estimator

    def log_density(values: Tensor, row: Tensor) -> Tensor:
        density = network.log_prob(values[:, None], row.reshape(1, 1))[:, 0]
        return density.double() + ties * torch.rand(len(density))  # a flat one has some

    def coordinate(k: int) -> Callable[[Tensor, Tensor], Tensor]:
        return lambda theta, x: theta[:, k]

    with forked_generators(derive_seed(seed, "draws")), torch.no_grad():
        ranks, _ = run_sbc(
            rows.theta,
            index,
            at_rows,
            num_posterior_samples=num_draws,
            reduce_fns=[*map(coordinate, range(theta.shape[1])), log_density],
            show_progress_bar=False,
        )
        raw = network.sample(torch.Size([num_draws]), index)

    def log_q(values: Tensor) -> Tensor:
        return network.log_prob(values.float(), index)

    inside = smooth(belief, raw).isfinite().double().mean(0)
    correction = inside.clamp_min(0.5 / num_draws).log()
    with torch.no_grad():
        own = log_q(rows.theta[None])[0].double() - correction
    gained = own - smooth(belief, rows.theta)
    if by_likelihood:
        assert isinstance(simulator, SimulatorModel)
        terms = gap_by_likelihood(simulator, belief, rows, log_q, raw, seed=seed)
        terms, method = terms + correction, "likelihood"
    else:
        with forked_generators(derive_seed(seed, "classifier")):
            draws = at_rows.sample_batched((12,), index, show_progress_bars=False)
        known, method = condition.nan_to_num(0.0), "classifier"
        terms = gap_by_classifier(rows.theta, known, draws, log_q, seed=seed)
    invalid = int((~kept).sum())
    return _Round(
        *(rows.theta, label[kept], names, at_rows, ranks, terms, gained),
        *(invalid, method),
    )

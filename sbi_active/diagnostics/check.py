"""Check an amortized posterior by fresh simulations, action by action."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from sbi.diagnostics import check_tarp, run_sbc, run_tarp
from sbi.diagnostics.lc2st import LC2ST
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
from sbi_active.expected import suggests
from sbi_active.inference.engine.potential import declares_noise
from sbi_active.inference.models.posterior import ActionPosterior
from sbi_active.inference.rounds.condition import action_rows, outcome_rows, pack
from sbi_active.seeding import derive_seed, forked_generators, kept_generators
from sbi_active.simulation import Simulations, SimulatorModel, simulate
from sbi_active.threads import single_thread


@dataclass(frozen=True)
class _Round:
    """One network on its fresh rows."""

    rows: Simulations
    label: Tensor
    names: list[str]
    condition: Tensor
    posterior: RowPosterior
    ranks: Tensor
    draws: Tensor
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
    num_contrastive: int = 64,
    max_strata: int = 24,
    gap: str = "auto",
    observations: Sequence[tuple[Tensor, Tensor]] = (),
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
        num_contrastive: Noise-free runs a row behind the gap are twice as many.
        max_strata: Groups of actions at most; listed actions up to as many stand alone.
        gap: "likelihood" (declared noise), "classifier", or "auto".
        observations: Pairs (x, action) at which sbi's local classifier test (L-C2ST)
            is run as well, with overall level .05; takes a minute.
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
        Lemos et al. 2023, arXiv:2302.03026; Linhart et al. 2023, arXiv:2306.03580.
    """
    _require_rows(num_simulations, num_posterior_samples)
    if gap not in ("auto", "likelihood", "classifier"):
        raise ValueError(
            f"expected gap 'auto', 'likelihood' or 'classifier'; got {gap!r}; pass one "
            "of these"
        )
    if not 1 <= num_contrastive <= num_posterior_samples:
        raise ValueError(
            f"expected num_contrastive within 1 and {num_posterior_samples} posterior "
            f"samples; got {num_contrastive}; lower it"
        )
    if is_campaign(inference):
        simulator = inference.simulator if simulator is None else simulator
        actions = inference.actions if actions is None else actions
    if simulator is None or actions is None:
        raise ValueError(
            "expected a simulator and actions, which only a campaign brings; got none; "
            "pass simulator and actions="
        )
    given = [*inference] if isinstance(inference, list | tuple) else [inference]
    posteriors = [amortized(one) for one in given]
    tolerance = Tolerance() if tolerance is None else tolerance
    space = action_space(actions)
    with single_thread(), kept_generators(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Number of .* samples should be")
        rounds = [
            _check_round(
                *(posterior, simulator, belief, space, gap),
                sizes=(num_simulations, num_posterior_samples, num_contrastive),
                max_strata=max_strata,
                seed=derive_seed(seed, "round", r),
            )
            for r, posterior in enumerate(posteriors)
        ]
        tarp = _tarp(rounds, num_posterior_samples, derive_seed(seed, "tarp"))
        local = [
            _local(rounds[-1], posteriors[-1], x, action, derive_seed(seed, "local", k))
            for k, (x, action) in enumerate(observations)
        ]
    dim = rounds[0].draws.shape[-1]
    if parameter_names is None:
        parameter_names = getattr(simulator, "parameter_names", None)
    names = parameter_names or [f"theta_{k + 1}" for k in range(dim)]
    if len(names) != dim:
        raise ValueError(
            f"expected {dim} parameter names; got {[*names]}; give one a parameter"
        )
    num_strata = sum(len(one.names) for one in rounds)
    options: Any = {
        "num_posterior_samples": num_posterior_samples,
        "tolerance": tolerance,
        "names": names,
    }
    overall = judge(
        *("all", 0, *(torch.cat(parts) for parts in _figures(rounds))),
        **{**options, "level": level / 2},
    )
    strata: list[Stratum] = []
    for r, one in enumerate(rounds):
        for k, name in enumerate(one.names):
            row = one.label == k
            label = name if len(rounds) == 1 else f"round {r + 1}, {name}"
            figures = (one.ranks[row], one.gap[row], one.gained[row])
            part = judge(
                *(label, r + 1, *figures), **options, level=level / 2 / num_strata
            )
            strata.append(part)
    reasons = [f"all: {text}" for text in overall.reasons]
    reasons += [f"{s.name}: {text}" for s in strata for text in s.reasons]
    reasons += [
        f"observation {k + 1}: L-C2ST tells the posterior from the truth (p = {p:.2g})"
        for k, p in enumerate(local)
        if p < 0.05 / len(local)
    ]
    verdict = worst([overall.verdict, *(s.verdict for s in strata)])
    first = [sum(len(one.names) for one in rounds[:r]) for r in range(len(rounds))]
    return Calibration(
        verdict="refine" if verdict == "trust" and reasons else verdict,
        reasons=(*reasons,),
        overall=overall,
        strata=(*strata,),
        parameter_names=(*names,),
        gap_method=rounds[0].gap_method,
        num_invalid=sum(one.num_invalid for one in rounds),
        num_simulations=num_simulations * len(rounds),
        ranks=torch.cat([one.ranks for one in rounds]),
        num_posterior_samples=num_posterior_samples,
        label=torch.cat([r.label + k for r, k in zip(rounds, first, strict=True)]),
        tarp=tarp,
        tarp_area=check_tarp(*tarp)[0],
        local=(*local,),
    )


def _require_rows(num: int, num_draws: int, *, fewest: int = 100) -> None:
    """Raise if simulations or posterior samples are fewer than sbi asks for."""
    if min(num, num_draws) < fewest:
        raise ValueError(
            f"expected at least {fewest} simulations and posterior samples; got "
            f"{num} and {num_draws}; use 1000 and 200"
        )


def _figures(rounds: Sequence[_Round]) -> tuple[list[Tensor], ...]:
    parts = [(one.ranks, one.gap, one.gained) for one in rounds]
    return tuple([*part] for part in zip(*parts, strict=True))


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
    space: Any,
    gap: str,
    *,
    sizes: tuple[int, int, int],
    max_strata: int,
    seed: int,
    ties: float = 1e-5,
) -> _Round:
    """Return the figures of a network, densities within ``ties`` ranked at random."""
    num, num_draws, num_contrastive = sizes
    belief = posterior.belief if belief is None else belief
    if belief is None:
        raise ValueError(
            "expected the belief that the network was trained under; got none; pass "
            "belief="
        )
    action, label, names = stratified_actions(space, num, max_strata, seed=seed)
    with forked_generators(derive_seed(seed, "theta")):
        theta = belief.sample(torch.Size([num])).float()
    few = theta[:8], action[:8]
    by_likelihood = gap != "classifier" and declares_noise(simulator, *few)
    if gap == "likelihood" and not by_likelihood:
        raise ValueError(
            "expected a simulator that declares its noise for gap='likelihood'; got "
            "none; pass a SimulatorModel(noise=) or gap='classifier'"
        )
    rows = simulate(simulator, theta, action, seed=derive_seed(seed, "x"))
    condition = pack(outcome_rows(rows.x, posterior.x_shape), rows.action.float())
    direct = posterior.packed()
    assert isinstance(direct, DirectPosterior)
    kept = rows.status != 2  # a fault is no outcome
    if not hasattr(direct.posterior_estimator, "knows"):
        kept &= condition.isfinite().all(1)  # sbi's networks take no NaN
    num_invalid = int((~kept).sum())
    rows = rows.at(kept)
    condition, label = condition[kept], label[kept]
    at_rows, index = RowPosterior.of(direct, condition)
    network: Any = at_rows.posterior_estimator
    dim = theta.shape[1]

    def log_density(values: Tensor, row: Tensor) -> Tensor:
        density = network.log_prob(values[:, None], row.reshape(1, 1))[:, 0]
        return density.double() + ties * torch.rand(len(density))  # a flat one has some

    fns: list[Any] = [_Coordinate(k) for k in range(dim)]
    with forked_generators(derive_seed(seed, "draws")), torch.no_grad():
        ranks, _ = run_sbc(
            rows.theta,
            index,
            at_rows,
            num_posterior_samples=num_draws,
            reduce_fns=[*fns, log_density],
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
        terms = gap_by_likelihood(
            *(simulator, belief, rows.theta, rows.action, rows.x),
            *(log_q, raw),
            num_contrastive=num_contrastive,
            seed=seed,
        )
        terms = terms + correction
    else:
        with forked_generators(derive_seed(seed, "classifier")):
            draws = at_rows.sample_batched((12,), index, show_progress_bars=False)
        terms = gap_by_classifier(
            rows.theta, condition.nan_to_num(0.0), draws, log_q, seed=seed
        )
    return _Round(
        *(rows, label, names, condition, at_rows, ranks, raw, terms, gained),
        *(num_invalid, "likelihood" if by_likelihood else "classifier"),
    )


class _Coordinate:
    """One parameter, as sbi's ``reduce_fns`` take it."""

    def __init__(self, k: int) -> None:
        self.k = k

    def __call__(self, theta: Tensor, x: Tensor) -> Tensor:
        return theta[:, self.k]


def _tarp(rounds: Sequence[_Round], num_draws: int, seed: int) -> tuple[Tensor, Tensor]:
    """Return expected coverage and credibility of the last round."""
    one = rounds[-1]
    index = torch.arange(float(len(one.rows)))[:, None]
    with forked_generators(seed), torch.no_grad():
        return run_tarp(
            one.rows.theta,
            index,
            one.posterior,
            num_posterior_samples=num_draws,
            show_progress_bar=False,
        )


def _local(
    one: _Round, posterior: ActionPosterior, x: Tensor, action: Tensor, seed: int
) -> float:
    """Return the p-value that the posterior is right at an outcome (L-C2ST)."""
    rows = outcome_rows(x, posterior.x_shape)
    condition = pack(rows, action_rows(action, posterior.action_dim, num_rows=1))
    keep = one.condition.isfinite().all(1)
    if not bool(condition.isfinite().all()):
        raise ValueError(
            "expected observations without NaN for L-C2ST; got some; leave them out"
        )
    index = torch.arange(float(len(keep)))[:, None]
    with forked_generators(seed), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        draws = one.posterior.sample_batched((1,), index, show_progress_bars=False)[0]
        test = LC2ST(
            prior_samples=one.rows.theta[keep],
            xs=one.condition[keep],
            posterior_samples=draws[keep],
            seed=seed % 2**31,
            z_score=True,
            num_trials_null=40,
        )
        test.train_on_observed_data().train_under_null_hypothesis()
        here = posterior.sample((500,), x=rows, action=action)
        return float(test.p_value(theta_o=here, x_o=condition))

"""Cautions that limit the conclusions of a report, by ``cautions.jinja``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import rankdata

from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.evidence.rival_set import FEW_TRIALS
from sbi_active.criticism.forces.library import COUPLING, FAMILY
from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.words import (
    NO_PART,
    blocks,
    narrow_prior,
    rests,
    suspects_in_words,
)
from sbi_active.criticism.results import (
    FEW_DRAWS,
    NONE,
    UNEXPLAINED,
    Array,
    Residuals,
    Tracing,
)
from sbi_active.criticism.rivals.rival import surprising_outcomes
from sbi_active.criticism.steps.detection import REFUTED, TOO_SMALL
from sbi_active.messages import Message
from sbi_active.seeding import forked_generators
from sbi_active.simulation.conditions import parameters_of


def cautions(
    report: Contents, trials: Trials, *, designed: bool = False, loop: Any = None
) -> tuple[Message, ...]:
    """Return the cautions that limit the conclusions, a sentence each.

    Args:
        report: Report without them.
        trials: The measured trials.
        designed: Actions were chosen for their information.
        loop: The comparison, a :class:`.Criticism`, for what was left out of it; None
            asks nothing of it.
    """
    tracing, fit, own = report.tracing, trials.fit, report.residuals
    if report.residuals_after is not None and tracing.chosen:
        own = report.residuals_after
    is_ordered, rough = fit.order == "known", own.roughness
    rough = None if rough is None else rough[rough > 0]
    said = blocks(
        "cautions",
        report=report,
        designed=designed,
        loop=loop,
        num_trials=int(fit.valid.sum()),
        few_trials=FEW_TRIALS,
        is_sorted=is_ordered and not fit.action_is_label and _aliased(fit),
        growth=report.growth if is_ordered else None,
        disagreeing=_disagreeing(own),
        rough=None if rough is None else (rough.min(), rough.max()),
        correlation=_correlation(own),
        missed=() if report.evaluation is None else report.evaluation.missed,
        infinity=np.inf,
        weak=_weak(tracing),
        refuted=REFUTED,
        too_small=TOO_SMALL,
        edge=_at_edge(tracing, getattr(report.prior, "effects", ())),
        may_be_force=_may_be_force(report),
        no_part=NO_PART,
        suspects=suspects_in_words(tracing),
        rests=rests(tracing) if tracing.needed else "",
        narrow_prior=narrow_prior(tracing),
    )
    return (*map(Message, dict.fromkeys(said)),)


def _disagreeing(own: Residuals) -> list[str]:
    """Return the trials whose having an outcome the model holds for improbable."""
    kinds = [
        "gave no measurement where the model is sure of one",
        "gave a measurement where the model is sure of none",
    ]
    return [
        f"trial{'s' * (len(which) > 1)} {', '.join(map(own.called, which))} {what}"
        for which, what in zip(surprising_outcomes(own), kinds, strict=True)
        if which
    ]


def _weak(tracing: Tracing, *, unsure: float = 0.5) -> list[str]:
    """Return the models that count whose evidence is known to few draws or digits."""
    counts = {n for n, p in tracing.probabilities.items() if p > 0.01}
    return [
        f"{e.name} ({e.effective_sample_size:.0f} effective samples, {e.engine}, "
        f"+- {e.standard_error:.2g} nats)"
        for name, e in tracing.evidences.items()
        if name in {NONE, tracing.model, *counts}
        and (e.effective_sample_size < FEW_DRAWS or e.standard_error > unsure)
    ]


def _may_be_force(report: Contents) -> bool:
    """Return whether the simulator takes forces, misses something, and tried none."""
    tracing = report.tracing
    misses = tracing.misfit is not None and not tracing.misfit.passes
    if not (misses or report.verdict == UNEXPLAINED):
        return False
    is_tried = any(e.family.startswith((FAMILY, COUPLING)) for e in tracing.estimates)
    taken = [p.name for p in parameters_of(report.simulator.fn)]
    return "force" in taken and not is_tried


def _aliased(trials: Trials, *, limit: float = 0.9) -> bool:
    """Return whether an entry of the action goes with the order of execution."""
    order = rankdata(trials.index.numpy())
    return any(
        len(value) > 2
        and np.ptp(value) > 0
        and abs(np.corrcoef(order, rankdata(value))[0, 1]) > limit
        for value in trials.action.numpy().T
    )


def _correlation(own: Residuals, *, long: int = 10, least: float = 0.3) -> float:
    """Return that of neighbors in x's first axis; 0 where it is no reason to warn.

    Args:
        own: Residuals, standardized.
        long: Entries a trial of x that may be a trajectory.
        least: Correlation that is one; so are four of its standard errors.
    """
    z = own.refitted
    is_declared = own.times is not None and own.correlation != 0.0
    pairs = np.stack([z[:, :-1].ravel(), z[:, 1:].ravel()])
    pairs = pairs[:, np.isfinite(pairs).all(0)]
    num = pairs.shape[1]
    if is_declared or z.shape[1] < long or num < 3 or not pairs.std(1).all():
        return 0.0
    found = float(np.corrcoef(pairs)[0, 1])
    return found if found > max(least, 4 / np.sqrt(num)) else 0.0


def _at_edge(tracing: Tracing, effects: Sequence[Effect]) -> list[tuple[Effect, float]]:
    """Return effects of the verdict at the edge of their prior, and the largest phi."""
    evidence = tracing.evidences.get(tracing.model)
    found = []
    for effect in effects:
        if effect.name in tracing.chosen and evidence is not None:
            columns = [evidence.names.index(name) for name in effect.phi_names]
            phi = evidence.draws[:, columns].mean(0)
            if _is_extreme(effect, phi):
                found.append((effect, float(phi[np.argmax(np.abs(phi))])))
    return found


def _is_extreme(effect: Effect, mean: Array, *, edge: float = 0.01) -> bool:
    """Return whether phi is further from the null than almost all of its prior."""
    null = effect.null_phi(1).numpy()[0]

    def away(phi: Array) -> Array:  # from an infinite null the far end is away from it
        return np.where(np.isfinite(null), np.abs(phi - null), -np.sign(null) * phi)

    with forked_generators(0, "edge"):
        draws = effect.sample(2_000).numpy()
    return bool(((away(draws) > away(mean)).mean(0) < edge).any())

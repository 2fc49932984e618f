"""Whether a force of the dictionary explains the trials, or stands in for what does."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.forces.library import is_force
from sbi_active.criticism.misfit.wider_prior import beyond_bounds
from sbi_active.criticism.results import Evaluation, Tracing
from sbi_active.criticism.steps.influence import unless_refuted, withdrawn


def judged(
    rivals: RivalSet, tracing: Tracing, evaluation: Evaluation | None
) -> Tracing:
    """Return the tracing, and whether its forces are stand-ins.

    A force is adopted as an explanation only if the chi-square of its model has a tail
    probability of at least .01, and the error on trials that were not used falls. A
    force with which that error rises is withdrawn, and so are effects that a wider
    prior makes up for.

    Args:
        rivals: The models.
        tracing: Tracing with the effects that the data point to.
        evaluation: Error before and after on trials that had no part in it.
    """
    tracing = beyond_bounds(rivals, unless_refuted(tracing, evaluation))
    effects = {e.name: e for e in rivals.library}
    if not any(is_force(effects[name]) for name in tracing.chosen):
        return tracing
    if evaluation is not None:
        rmse = evaluation.table.set_index("metric").to_dict("index")["rmse"]
        if rmse["ratio"] >= 1:
            return replace(withdrawn(tracing), refuted=(rmse["before"], rmse["after"]))
    return replace(tracing, stand_in=(*_reasons(rivals, tracing, evaluation),))


def _reasons(
    rivals: RivalSet,
    tracing: Tracing,
    evaluation: Evaluation | None,
    *,
    # Log Bayes factor of a residual process above which a model does not explain
    # all.
    process: float = 1.1,
    # Tail probability of the chi-square below which a model is not adopted, on
    # fitted trials and on others.
    level: float = 0.01,
    held_out: float = 0.01,
) -> Iterator[str]:
    if tracing.p_value < level:
        yield f"its chi-square has p = {tracing.p_value:.2g}"
    if evaluation is not None and evaluation.p_value < held_out:
        yield f"that of held-out trials has p = {evaluation.p_value:.2g}"
    if any(name.startswith("free") for name in tracing.chosen):
        yield "its form is free"
    families = [e.family for e in rivals.library if e.name in tracing.chosen]
    if len({*families}) < len(families):
        yield "it takes several forms of one family"
    if tracing.log_process > process:
        yield f"a residual process beside it gains {tracing.log_process:.1f} nats"

"""A report of all steps of a comparison."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.misfit.evaluation import evaluate_held_out
from sbi_active.criticism.next_trial.severe_tests import severe_tests
from sbi_active.criticism.report.report import Report, build_report
from sbi_active.criticism.report.words import caution
from sbi_active.criticism.results import NONE, Evaluation, Tracing
from sbi_active.criticism.steps.missed_trials import outlying_trials
from sbi_active.criticism.steps.predictive import find_residuals
from sbi_active.criticism.thinning import in_words
from sbi_active.progress import stage


def report_of(
    loop: Any,
    evaluation: Evaluation | None,
    held_out: Trials | None,
    *,
    plan: bool,
    designed: bool,
    exploratory: bool,
) -> Report:
    """Return the report of all steps.

    Args:
        loop: The steps, a :class:`.Criticism`.
        evaluation: Error before and after; None leaves it out.
        held_out: Trials that had no part in them.
        plan: Whether to plan the next action, as in :meth:`.Criticism.report`.
        designed: Whether actions were chosen for their information.
        exploratory: Whether what was frozen was changed after the data were seen.
    """
    tracing = loop.judged(evaluation)
    is_withdrawn = tracing.refuted is not None or bool(tracing.bounds.replaces)
    if is_withdrawn and evaluation is not None and held_out is not None:
        evaluation = evaluate_held_out(loop.rivals, tracing, held_out)
    simulator, prior = loop.add(tracing.chosen)
    space = loop.actions if plan else None
    next_action = None if space is None else loop.next_action()
    with stage("residuals and tests", show_progress=loop.show_progress):
        residuals, after = loop.residuals(), None
        if tracing.verdict != NONE:
            after = find_residuals(loop.rivals, tracing.key)
        tests = () if space is None else severe_tests(loop.rivals, tracing, space)
    return build_report(
        trials=loop.trials,
        residuals=residuals,
        residuals_after=after,
        detection=loop.detect(),
        tracing=tracing,
        simulator=simulator,
        prior=prior,
        evaluation=evaluation,
        next_action=next_action,
        actions=loop.actions,
        digest=loop.digest,
        designed=designed,
        exploratory=exploratory,
        num_simulations=loop.rivals.simulator.num_simulations,
        severe_tests=tests,
        warnings=(*_of_comparison(loop), *_outlying(loop, tracing)),
    )


def _of_comparison(loop: Any) -> Iterator[str]:
    """Yield what was left out of the comparison, and why, a sentence each."""
    if loop.num_summaries:
        yield caution("SA524", loop.num_summaries, loop.trials.x[0].numel())
    if loop.sampling is not None and loop.sampling.every > 1:
        yield in_words(loop.sampling)
    if loop.left_out:
        yield caution("SA526", ", ".join(loop.left_out))
    if loop.screening is not None:
        kept, behind = len(loop.screening.kept), loop.screening.behind
        nearest, nats = next(iter(behind.items()))
        yield caution("SA527", kept + len(behind), kept, nearest, nats)
    nuisances = [e.name for e in loop.rivals.nuisances]
    if nuisances and loop.rivals.warm_up == 0:
        yield caution("SA528", ", ".join(nuisances))


def _outlying(loop: Any, tracing: Tracing) -> list[str]:
    """Return the fitted trials that err far more than the others, a sentence each."""
    misfit, trials = tracing.misfit, loop.rivals.trials
    if misfit is None or misfit.left_out != "trials":
        return []
    squares = misfit.of(tracing.model).parts
    measured = [k for k, valid in enumerate(trials.valid.tolist()) if valid]
    if len(squares) != len(measured):  # a trial that no other tells about
        return []
    how = "see what the verdict is without it"
    return [
        caution("SA513", trials.names[measured[k]], times, how)
        for k, times in outlying_trials(squares)
    ]

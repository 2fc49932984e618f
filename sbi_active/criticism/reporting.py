"""A report of all steps of a comparison."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol

from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.criticism.data.sampling import Sampling
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.linear.screening import Screening
from sbi_active.criticism.misfit.evaluation import evaluate_held_out
from sbi_active.criticism.next_trial.severe_tests import severe_tests
from sbi_active.criticism.report.report import Report, build_report
from sbi_active.criticism.results import (
    NONE,
    Detection,
    Evaluation,
    NextAction,
    Residuals,
    Tracing,
)
from sbi_active.criticism.steps.missed_trials import outlying_trials
from sbi_active.criticism.steps.predictive import find_residuals
from sbi_active.criticism.thinning import in_words
from sbi_active.progress import stage
from sbi_active.simulation import SimulatorModel


class Steps(Protocol):
    """The steps that a report is of, as :class:`.Criticism` has them."""

    @property
    def rivals(self) -> RivalSet: ...  # noqa: D102

    trials: Trials
    actions: ActionSpace | None
    show_progress: bool
    num_summaries: int
    sampling: Sampling | None
    left_out: list[str]
    screening: Screening | None
    digest: str

    def judged(self, evaluation: Evaluation | None) -> Tracing: ...  # noqa: D102

    def detect(self) -> Detection: ...  # noqa: D102

    def residuals(self) -> Residuals: ...  # noqa: D102

    def next_action(self) -> NextAction: ...  # noqa: D102

    def add(  # noqa: D102
        self, effects: Sequence[str] | None = None
    ) -> tuple[SimulatorModel, Distribution]: ...


def report_of(
    loop: Steps,
    evaluation: Evaluation | None,
    held_out: Trials | None,
    *,
    plan: bool,
    designed: bool,
    exploratory: bool,
) -> Report:
    """Return the report of all steps.

    Args:
        loop: The steps.
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
    given = made_given(
        loop.trials,
        num_summaries=loop.num_summaries,
        sampling=loop.sampling,
        left_out=loop.left_out,
        screening=loop.screening,
        nuisances=[e.name for e in loop.rivals.nuisances],
        warm_up=loop.rivals.warm_up,
    )
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
        warnings=(*given, *_outlying(loop, tracing)),
    )


def _outlying(loop: Steps, tracing: Tracing) -> list[str]:
    """Return the fitted trials that err far more than the others, a sentence each."""
    misfit = tracing.misfit
    trials = loop.rivals.trials
    if misfit is None or misfit.left_out != "trials":
        return []
    squares = misfit.of(tracing.model).parts
    measured = [k for k, valid in enumerate(trials.valid.tolist()) if valid]
    if len(squares) != len(measured):  # a trial that no other tells about
        return []
    return [
        (
            f"SA513 trial {trials.names[measured[k]]} is far outside what the other "
            f"trials show: its error on the fit to them is {times:.3g} times theirs; "
            "check its record and its unit, and see what the verdict is without it"
        )
        for k, times in outlying_trials(squares)
    ]


def made_given(
    trials: Trials,
    *,
    num_summaries: int,
    sampling: Sampling | None,
    left_out: Sequence[str],
    screening: Screening | None,
    nuisances: Sequence[str],
    warm_up: float,
) -> Iterator[str]:
    """Yield the limits of a comparison and their reasons, a sentence each.

    Args:
        trials: Trials that were compared.
        num_summaries: Number of summaries that stand for x; 0 for none.
        sampling: Sampling that was found; None if not looked for.
        left_out: Names of effects of an order that is unknown.
        screening: Screening by linear evidence; None if all were fitted.
        nuisances: Names of the effects that each trial has anew.
        warm_up: Time in which trials that were not fitted tell of theirs.
    """
    if num_summaries:
        yield (
            f"SA524 given {num_summaries} summaries of the {trials.x[0].numel()} "
            "numbers of a trial: what they leave out was not looked at"
        )
    if sampling is not None and sampling.every > 1:
        yield in_words(sampling)
    if left_out:
        yield (
            "SA526 the order of the trials is unknown: what grows from trial to trial "
            f"was not looked for ({', '.join(left_out)})"
        )
    if screening is not None:
        nearest, behind = next(iter(screening.behind.items()))
        num = len(screening.behind)
        yield (
            f"SA527 of {num + len(screening.kept)} effects {len(screening.kept)} were "
            f"fitted: linear evidence puts the others behind, the nearest ({nearest}) "
            f"by {behind:.1f} nats"
        )
    if nuisances and warm_up == 0:
        yield (
            f"SA528 trials that were not fitted draw {', '.join(nuisances)} from the "
            "prior, which is part of their error; pass warm_up, the time in which "
            "their first samples tell of it"
        )

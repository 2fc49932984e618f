"""The closed loop in one call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch.distributions import Distribution

from sbi_active.actions.discrete import Actions
from sbi_active.criticism.criticism import Criticism
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.misfit.rule import Rule
from sbi_active.expected import suggests
from sbi_active.simulation import SimulatorModel

if TYPE_CHECKING:
    from sbi_active.criticism.report.report import Report


@suggests
def close_loop(
    model: SimulatorModel,
    prior: Distribution,
    trials: Trials,
    *,
    effects: Sequence[Effect] = (),
    actions: Actions | None = None,
    summaries: int | None = None,
    warm_up: float = 0.0,
    thin: bool = True,
    rule: Rule = Rule(),  # noqa: B008  (frozen)
    seed: int = 0,
    evaluate: bool = True,
    plan: bool = True,
    designed: bool = False,
    show_progress: bool = False,
) -> Report:
    """Find the residual, trace it to an effect, add it, and report the error.

    Arguments are those of :class:`Criticism` and of :meth:`Criticism.report`.
    """
    return Criticism(
        model,
        prior,
        trials,
        effects=effects,
        actions=actions,
        summaries=summaries,
        warm_up=warm_up,
        thin=thin,
        rule=rule,
        seed=seed,
        show_progress=show_progress,
    ).report(evaluate=evaluate, plan=plan, designed=designed)

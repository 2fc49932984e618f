"""The closed loop in one call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions.discrete import Actions
from sbi_active.criticism.criticism import Criticism
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.experiments.settle import settle
from sbi_active.criticism.misfit.rule import Rule
from sbi_active.criticism.report.report import Report
from sbi_active.expected import suggests
from sbi_active.simulation import SimulatorModel


@suggests
def close_loop(  # noqa: D417  (the rest are those of Criticism)
    model: SimulatorModel,
    prior: Distribution,
    trials: Trials,
    *,
    effects: Sequence[Effect] = (),
    actions: Actions | None = None,
    real_system: Callable[[Tensor], Any] | None = None,
    max_trials: int = 3,
    directory: str | Path | None = None,
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

    Other arguments are those of :class:`Criticism` and of :meth:`Criticism.report`.

    With ``real_system`` trials are run until they settle the verdict: each is chosen
    among ``actions`` to put the verdict to the test most, and predicted before it is
    run. ``report.tested`` has them, and ``report.stopped`` why it ended.

    Args:
        real_system: Function that runs a trial: it takes an action, shape
            (action_dim,), and gives x. None runs none.
        max_trials: Trials to run at most.
        directory: Folder that keeps predictions, and measurements before anything else
            is done with them; a loop that was interrupted goes on from it.
    """
    compare = partial(
        Criticism,
        model,
        prior,
        effects=effects,
        actions=actions,
        warm_up=warm_up,
        thin=thin,
        rule=rule,
        seed=seed,
        show_progress=show_progress,
    )
    options: dict[str, Any] = {"evaluate": evaluate, "plan": plan, "designed": designed}
    if real_system is None:
        return compare(trials).report(**options)
    options |= {"max_trials": max_trials, "directory": directory}
    return settle(compare, trials, real_system, **options)

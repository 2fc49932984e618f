"""Words of a report: numbers and names, its templates, and its cautions."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from scipy.stats import binom, rankdata

from sbi_active.criticism.contradictions import UNDECLARED
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.forces.library import is_force
from sbi_active.criticism.report.contents import COVERAGE, Contents
from sbi_active.criticism.results import UNEXPLAINED, Residuals
from sbi_active.criticism.rivals.rival import surprising_outcomes
from sbi_active.criticism.rivals.rival_set import FEW_TRIALS
from sbi_active.criticism.steps.detection import LEVEL, REFUTED, TOO_SMALL, credible_set
from sbi_active.display.page import environment
from sbi_active.display.table import number
from sbi_active.seeding import forked_generators
from sbi_active.simulation.conditions import parameters_of


def blocks(template: str, **values: Any) -> list[str]:
    """Return what a template says: paragraphs, items and titles, a line each.

    Args:
        template: Name of the template, without its ending.
        **values: Values of its names.
    """
    text = _templates().get_template(f"{template}.jinja").render(values)
    return [" ".join(b.split()) for b in re.split(r"\n\s*\n", text) if b.strip()]


@cache
def _templates() -> Any:
    made = environment("sbi_active.criticism", "report")
    for form in (number, probability, stated, listed, credible_set):
        made.filters[form.__name__] = form
    made.globals.update(level=LEVEL, undeclared=UNDECLARED)
    return made


def stated(value: float) -> str:
    """Return a probability as an equation."""
    text = probability(value)
    return f"P {text}" if text[0] in "<>" else f"P = {text}"


def probability(value: float) -> str:
    """Return a probability in digits that mean something."""
    if value < 0.005:
        return "< .01"
    return "> .99" if value > 0.995 else f"{value:.2f}"


def listed(names: Sequence[str], last: str = "and") -> str:
    """Return names in a row, as in "a, b and c"."""
    *first, end = names or [""]
    return f"{', '.join(first)} {last} {end}" if first else end


def cautions(report: Contents, *, surprising: float = 0.05) -> list[str]:
    """Return the cautions that limit the conclusions, a code and a sentence each.

    Args:
        report: Report without them.
        surprising: Probability of as many failed predictions of the verdict below which
            they are a caution.
    """
    tracing, fit, own = report.tracing, report.trials.fit, report.residuals
    if report.residuals_after is not None and tracing.chosen:
        own = report.residuals_after
    is_ordered, rough = fit.order == "known", own.roughness
    tests = [t for t in report.measured if t.verdict == report.verdict]
    failed = [f"{t.index:g}" for t in tests if not t.held]
    is_chance = binom.sf(len(failed) - 1, len(tests), 1 - COVERAGE) >= surprising
    said = blocks(
        "cautions",
        report=report,
        num_trials=int(fit.valid.sum()),
        few_trials=FEW_TRIALS,
        is_sorted=is_ordered and not fit.action_is_label and _aliased(fit),
        growth=report.growth if is_ordered else None,
        own=own,
        outcomes=surprising_outcomes(own),
        rough=None if rough is None else rough[rough > 0],
        correlation=_correlation(own),
        refuted=REFUTED,
        too_small=TOO_SMALL,
        edge=_at_edge(report),
        may_be_force=_may_be_force(report),
        failed=[] if is_chance else failed,
        num_tests=len(tests),
    )
    return [*dict.fromkeys([*said, *report.notes])]


def _may_be_force(report: Contents) -> bool:
    """Return whether the simulator takes forces, misses something, and tried none."""
    misfit, tried = report.tracing.misfit, report.tracing.effects.values()
    misses = misfit is not None and not misfit.passes
    taken = {p.name for p in parameters_of(report.simulator.fn)}
    asks = "force" in taken and not any(map(is_force, tried))
    return asks and (misses or report.verdict == UNEXPLAINED)


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


def _at_edge(report: Contents, *, edge: float = 0.01) -> list[str]:
    """Return effects of the verdict at the edge of their prior.

    Their phi is further from the null than almost all of its prior.

    Args:
        report: Report with the verdict.
        edge: Share of the prior that is further at most.
    """
    evidence, found = report.evidence, []
    for effect in map(report.tracing.effects.__getitem__, report.tracing.chosen):
        columns = [evidence.names.index(name) for name in effect.phi_names]
        with forked_generators(0, "edge"):
            draws = effect.sample(2_000).numpy()
        phi = np.vstack([evidence.draws[:, columns].mean(0), draws])
        null = effect.null_phi(1).numpy()[0]
        # From an infinite null the far end is away from it.
        away = np.where(np.isfinite(null), np.abs(phi - null), -np.sign(null) * phi)
        if ((away[1:] > away[0]).mean(0) < edge).any():
            found.append(effect.name)
    return found

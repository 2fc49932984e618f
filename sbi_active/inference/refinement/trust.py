"""How far a learned belief can be trusted, from the stages that led to it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.inference.beliefs.diagnostics import Assumption, Diagnostics
from sbi_active.inference.declared.diagnosing import misplaced
from sbi_active.inference.refinement.course import UNSETTLED, Course

#: Whether something that is taken for granted holds, its figure, and what to say with
#: that where it does not.
Doubt = tuple[bool, float, str]

LIVE = 0.01  # mass below which a region is left out of the checks
MIN_EFFECTIVE = 0.05  # share of the particles


def diagnose(
    course: Course,
    doubts: dict[str, Doubt],
    *,
    tails: tuple[list[float], float],
    num_simulations: int,
    bounded: NDArray[np.bool_],
) -> Diagnostics:
    """Return figures about the last stage, what it assumes, and warnings in words.

    Args:
        course: Stages so far.
        doubts: Further things that are taken for granted, by name.
        tails: Tail probabilities of the trials, and of all together.
        num_simulations: Rows simulated.
        bounded: Parameters with two bounds, shape (d,).
    """
    last, own = course.stages[-1], course.own
    edge = np.abs(last.draws[:, bounded]) > 0.98
    edge_mass = float(edge.mean(0).max(initial=0.0))
    effective = min(stage.fit.efficiency for stage in course.stages)
    change = course.divergence if len(course.stages) > 1 else -1.0
    allowed = UNSETTLED * last.draws.shape[1]
    all_doubts: dict[str, Doubt] = {
        "few_modes": (
            effective >= MIN_EFFECTIVE,
            effective,
            "SA111 at some stage only {:.1%} of the particles counted, as with "
            "many narrow modes, and a mode may be lost; raise num_histories",
        ),
        "settled": (
            not np.isfinite(own.settled)
            or (len(course.stages) > 1 and change <= allowed),
            change,
            "SA109 the last stage still changed the belief, by {:.2g} nats; raise "
            "num_histories",
        ),
        "small_error": (
            last.error <= own.untrusted,
            last.error,
            "SA105 the belief is off by about {:.2g} nats, since it rests on few "
            "simulations for so many parameters and numbers; raise num_histories",
        ),
        **doubts,
    }
    warnings = [
        text.format(figure) for ok, figure, text in all_doubts.values() if not ok
    ]
    warnings += misplaced(*tails, edge_mass)
    figures: dict[str, Any] = {
        "num_stages": len(course.stages),
        "num_regions": len(last.mass),
        "region_mass": [float(mass) for mass in last.mass],
        "prior_edge_mass": edge_mass,
        "surrogate_kl_last_stage": change,
    }
    return Diagnostics(
        trustworthy=not warnings,
        warnings=(*warnings,),
        assumptions={
            name: Assumption(bool(ok), float(figure))
            for name, (ok, figure, _) in all_doubts.items()
        },
        num_simulations=num_simulations,
        effective_sample_size=float(last.fit.fit.effective_sample_size),
        error_nats=last.error,
        error_nats_if_explained=last.error,
        tail_probability=tails[1],
        tail_probability_of_trial=(*tails[0],),
        figures=figures,
    )

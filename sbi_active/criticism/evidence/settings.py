"""Settings of what is spent on the evidence of a rival."""

from __future__ import annotations

import numpy as np

from sbi_active.inference.engine.search import SearchSettings
from sbi_active.inference.engine.settings import Settings

#: Searches from draws of the prior alone. A wrong model explains nothing, so that no
#: number of searches is asked to.
THOROUGH = SearchSettings(
    num_screened=128, max_starts=48, explained=0.0, phases=10, num_kept=8
)
#: Searches with a fit to begin at.
NESTED = SearchSettings(
    num_screened=32,
    num_starts=4,
    max_starts=12,
    num_found=1,
    explained=0.0,
    iterations=6,
    phases=10,
)


def settings_of(num_trials: int, *, is_bare: bool) -> Settings:
    """Return the settings of what is spent on a model.

    The bare model is every comparison's other side, and its posterior is shown; an
    evidence that is off by a seventh of a nat decides as well as a better one.

    Args:
        num_trials: Number of simulated trials in a row.
        is_bare: Whether it is the model without effects.
    """
    most = 3_000  # rows of all trials
    if is_bare:
        return Settings(plenty=4.0, num_simulations=3 * most * num_trials)
    return Settings(
        num_effective=50.0,
        plenty=1.0,
        divergence=np.inf,
        num_draws=100,
        fewest=25.0,
        affordable=5.0,
        broad=60.0,
        share_of_plenty=0.0,
        num_simulations=most * num_trials,
    )

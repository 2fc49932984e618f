"""The end of a campaign's simulations: its last ones, and trials without any."""

from __future__ import annotations

from typing import Any

from sbi_active.campaign.state import CampaignState, Trial
from sbi_active.messages import warn
from sbi_active.simulation.workers.meter import SimulationBudgetError

FEWEST = 24  # simulations that a round is worth beginning with


def used_up(state: CampaignState) -> str | None:
    """Return what to say where the campaign's simulations are used up, or None."""
    meter = state.meter
    if meter.left >= FEWEST:
        return None
    return (
        f"the simulations are used up: {meter.spent} of max_simulations = {meter.limit}"
        f" were run, and a round needs {FEWEST} or more; the last belief stands"
    )


def require_left(state: CampaignState) -> None:
    """Raise if no further trial can be designed.

    Raises:
        SimulationBudgetError: If the simulations are used up.
    """
    text = used_up(state)
    if text is not None:
        raise SimulationBudgetError(
            f"{text}. Load the campaign with a larger max_simulations to go on"
        )


def learned(learner: Any, state: CampaignState, trial: Trial) -> bool:
    """Score a trial and learn from it; False if simulations did not suffice.

    The trial stays recorded and the belief as it is.
    """
    try:
        if trial.version != state.version.number:
            learner.score(trial)
        learner.learn(state.trials[trial.index])
    except SimulationBudgetError as error:
        state.unscore(trial.index)
        warn(
            f"SA602 trial {trial.index} is recorded and not in the belief: {error}",
            stacklevel=4,
        )
        return False
    return True

"""Whether the belief of a campaign is still calibrated, as a rule to stop by."""

from __future__ import annotations

from typing import Any

from sbi_active.diagnostics.beliefs import check_belief
from sbi_active.diagnostics.check import check_calibration
from sbi_active.seeding import derive_seed


def calibration_lost(campaign: Any) -> str | None:
    """Return why not to go on, or None.

    A refined belief is inferred twice again from the same trials; for a chained one the
    network that gives the next belief is checked.

    Args:
        campaign: Campaign of a method with a posterior, or with refined beliefs.
    """
    state = campaign.state
    if not state.explained:
        return None
    seed = derive_seed(state.seed, "calibration", len(state.processed))
    if state.options.refine:
        found: Any = check_belief(campaign, num_repeats=0, seed=seed)
    else:
        found = check_calibration(campaign, gap="classifier", seed=seed)
    if found.verdict != "stop":
        return None
    return f"calibration is lost: {found.reasons[0]}"

"""Which candidates a designer may choose."""

from __future__ import annotations

import warnings

from torch import Tensor

from sbi_active.actions import ActionSpace, DiscreteActions
from sbi_active.simulation import MissingRowsWarning

__all__ = ["discrete", "excluded_note", "reaches", "warn_missing"]


def discrete(actions: ActionSpace) -> DiscreteActions:
    """Return the action space if it lists its candidates, else raise."""
    if not isinstance(actions, DiscreteActions):
        raise TypeError(
            f"expected DiscreteActions; got {type(actions).__name__}; do list the "
            "candidates, DiscreteActions(values)"
        )
    return actions


def reaches(valid: Tensor, least: float) -> Tensor:
    """Return which candidates give a measurement often enough, shape (a,).

    Args:
        valid: Share of measurements, shape (a,); NaN where every simulation was lost.
        least: Share asked for.

    Raises:
        ValueError: If none does; it names the largest share.
    """
    eligible = valid >= least
    if not bool(eligible.any()):
        if bool(valid.isnan().all()):
            raise ValueError(
                "expected simulations; got none, all rows of all candidates were lost "
                "to faults; do look at the simulator's tracebacks"
            )
        raise ValueError(
            f"expected a candidate that gives a measurement with a probability of at "
            f"least {least:g}; got {float(valid.nan_to_num(0.0).max()):.3g} at most; "
            "do lower min_probability_valid or add gentler candidates"
        )
    return eligible


def excluded_note(eligible: Tensor, least: float) -> tuple[str, ...]:
    """Say how many candidates are excluded; nothing where none is."""
    num = int((~eligible).sum())
    if num == 0:
        return ()
    return (
        f"{num} of {len(eligible)} candidates excluded: a measurement is less probable "
        f"than {least:g}, or every simulation was lost",
    )


def warn_missing(num_missing: int, num_simulations: int) -> None:
    """Warn once a design of simulations lost to faults."""
    if num_missing:
        warnings.warn(
            f"{num_missing} of {num_simulations} simulations of the design are "
            "missing, by faults of the simulator; they were left out",
            MissingRowsWarning,
            stacklevel=3,
        )

"""A campaign as a table, a row a trial."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from sbi_active.actions import ActionSpace
from sbi_active.campaign.checks.health import assess
from sbi_active.campaign.state import CampaignState, Trial
from sbi_active.design.design import Design, action_labels

if TYPE_CHECKING:
    from pandas import DataFrame

MOST_NUMBERS = 16  # of an outcome that have a column each
#: Columns with numbers, NaN where they are not known.
NUMBERS = (
    *("expected_information", "expected_information_error", "information_gained"),
    *("surprise", "log_score", "misfit", "outlyingness"),
)
#: All columns but those of action and outcome, which follow the third.
OWN = (
    *("trial", "status", "target", *NUMBERS, "health", "version"),
    *("seconds", "cpu_seconds", "num_simulations", "num_missing", "reason"),
)


def to_dataframe(
    state: CampaignState,
    actions: ActionSpace,
    *,
    parameter_names: Sequence[str],
    channel_names: Sequence[str] | None,
) -> DataFrame:
    """Return the trials as a table, see :meth:`.CampaignView.to_dataframe`.

    Args:
        state: State of the campaign.
        actions: Action space of the campaign.
        parameter_names: Names of the parameters.
        channel_names: Names of the entries of x's last axis, where known.
    """
    import pandas as pd

    outcomes = {t.index: t.x.numpy() for t in state.trials if t.x is not None}
    shape = next((x.shape for x in outcomes.values()), ())
    columns = outcome_labels(shape, channel_names)
    rows = []
    for trial in state.trials:
        gain, error = expected_gain(trial.design)
        x = outcomes.get(trial.index)
        told: list[Any] = [None if x is None else x.copy()]
        if columns:
            told = [np.nan] * len(columns) if x is None else x.ravel().tolist()
        rows.append(
            [
                trial.index,
                trial.status,
                trial.target,
                *trial.action.tolist(),
                *told,
                gain,
                error,
                trial.information_gained,
                trial.surprise,
                trial.log_score,
                trial.misfit,
                trial.outlyingness,
                health_after(state, trial),
                trial.version,
                sum(trial.seconds.values()),
                sum(trial.cpu_seconds.values()),
                trial.num_simulations,
                trial.num_missing,
                trial.reason,
            ]
        )
    labels = [_apart(n, "action", OWN) for n in action_labels(actions)]
    taken = (*OWN, *labels)
    told_names = [_apart(n, "outcome", taken) for n in columns or ["x"]]
    frame = pd.DataFrame(
        rows, columns=pd.Index([*OWN[:3], *labels, *told_names, *OWN[3:]])
    )
    types: dict[str, Any] = dict.fromkeys(NUMBERS, "float64") | {"version": "Int64"}
    frame = frame.astype(types).set_index("trial")
    frame.attrs = {
        "method": state.method,
        "seed": state.seed,
        "parameter_names": [*parameter_names],
        "action_names": [*actions.names],
        "action_units": [*actions.units],
        "units": dict.fromkeys((*NUMBERS[:3], "log_score"), "nats")
        | dict.fromkeys(("seconds", "cpu_seconds"), "s")
        | dict(zip(labels, actions.units, strict=True)),
    }
    return frame


def outcome_labels(
    shape: Sequence[int], channel_names: Sequence[str] | None = None
) -> list[str]:
    """Return a name for each number of an outcome, none where they are many.

    Args:
        shape: Shape of the outcome.
        channel_names: Names of the entries of the last axis, where known.

    Example:
        >>> outcome_labels((2,)), outcome_labels((2,), ["angle", "speed"])
        (['x_1', 'x_2'], ['angle', 'speed'])
        >>> outcome_labels((2, 2), ["angle", "speed"])
        ['angle_1', 'speed_1', 'angle_2', 'speed_2']
        >>> outcome_labels((100,))
        []
    """
    if not 0 < np.prod(shape) <= MOST_NUMBERS:
        return []
    if channel_names is not None and len(shape) and len(channel_names) == shape[-1]:
        last, before = [*channel_names], [*shape[:-1]]
    else:
        last, before = ["x"], [*shape]
    places = ["".join(f"_{i + 1}" for i in place) for place in np.ndindex(*before)]
    if before in ([], [1]):
        return last
    return [name + place for place in places for name in last]


def expected_gain(design: Design | None) -> tuple[float, float]:
    """Return the expected information gain of an action and its standard error, nats.

    They are NaN for a trial that was not designed.
    """
    if design is None:
        return float("nan"), float("nan")

    def at(values: Tensor) -> float:
        return float(values[design.index])

    return at(design.expected_information_gain), at(design.standard_error)


def health_after(state: CampaignState, trial: Trial) -> str | None:
    """Return the campaign's health when a trial had been used.

    It is None for a trial that was not used, or not scored.
    """
    if trial.index not in state.processed:
        return None
    if trial.is_measured and trial.version is None:
        return None
    used = state.processed[: state.processed.index(trial.index) + 1]
    versions = [
        v for v in state.versions if not v.number or trial.index not in v.trials
    ]
    return assess(replace(state, processed=used, versions=versions))


def _apart(name: str, prefix: str, taken: Sequence[str]) -> str:
    """Return a name, with a prefix where another column has it."""
    return f"{prefix} {name}" if name in taken else name

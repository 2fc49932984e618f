"""A campaign as a table, and as pages: one to be sent or kept, one of a notebook."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sbi_active.display.notebook import badge, card, table
from sbi_active.display.page import Page, Picture, Section
from sbi_active.display.table import Table
from sbi_active.seeding import draws_of

if TYPE_CHECKING:
    from pandas import DataFrame

#: Columns with numbers, NaN where they are not known.
NUMBERS = (
    *("expected_information", "expected_information_error", "information_gained"),
    *("surprise", "log_score", "misfit", "outlyingness", "cost"),
)
#: Columns that stand before those of action and outcome, and behind them.
FIRST = ("trial", "status", "target")
LAST = (
    *(*NUMBERS, "health", "version", "seconds", "cpu_seconds"),
    *("num_simulations", "num_missing", "reason"),
)
#: Columns that a reader of the page does not need, and further ones of a notebook.
LEFT_OUT = ("cpu_seconds", "log_score", "num_missing", "version")
DETAILS = ("expected_information_error", "misfit", "outlyingness", "num_simulations")
COLORS = {"ok": "good", "watch": "fair", "alarm": "bad"}


def to_dataframe(campaign: Any) -> DataFrame:
    """Return the trials as a table, see :meth:`.Campaign.to_dataframe`."""
    import pandas as pd

    state, actions = campaign.state, campaign.actions
    shape = next((t.x.shape for t in state.trials if t.x is not None), ())
    numbers = outcome_labels(shape, campaign.channel_names)
    own = (*FIRST, *LAST)
    labels = [_apart(n, "action", own) for n in actions.entry_labels]
    told = [_apart(n, "outcome", (*own, *labels)) for n in numbers or ["x"]]
    rows: list[dict[str, Any]] = []
    for trial in state.trials:
        gain, error = trial.expected_gain
        row = {name: getattr(trial, name, None) for name in own}
        row |= {
            "trial": trial.index,
            "expected_information": gain,
            "expected_information_error": error,
            "seconds": sum(trial.seconds.values()),
            "cpu_seconds": sum(trial.cpu_seconds.values()),
        }
        row |= dict(zip(labels, trial.action.tolist(), strict=True))
        if trial.x is not None:
            x = trial.x.numpy()
            values = x.ravel().tolist() if numbers else [x.copy()]
            row |= dict(zip(told, values, strict=True))
        rows.append(row)
    frame = pd.DataFrame(rows, columns=pd.Index([*FIRST, *labels, *told, *LAST]))
    types: dict[str, Any] = dict.fromkeys(NUMBERS, "float64") | {"version": "Int64"}
    frame = frame.astype(types).set_index("trial")
    frame.attrs = {
        "parameter_names": [*campaign.parameter_names],
        "units": dict.fromkeys((*NUMBERS[:3], "log_score"), "nats")
        | dict.fromkeys(("seconds", "cpu_seconds"), "s")
        | dict(zip(labels, actions.units, strict=True)),
    }
    return frame


def outcome_labels(
    shape: Sequence[int],
    channel_names: Sequence[str] | None = None,
    most: int = 16,
) -> list[str]:
    """Return a name for each number of an outcome, none where they are many.

    Args:
        shape: Shape of the outcome.
        channel_names: Names of the entries of the last axis, where known.
        most: Numbers that have a column each.

    Example:
        >>> outcome_labels((2,)), outcome_labels((2,), ["angle", "speed"])
        (['x_1', 'x_2'], ['angle', 'speed'])
        >>> outcome_labels((2, 2), ["angle", "speed"])
        ['angle_1', 'speed_1', 'angle_2', 'speed_2']
        >>> outcome_labels((100,))
        []
    """
    if not 0 < np.prod(shape) <= most:
        return []
    if channel_names is not None and len(shape) and len(channel_names) == shape[-1]:
        last, before = [*channel_names], [*shape[:-1]]
    else:
        last, before = ["x"], [*shape]
    places = ["".join(f"_{i + 1}" for i in place) for place in np.ndindex(*before)]
    if before in ([], [1]):
        return last
    return [name + place for place in places for name in last]


def _apart(name: str, prefix: str, taken: Sequence[str]) -> str:
    """Return a name, with a prefix where another column has it."""
    return f"{prefix} {name}" if name in taken else name


def page(campaign: Any, num_draws: int = 4_000) -> str:
    """Return a campaign as a page of HTML that refers to no other file.

    Args:
        campaign: Campaign with or without its simulator; without it, outcomes are not
            compared with predictions, and their surprises are shown instead.
        num_draws: Draws behind the numbers of the belief; with 4,000 a mean is known to
            a 60th of a deviation.
    """
    import matplotlib.pyplot as plt

    state, belief = campaign.state, campaign.belief
    figure = campaign.plot(**({"num_predicted": 0} if not campaign.simulator else {}))
    diagnostics = getattr(belief, "diagnostics", None)
    together = getattr(diagnostics, "combinations", None)
    draws = draws_of(belief, num_draws, 0, "page")
    known = Table.of_parameters(campaign.parameter_names, draws)
    verdicts = [
        (entry["time"][:16].replace("T", " "), entry["verdict"])
        for entry in campaign.events
        if entry["event"] == "examined"
    ]
    sections = [
        Section("What is known", table=known, text=[str(together)] if together else []),
        Section("Course", picture=Picture("course", _in_words(campaign, known))),
    ]
    if diagnostics is not None and diagnostics.warnings:
        limits = Section("Limits", items=[*diagnostics.warnings], warns=True)
        sections.insert(0, limits)
    if state.trials:
        sections.append(Section("Trials", table=_trials(campaign)))
    if verdicts:
        compared = Table(("when", "verdict"), verdicts)
        sections.append(Section("Compared with what it may lack", table=compared))
    kept = "" if campaign.directory is None else f", kept in {campaign.directory}"
    made = Page(
        f"Campaign: {campaign.actions!r}",
        sections,
        lead=[_summary(campaign)],
        badge=(f"health {campaign.health}", COLORS[campaign.health]),
        footer=f"method {state.method}, seed {state.seed}{kept}",
    ).html({"course": figure})
    plt.close(figure)
    return made


def campaign_html(campaign: Any, most: int = 12) -> str:
    """Return a campaign as HTML for a notebook: health, belief and the last trials.

    Args:
        campaign: The campaign.
        most: Trials that are shown.
    """
    state, belief, parts = campaign.state, campaign.belief, []
    pending = campaign.pending
    waiting = "" if pending is None else f", trial {pending.index} pending"
    if state.trials:
        parts.append(table(_trials(campaign, most=most, left_out=DETAILS)))
    if len(state.trials) > most:
        parts.append(f"and {len(state.trials) - most} before")
    shown = getattr(belief, "_repr_html_", lambda: "the belief is the prior")
    return card(
        f"Campaign: {state.method}, {len(campaign.history)} trials{waiting}",
        badge(f"health {campaign.health}", COLORS[campaign.health]),
        *parts,
        shown(),
    )


def _trials(
    campaign: Any, *, most: int | None = None, left_out: Sequence[str] = ()
) -> Table:
    frame = campaign.to_dataframe().drop(columns=[*LEFT_OUT, *left_out]).reset_index()
    if frame["cost"].isna().all():
        frame = frame.drop(columns="cost")
    return Table.of(frame if most is None else frame[-most:])


def _summary(campaign: Any) -> str:
    waiting = campaign.not_in_belief
    late = f"; not in the belief yet: {waiting}" if waiting else ""
    pending = campaign.pending
    asked = "" if pending is None else f"; trial {pending.index} is pending"
    told = len(campaign.history)
    return f"{told} trial{'s' * (told != 1)} told{asked}{late}"


def _in_words(campaign: Any, known: Table) -> str:
    ends = "; ".join(f"{row[0]} {row[1]}, {row[3]}" for row in known.rows)
    told = sum(t.information_gained or 0.0 for t in campaign.history)
    return (
        "The belief of each parameter by round, the information that each action was "
        "expected to tell, outcomes beside their predictions, and the information "
        f"gained by trial. After {len(campaign.history)} trials and {told:.3g} nats: "
        f"{ends}."
    )

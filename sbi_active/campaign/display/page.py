"""One page that shows a campaign: self-contained, to be sent or kept."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from sbi_active.notebook import parameter_rows
from sbi_active.page import Part, Picture, Table, render
from sbi_active.seeding import forked_generators

#: Draws behind the page's numbers: a mean is then known to a 60th of a deviation.
NUM_DRAWS = 4_000
#: Columns of the table of trials that a reader of the page does not need.
LEFT_OUT = ("cpu_seconds", "log_score", "num_missing", "version")


def page(campaign: Any) -> str:
    """Return a campaign as a page of HTML that refers to no other file.

    Args:
        campaign: With or without its simulator; without it, outcomes are not compared
            with predictions, and their surprises are shown instead.
    """
    import matplotlib.pyplot as plt

    has_simulator = campaign.simulator is not None
    figure = campaign.plot(**({} if has_simulator else {"num_predicted": 0}))
    known = _belief(campaign)
    picture = Picture.of(figure, _in_words(campaign, known))
    plt.close(figure)
    limits = _limits(campaign)
    parts = [
        Part("Limits", items=limits, warns=True) if limits else None,
        Part("What is known", table=known, text=_together(campaign)),
        Part("Course", picture=picture),
        Part("Trials", table=_trials(campaign)) if campaign.state.trials else None,
        _verdicts(campaign),
    ]
    kinds = {"ok": "good", "watch": "fair", "alarm": "bad"}
    return render(
        f"Campaign: {campaign.actions!r}",
        [part for part in parts if part is not None],
        badge=(f"health {campaign.health}", kinds[campaign.health]),
        lead=[_summary(campaign)],
        footer=_origin(campaign),
    )


def write_page(campaign: Any, path: str | os.PathLike[str]) -> Path:
    """Write :func:`page` to a file, and return its path."""
    path = Path(path)
    path.write_text(page(campaign), encoding="utf-8")
    return path


def _summary(campaign: Any) -> str:
    waiting = [t.index for t in campaign.history if not campaign.contains(t)]
    late = f"; not in the belief yet: {waiting}" if waiting else ""
    pending = campaign.pending
    asked = "" if pending is None else f"; trial {pending.index} is pending"
    return f"{len(campaign.history)} trials told{asked}{late}"


def _belief(campaign: Any) -> Table:
    with forked_generators(0, "page"):
        draws = campaign.belief.sample((NUM_DRAWS,))
    header = ("parameter", "mean", "sd", "central 90 %")
    return Table(header, parameter_rows(campaign.parameter_names, draws))


def _together(campaign: Any) -> list[str]:
    """Return what is known of parameters that are not known one by one."""
    diagnostics = getattr(campaign.belief, "diagnostics", None)
    found = getattr(diagnostics, "combinations", None)
    return [str(found)] if found else []


def _in_words(campaign: Any, known: Table) -> str:
    ends = "; ".join(f"{row[0]} {row[1]}, {row[3]}" for row in known.rows)
    gained = [t.information_gained for t in campaign.history]
    told = sum(g for g in gained if g is not None)
    return (
        "The belief of each parameter by round, the information that each action was "
        "expected to tell, outcomes beside their predictions, and the information "
        f"gained by trial. After {len(campaign.history)} trials and {told:.3g} nats: "
        f"{ends}."
    )


def _trials(campaign: Any) -> Table:
    frame = campaign.to_dataframe().drop(columns=[*LEFT_OUT], errors="ignore")
    kept = frame.loc[:, [c for c in frame.columns if not frame[c].isna().all()]]
    rows = [[_cell(value) for value in row] for row in kept.itertuples(index=False)]
    return Table([*map(str, kept.columns)], rows)


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return "" if value != value else f"{value:.4g}"
    return "" if value is None else f"{value!s:.60}"


def _verdicts(campaign: Any) -> Part | None:
    rows = [
        (entry["time"][:16].replace("T", " "), entry["verdict"])
        for entry in campaign.events
        if entry["event"] == "examined"
    ]
    table = Table(("when", "verdict"), rows)
    return Part("Compared with what it may lack", table=table) if rows else None


def _limits(campaign: Any) -> list[str]:
    diagnostics = getattr(campaign.belief, "diagnostics", None)
    return [] if diagnostics is None else [*diagnostics.warnings]


def _origin(campaign: Any) -> str:
    where = campaign.directory
    state = campaign.state
    kept = "" if where is None else f", kept in {where}"
    return f"method {state.method}, seed {state.seed}{kept}"

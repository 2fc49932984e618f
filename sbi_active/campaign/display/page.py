"""One page that shows a campaign: self-contained, to be sent or kept."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from sbi_active.display.page import Page, Picture, Section
from sbi_active.display.table import Table
from sbi_active.seeding import forked_generators

#: Draws behind the page's numbers: a mean is then known to a 60th of a deviation.
NUM_DRAWS = 4_000
#: Columns of the table of trials that a reader of the page does not need.
LEFT_OUT = ("cpu_seconds", "log_score", "num_missing", "version")


def page(campaign: Any) -> str:
    """Return a campaign as a page of HTML that refers to no other file.

    Args:
        campaign: Campaign with or without its simulator; without it, outcomes are not
            compared with predictions, and their surprises are shown instead.
    """
    import matplotlib.pyplot as plt

    has_simulator = campaign.simulator is not None
    figure = campaign.plot(**({} if has_simulator else {"num_predicted": 0}))
    known = _belief(campaign)
    picture = Picture("course", _in_words(campaign, known))
    limits, verdicts = _limits(campaign), _verdicts(campaign)
    sections = [
        *([Section("Limits", items=limits, warns=True)] if limits else []),
        Section("What is known", table=known, text=_together(campaign)),
        Section("Course", picture=picture),
        *(
            [Section("Trials", table=_trials(campaign))]
            if campaign.state.trials
            else []
        ),
        *(
            [Section("Compared with what it may lack", table=verdicts)]
            if verdicts
            else []
        ),
    ]
    kinds = {"ok": "good", "watch": "fair", "alarm": "bad"}
    made = Page(
        f"Campaign: {campaign.actions!r}",
        sections,
        lead=[_summary(campaign)],
        badge=(f"health {campaign.health}", kinds[campaign.health]),
        footer=_origin(campaign),
    ).html({"course": figure})
    plt.close(figure)
    return made


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
    return Table.of_parameters(campaign.parameter_names, draws)


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
    frame = campaign.to_dataframe()
    return Table.of(frame.drop(columns=[*LEFT_OUT], errors="ignore"))


def _verdicts(campaign: Any) -> Table | None:
    rows = [
        (entry["time"][:16].replace("T", " "), entry["verdict"])
        for entry in campaign.events
        if entry["event"] == "examined"
    ]
    return Table(("when", "verdict"), rows) if rows else None


def _limits(campaign: Any) -> list[str]:
    diagnostics = getattr(campaign.belief, "diagnostics", None)
    return [] if diagnostics is None else [*diagnostics.warnings]


def _origin(campaign: Any) -> str:
    where = campaign.directory
    state = campaign.state
    kept = "" if where is None else f", kept in {where}"
    return f"method {state.method}, seed {state.seed}{kept}"

"""One page that shows a campaign: self-contained, to be sent or kept."""

from __future__ import annotations

import base64
import io
import os
from pathlib import Path
from typing import Any

from sbi_active.notebook import badge, escaped, items, parameters, table
from sbi_active.seeding import forked_generators

STYLE = """
:root { color-scheme: light dark; }
body { font-family: system-ui, sans-serif; margin: 2em auto; max-width: 62em;
  padding: 0 1em; line-height: 1.45; }
img { max-width: 100%; background: white; border-radius: .4em; }
h2 { font-size: 1.1em; margin: 1.6em 0 .4em; }
footer { opacity: .65; margin-top: 2em; font-size: .9em; }
"""
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
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=110)
    plt.close(figure)
    picture = base64.b64encode(image.getvalue()).decode()
    title = escaped(f"Campaign: {campaign.actions!r}")
    sections = [
        ("What is known", _belief(campaign)),
        ("Course", f'<img alt="course" src="data:image/png;base64,{picture}">'),
        ("Trials", _trials(campaign)),
        ("Compared with what it may lack", _verdicts(campaign)),
        ("Limits", _limits(campaign)),
    ]
    body = "".join(f"<h2>{name}</h2>{part}" for name, part in sections if part)
    return (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        f"<title>{title}</title><style>{STYLE}</style></head><body>"
        f"<h1>{title}</h1>{_summary(campaign)}{body}"
        f"<footer>{escaped(_origin(campaign))}</footer></body></html>\n"
    )


def write_page(campaign: Any, path: str | os.PathLike[str]) -> Path:
    """Write :func:`page` to a file, and return its path."""
    path = Path(path)
    path.write_text(page(campaign), encoding="utf-8")
    return path


def _summary(campaign: Any) -> str:
    kinds = {"ok": "good", "watch": "fair", "alarm": "bad"}
    waiting = [t.index for t in campaign.history if not campaign.contains(t)]
    late = f"; not in the belief yet: {waiting}" if waiting else ""
    pending = campaign.pending
    asked = "" if pending is None else f"; trial {pending.index} is pending"
    health = badge(campaign.health, kinds[campaign.health])
    told = escaped(f"{len(campaign.history)} trials told{asked}{late}")
    return f"<p>health {health} {told}</p>"


def _belief(campaign: Any) -> str:
    with forked_generators(0, "page"):
        draws = campaign.belief.sample((NUM_DRAWS,))
    return parameters(campaign.parameter_names, draws)


def _trials(campaign: Any) -> str:
    frame = campaign.to_dataframe().drop(columns=[*LEFT_OUT], errors="ignore")
    kept = frame.loc[:, [c for c in frame.columns if not frame[c].isna().all()]]
    rows = [[_cell(value) for value in row] for row in kept.itertuples(index=False)]
    return table([*kept.columns], rows) if rows else ""


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return "" if value != value else f"{value:.4g}"
    return "" if value is None else f"{value!s:.60}"


def _verdicts(campaign: Any) -> str:
    rows = [
        (entry["time"][:16].replace("T", " "), entry["verdict"])
        for entry in campaign.events
        if entry["event"] == "examined"
    ]
    return table(("when", "verdict"), rows) if rows else ""


def _limits(campaign: Any) -> str:
    diagnostics = getattr(campaign.belief, "diagnostics", None)
    return "" if diagnostics is None else items(diagnostics.warnings)


def _origin(campaign: Any) -> str:
    where = campaign.directory
    state = campaign.state
    kept = "" if where is None else f", kept in {where}"
    return f"method {state.method}, seed {state.seed}{kept}"

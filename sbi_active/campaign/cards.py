"""A campaign and its trials as small pages of a notebook."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from sbi_active.display.notebook import badge, card, facts, table
from sbi_active.display.table import Table, number

MOST_TRIALS = 12  # of a table, the last ones
MOST_NUMBERS = 6  # of an outcome
KINDS = {"ok": "good", "watch": "fair", "alarm": "bad"}


def trial_html(trial: Any) -> str:
    """Return a :class:`.Trial` as HTML."""
    labels = getattr(trial.design, "labels", ()) or ()
    seconds = sum(trial.seconds.values())
    pairs = [
        ("action", _action(trial.action, labels)),
        ("outcome", _outcome(trial)),
        ("chosen for", trial.target),
        ("expected to tell", _expected(trial, " nats")),
        ("told", _with(trial.information_gained, " nats")),
        ("surprise", _with(trial.surprise)),
        ("misfit after it", _with(trial.misfit)),
        ("beyond all simulations by", _with(trial.outlyingness, " of their ranges")),
        ("simulations", trial.num_simulations or None),
        ("lost of them", trial.num_missing or None),
        ("time", f"{seconds:.3g} s" if seconds else None),
        ("reason", trial.reason or None),
    ]
    return card(f"Trial {trial.index}: {trial.status}", facts(pairs))


def campaign_html(campaign: Any) -> str:
    """Return a :class:`.Campaign` as HTML: health, belief and the last trials."""
    state, trials = campaign.state, campaign.state.trials
    health = badge(f"health {campaign.health}", KINDS[campaign.health])
    done, pending = len(campaign.history), campaign.pending
    waiting = "" if pending is None else f", trial {pending.index} pending"
    belief: Any = campaign.belief
    page = getattr(belief, "_repr_html_", None)
    rows = [
        (
            str(t.index),
            _action(t.action, campaign.actions.names),
            _outcome(t) or t.status,
            _expected(t),
            number(t.information_gained),
            number(t.surprise),
        )
        for t in trials[-MOST_TRIALS:]
    ]
    header = ("trial", "action", "outcome", "expected [nats]", "gained", "surprise")
    left = len(trials) - len(rows)
    return card(
        f"Campaign: {state.method}, {done} trials{waiting}",
        health,
        table(Table(header, rows)),
        f"and {left} before" if left else "",
        page() if page is not None else "the belief is the prior",
    )


def _action(action: Tensor, labels: Any) -> str:
    values = action.tolist()
    if len(labels) != len(values):
        return ", ".join(f"{v:.4g}" for v in values)
    parts = []
    for label, value in zip(labels, values, strict=True):
        name, _, unit = label.partition(" [")
        parts.append(f"{name} {value:.4g} {unit.removesuffix(']')}".rstrip())
    return ", ".join(parts)


def _outcome(trial: Any) -> str | None:
    if trial.x is None or trial.status == "invalid":
        return None
    values = trial.x.flatten().tolist()
    shown = ", ".join(f"{v:.4g}" for v in values[:MOST_NUMBERS])
    left = len(values) - MOST_NUMBERS
    return f"{shown} and {left} more" if left > 0 else shown


def _expected(trial: Any, unit: str = "") -> str:
    design = trial.design
    if design is None:
        return ""
    gain = float(design.expected_information_gain[design.index])
    error = float(design.standard_error[design.index])
    if gain != gain:
        return ""
    more = "" if error != error else f" ± {error:.1g}"
    return f"{gain:.3g}{more}{unit}"


def _with(value: float | None, unit: str = "") -> str | None:
    return None if value is None else f"{value:.3g}{unit}"

"""Small pieces of HTML for notebooks: escaped, self-contained, on light and dark.

Colors are the notebook's own, made fainter; nothing refers to another file.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence

import numpy as np
from torch import Tensor

LINE = "1px solid rgba(128,128,128,.35)"
CELL = f"text-align:right;padding:.15em .7em .15em 0;border-bottom:{LINE};"
#: Readable on white and on black.
COLORS = {"good": "#2e8b57", "fair": "#b8860b", "bad": "#d9534f", "plain": "#808080"}
MOST_PARAMETERS = 30


class Markup(str):
    """Text that is HTML already."""


def escaped(value: object) -> str:
    """Return text as HTML, as it is where it is HTML already."""
    return value if isinstance(value, Markup) else html.escape(str(value))


def card(title: object, *parts: str) -> Markup:
    """Return a titled block of parts, each of them HTML."""
    head = f'<div style="font-weight:600;margin-bottom:.3em">{escaped(title)}</div>'
    return Markup(
        '<div style="font-size:.95em;line-height:1.4;overflow-x:auto;max-width:60em">'
        f"{head}{''.join(part for part in parts if part)}</div>"
    )


def table(header: Sequence[object], rows: Iterable[Sequence[object]]) -> Markup:
    """Return a table; the first column holds words, all others numbers."""

    def line(cells: Sequence[object], tag: str) -> str:
        sides = ["text-align:left;", *[""] * (len(cells) - 1)]
        return "".join(
            f'<{tag} style="{CELL}{side}">{escaped(cell)}</{tag}>'
            for side, cell in zip(sides, cells, strict=True)
        )

    body = "".join(f"<tr>{line(row, 'td')}</tr>" for row in rows)
    return Markup(
        '<table style="border-collapse:collapse;background:none;'
        'font-variant-numeric:tabular-nums">'
        f"<tr>{line(header, 'th')}</tr>{body}</table>"
    )


def facts(pairs: Iterable[tuple[object, object]]) -> Markup:
    """Return names with what they are, those that are None left out."""
    style = "padding:.1em 1em .1em 0;text-align:left;background:none"
    faint = f"{style};opacity:.65"
    rows = "".join(
        f'<tr><td style="{faint}">{escaped(name)}</td>'
        f'<td style="{style}">{escaped(value)}</td></tr>'
        for name, value in pairs
        if value is not None
    )
    return Markup(f'<table style="border-collapse:collapse">{rows}</table>')


def items(texts: Iterable[object]) -> Markup:
    """Return a list of sentences; nothing for none."""
    points = "".join(f"<li>{escaped(text)}</li>" for text in texts)
    style = "margin:.3em 0;padding-left:1.3em"
    return Markup(f'<ul style="{style}">{points}</ul>' if points else "")


def badge(text: object, kind: str = "plain") -> Markup:
    """Return a word in a frame of the color of "good", "fair", "bad" or "plain"."""
    color = COLORS[kind]
    style = f"border:1px solid {color};color:{color};border-radius:.6em;padding:0 .5em"
    return Markup(f'<span style="{style}">{escaped(text)}</span>')


def number(value: float | None) -> str:
    """Return a number in a few digits, "" for none."""
    return "" if value is None or value != value else f"{value:.3g}"


def parameter_rows(names: Sequence[str], draws: Tensor) -> list[tuple[str, ...]]:
    """Return name, mean, standard deviation and central 90 % of each parameter.

    Args:
        names: One a parameter.
        draws: Of a belief, shape (n, theta_dim).
    """
    values = draws.double().numpy()
    low, high = np.quantile(values, [0.05, 0.95], axis=0)
    mean, sd = values.mean(0), values.std(0)
    return [
        (name, f"{m:.4g}", f"{s:.2g}", f"{a:.4g} to {b:.4g}")
        for name, m, s, a, b in zip(names, mean, sd, low, high, strict=True)
    ]


def parameters(names: Sequence[str], draws: Tensor) -> Markup:
    """Return :func:`parameter_rows` as a table."""
    rows = parameter_rows(names, draws)
    left = len(rows) - MOST_PARAMETERS
    header = ("parameter", "mean", "sd", "central 90 %")
    more = f"<div>and {left} more</div>" if left > 0 else ""
    return Markup(table(header, rows[:MOST_PARAMETERS]) + more)

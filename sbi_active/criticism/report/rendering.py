"""A report as text, Markdown and one self-contained page."""

from __future__ import annotations

import html
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sbi_active.criticism.report.conditions import first_paragraph
from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.figures import (
    plot_before_after,
    plot_probabilities,
    plot_residuals,
)
from sbi_active.criticism.report.headline import added, verdict_line
from sbi_active.criticism.report.sections import sections
from sbi_active.notebook import card, items, number, table
from sbi_active.page import Part, Picture, Table, render

if TYPE_CHECKING:
    from matplotlib.figure import Figure


WIDTH = 88  # of lines of text; tables are as wide as they are
CAPTIONS = {
    "residuals": "Residuals of the models refitted to all trials, in standard "
    "deviations of the prediction; the band is two of them. Each row has its scale, "
    "logarithmic beyond the band where residuals are large.",
    "probabilities": "Posterior probability of the models that were tried.",
    "before_after": "One line a scored trial; the bars are over all of them. "
    "Lower is better for the first two, higher for the third; the dotted line is 90 %.",
}


def figures(report: Contents) -> dict[str, Figure]:
    """Return the report's figures by name."""
    found = {
        "residuals": plot_residuals(
            report.residuals,
            report.residuals_after,
            action_labels=() if report.action_is_label else report.action_labels,
            channel_names=report.channel_names,
            added=added(report),
        ),
        "probabilities": plot_probabilities(report.tracing),
    }
    if report.evaluation is not None:
        found["before_after"] = plot_before_after(report.evaluation)
    return found


def to_text(report: Contents) -> str:
    """Return the report as plain text, the verdict in the first line."""
    lines = [verdict_line(report), *_wrapped(first_paragraph(report))]
    for section in sections(report):
        lines += ["", section.title, "-" * len(section.title)]
        for paragraph in section.text:
            lines += _wrapped(paragraph)
        for item in section.items:
            lines += _wrapped(f"- {item}", indent="  ")
        if section.rows:
            between = [""] if section.text or section.items else []
            lines += [*between, *_aligned([section.header, *section.rows])]
    return "\n".join(lines)


def to_markdown(report: Contents) -> str:
    """Return the report as Markdown."""
    lines = [f"# {verdict_line(report)}", "", first_paragraph(report)]
    for section in sections(report):
        lines += ["", f"## {section.title}", ""]
        for paragraph in section.text:
            lines += [paragraph, ""]
        lines += [f"- {item}" for item in section.items]
        if section.items and section.rows:
            lines.append("")  # or the table would belong to the list
        if section.rows:
            bar = ["---", *["---:"] * (len(section.header) - 1)]
            for row in (section.header, bar, *section.rows):
                cells = [cell.replace("|", "\\|") for cell in row]
                lines.append(f"| {' | '.join(cells)} |")
        if section.figure is not None:
            caption = CAPTIONS[section.figure]
            lines += ["", f"![{caption}]({section.figure}.png)"]
    return "\n".join(lines) + "\n"


def to_html(report: Contents) -> str:
    """Return the report as one page without references to other files."""
    drawn = figures(report)
    parts = []
    for section in sections(report):
        text = tuple(map(_with_signs, section.text))
        rows = [[*map(_with_signs, row)] for row in section.rows]
        picture = None
        if section.figure is not None:
            caption = CAPTIONS[section.figure]
            words = f"{caption} {_told(report, section.figure)}".strip()
            picture = Picture.of(drawn[section.figure], words, caption)
        part = Part(
            section.title,
            text=text,
            items=[*map(_with_signs, section.items)],
            table=Table(section.header, rows) if rows else None,
            picture=picture,
            warns=section.title == "Warnings",
        )
        parts.append(part)
    lead = [_with_signs(first_paragraph(report))]
    return render(_with_signs(verdict_line(report)), parts, lead=lead)


def to_notebook(report: Contents) -> str:
    """Return the verdict, the error before and after, and the warnings, small."""
    scored = report.before_after
    names, columns = [*scored["metric"]], ["before", "after", "ratio"]
    values = scored[columns].to_numpy(dtype=float)
    rows = [(n, *map(number, row)) for n, row in zip(names, values, strict=True)]
    likely = sorted(report.probabilities.items(), key=lambda item: -item[1])[:5]
    return card(
        verdict_line(report),
        f"<p>{html.escape(first_paragraph(report))}</p>",
        table(("model", "probability"), [(n, f"{p:.2f}") for n, p in likely]),
        table(("metric", "before", "after", "ratio or difference"), rows)
        if rows
        else "",
        items(report.warnings),
    )


def _with_signs(text: str) -> str:
    return text.replace(" +- ", " \N{PLUS-MINUS SIGN} ")


def _told(report: Contents, figure: str) -> str:
    """Return the numbers of a figure in words, for who does not see it."""
    if figure == "probabilities":
        shares = sorted(report.probabilities.items(), key=lambda item: -item[1])[:5]
        return ", ".join(f"{name}: {share:.2f}" for name, share in shares) + "."
    if figure == "before_after":
        names = report.before_after["metric"]
        values = report.before_after[["before", "after"]].to_numpy(dtype=float)
        pairs = zip(names, values, strict=True)
        return "; ".join(f"{n}: {a:.3g} to {b:.3g}" for n, (a, b) in pairs) + "."
    each = report.residuals.refitted
    finite = each[np.isfinite(each)]
    largest = np.abs(finite).max(initial=0.0)
    return f"The largest of the bare model is {largest:.3g} standard deviations."


def _wrapped(text: str, indent: str = "") -> list[str]:
    return textwrap.wrap(
        text,
        WIDTH,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [row[0].ljust(widths[0])]
        cells += [c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True)]
        lines.append("  ".join(cells).rstrip())
    return lines

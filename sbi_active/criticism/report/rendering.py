"""A report as text, Markdown and one self-contained page."""

from __future__ import annotations

import base64
import html
import io
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

from sbi_active.criticism.report.conditions import first_paragraph
from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.figures import (
    plot_before_after,
    plot_probabilities,
    plot_residuals,
)
from sbi_active.criticism.report.headline import added, verdict_line
from sbi_active.criticism.report.section import Section
from sbi_active.criticism.report.sections import sections
from sbi_active.notebook import card, items, number, table

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
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #20262b; max-width: 60rem;
       margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.35rem; line-height: 1.35; border-left: 5px solid #2f6f9f;
     padding-left: .8rem; }
h2 { font-size: 1.05rem; margin: 2rem 0 .5rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums;
        font-size: .9rem; }
th, td { text-align: right; padding: .25rem .8rem .25rem 0;
         border-bottom: 1px solid #e2e6e9; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
div.wide { overflow-x: auto; }
figure { margin: 1rem 0; } img { max-width: 100%; }
figcaption { font-size: .85rem; color: #5d6870; }
.warnings { background: #fdf3e1; padding: .6rem 1rem .6rem 2rem; margin: 0; }
""".strip()


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
    title, e = html.escape(verdict_line(report)), html.escape
    drawn = figures(report)
    parts = [
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f"<title>{title}</title>\n<style>\n{STYLE}\n</style>\n</head>\n<body>",
        f"<h1>{title}</h1>",
        f"<p>{e(first_paragraph(report))}</p>",
    ]
    for section in sections(report):
        parts.append(f"<h2>{e(section.title)}</h2>")
        parts += [f"<p>{e(paragraph)}</p>" for paragraph in section.text]
        if section.items:
            kind = ' class="warnings"' if section.title == "Warnings" else ""
            points = "".join(f"<li>{e(item)}</li>" for item in section.items)
            parts.append(f"<ul{kind}>{points}</ul>")
        if section.rows:
            parts.append(_html_table(section))
        if section.figure is not None:
            caption = CAPTIONS[section.figure]
            image = _embedded(drawn[section.figure])
            parts.append(
                f'<figure><img alt="{e(caption)}" src="{image}">'
                f"<figcaption>{e(caption)}</figcaption></figure>"
            )
    return "\n".join([*parts, "</body>\n</html>\n"]).replace(" +- ", " &plusmn; ")


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


def _html_table(section: Section) -> str:
    def line(cells: Sequence[str], tag: str) -> str:
        inner = "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells)
        return f"<tr>{inner}</tr>"

    body = "\n".join(line(row, "td") for row in section.rows)
    table = f"<table>\n{line(section.header, 'th')}\n{body}\n</table>"
    return f'<div class="wide">{table}</div>'


def _embedded(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    code = base64.b64encode(buffer.getvalue()).decode()
    return f"data:image/png;base64,{code}"


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

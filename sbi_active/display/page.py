"""A page in sections: as text, as Markdown, and as one file of HTML."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from sbi_active.display.figures import UNSEEN, svg
from sbi_active.display.table import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH = 88  # of lines of text; tables are as wide as they are


@dataclass(frozen=True)
class Picture:
    """The place of a figure.

    Attributes:
        name: Name of the figure.
        words: Text that says what it shows, for those who do not see it.
        caption: Caption below it.
    """

    name: str
    words: str = ""
    caption: str = ""


@dataclass(frozen=True)
class Section:
    """A part of a page.

    Attributes:
        title: Heading of the section.
        text: Paragraphs.
        items: A list of points.
        table: Table below them; one without rows is left out.
        picture: Picture at its end.
        warns: Whether the points limit what the page says.
    """

    title: str
    text: Sequence[str] = ()
    items: Sequence[str] = ()
    table: Table | None = None
    picture: Picture | None = None
    warns: bool = False


@dataclass(frozen=True)
class Page:
    """A title and what stands below it.

    Attributes:
        title: The headline.
        sections: Sections in order.
        lead: Paragraphs before them.
        badge: A word and its kind, "good", "fair" or "bad", before the lead.
        footer: Line that says where it comes from.
    """

    title: str
    sections: Sequence[Section]
    lead: Sequence[str] = ()
    badge: tuple[str, str] | None = None
    footer: str = ""

    def text(self) -> str:
        """Return plain text, the title in the first line."""
        lines = [self.title, *(_wrapped(paragraph) for paragraph in self.lead)]
        for section in self.sections:
            lines += ["", section.title, "-" * len(section.title)]
            lines += [_wrapped(paragraph) for paragraph in section.text]
            lines += [_wrapped(f"- {item}", indent="  ") for item in section.items]
            if section.table and section.table.rows:
                between = [""] if section.text or section.items else []
                lines += [*between, section.table.text()]
        return "\n".join(lines)

    def markdown(self) -> str:
        """Return Markdown; a figure is a file of PNG with its name."""
        blocks = [f"# {self.title}", *self.lead]
        for section in self.sections:
            blocks += [f"## {section.title}", *section.text]
            blocks += ["\n".join(f"- {item}" for item in section.items)]
            if section.table and section.table.rows:
                blocks.append(section.table.markdown())
            if section.picture:
                blocks.append(
                    f"![{section.picture.caption}]({section.picture.name}.png)"
                )
        return "\n\n".join(filter(None, blocks)) + "\n"

    def html(self, figures: Mapping[str, Figure] | None = None) -> str:
        """Return HTML: light and dark, for screens and paper, without network.

        All text is escaped.

        Args:
            figures: Figures by their names, one for each picture.
        """
        template = templates().get_template("page.html.jinja")
        return UNSEEN.sub("\ufffd", template.render(page=self, figures=figures))


@cache
def templates() -> Any:
    """Return the templates of this room."""
    made = environment("sbi_active", "display", autoescape=True, finalize=_with_signs)
    made.filters["svg"] = svg
    return made


def environment(package: str, folder: str, **options: Any) -> Any:
    """Return the templates of a folder, in which a missing value is an error.

    Args:
        package: Package that has the folder.
        folder: Folder of the templates.
        **options: Further options of Jinja's environment.
    """
    # Not at import: most who import the package make no page.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader(package, folder),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        **options,
    )


def _with_signs(value: Any) -> Any:
    if type(value) is not str:  # what is HTML already stays as it is
        return value
    return value.replace(" +- ", " \N{PLUS-MINUS SIGN} ")


def _wrapped(text: str, indent: str = "") -> str:
    return textwrap.fill(
        text,
        WIDTH,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )

"""The parts of a page, and their setting by one template."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: Control characters and halves of pairs, which neither SVG nor UTF-8 can hold.
UNSEEN = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f\ud800-\udfff]")


@dataclass(frozen=True)
class Table:
    """A table whose columns a reader can sort by.

    Attributes:
        header: One a column.
        rows: Cells as text; the first column holds words, all others numbers.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Picture:
    """A figure, in words for who does not see it.

    Attributes:
        source: A data URI, see :meth:`of`.
        words: What it shows.
        caption: Below it.
    """

    source: str
    words: str
    caption: str = ""

    @classmethod
    def of(cls, figure: Figure, words: str, caption: str = "") -> Picture:
        """Return a figure of matplotlib as SVG, the same at each call.

        Its ground is transparent: the page's own shows, light or dark.
        """
        from matplotlib import rc_context

        buffer = io.BytesIO()
        legible(figure)
        with rc_context({"svg.hashsalt": "sbi-active"}):
            figure.savefig(
                buffer, format="svg", transparent=True, metadata={"Date": None}
            )
        code = base64.b64encode(buffer.getvalue()).decode()
        return cls(f"data:image/svg+xml;base64,{code}", words, caption)


@dataclass(frozen=True)
class Part:
    """A section of a page.

    Attributes:
        title: Its heading.
        text: Paragraphs.
        items: A list of points.
        table: Below them.
        picture: At its end.
        warns: Whether the points limit what the page says.
    """

    title: str
    text: Sequence[str] = ()
    items: Sequence[str] = ()
    table: Table | None = None
    picture: Picture | None = None
    warns: bool = False


def render(
    title: str,
    parts: Sequence[Part],
    *,
    lead: Sequence[str] = (),
    badge: tuple[str, str] | None = None,
    footer: str = "",
) -> str:
    """Return a page: light and dark, for screens and paper, without network.

    All text is escaped.

    Args:
        title: The headline.
        parts: Sections, in order.
        lead: Paragraphs before them.
        badge: A word and its kind, "good", "fair" or "bad", before the lead.
        footer: Where it comes from.
    """
    page = _template().render(
        title=title, parts=parts, lead=lead, badge=badge, footer=footer
    )
    return UNSEEN.sub("\ufffd", page)


def legible(figure: Figure) -> Figure:
    """Return a figure whose texts are what they say: no formulas, no control marks.

    Names of parameters and actions are a user's: "cost [$]" is no formula to set.

    Args:
        figure: A figure, changed in place.
    """
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        text.set_parse_math(False)
        text.set_text(UNSEEN.sub("\ufffd", text.get_text()))
    return figure


@cache
def _template() -> Any:
    # Not at import: most who import the package make no page.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("sbi_active", "page"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html.jinja")

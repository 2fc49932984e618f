"""Figures that can be read wherever they are shown."""

from __future__ import annotations

import base64
import io
import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Control characters and halves of pairs, which neither SVG nor UTF-8 can hold.
UNSEEN = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f\ud800-\udfff]")


def svg(figure: Figure) -> str:
    """Return a figure of matplotlib as a data URI, the same at each call.

    Its ground is transparent: that of the page shows, light or dark.
    """
    from matplotlib import rc_context

    buffer = io.BytesIO()
    legible(figure)
    with rc_context({"svg.hashsalt": "sbi-active"}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    return f"data:image/svg+xml;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def save(figure: Figure, path: str) -> None:
    """Write a figure to a file and free it."""
    import matplotlib.pyplot as plt

    legible(figure).savefig(path, dpi=110)
    plt.close(figure)


def legible(figure: Figure) -> Figure:
    """Return a figure whose texts are what they say: no formulas, no control marks.

    Names of parameters and actions are a user's: "cost [$]" is no formula to set.

    Args:
        figure: A figure, changed in place.
    """
    from matplotlib.axis import Axis
    from matplotlib.text import Text
    from matplotlib.ticker import FuncFormatter

    for axis in figure.findobj(Axis):
        assert isinstance(axis, Axis)
        given = axis.get_major_formatter()
        if axis.get_scale() != "linear":  # whose ticks are formulas
            axis.set_major_formatter("{x:g}")
        if isinstance(given, FuncFormatter):  # names at ticks are set at each drawing
            axis.set_major_formatter(lambda *at, given=given: _seen(given(*at)))
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        text.set_parse_math(False)
        text.set_text(_seen(text.get_text()))
    return figure


def _seen(text: str) -> str:
    return UNSEEN.sub("\ufffd", text)

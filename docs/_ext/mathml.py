"""Formulas as MathML: every browser draws it, and nothing has to be fetched."""

import re
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging

LOG = logging.getLogger(__name__)
DIGITS = re.compile(r"(\\[td]?frac)(\d)(\d)")  # read as one number and what follows
SPACING = re.compile(r"\\math(?:rel|bin|op)\b|\\Big(?=/)")  # looks alone


def _converted(node: nodes.Element, *, as_block: bool = False) -> str:
    text = DIGITS.sub(r"\1{\2}{\3}", SPACING.sub("", node.astext()))
    try:
        return tex2mathml(text, as_block=as_block)
    except MathError as error:
        LOG.warning("a formula cannot be set: %s in %s", error, text, location=node)
        return nodes.literal(text, text).astext()


def _inline(writer: Any, node: nodes.Element) -> None:
    writer.body.append(_converted(node))
    raise nodes.SkipNode


def _block(writer: Any, node: nodes.Element) -> None:
    number = f'<span class="eqno">({node["number"]})</span>' if node["number"] else ""
    name = f' id="{node["ids"][0]}"' if node["ids"] else ""
    formula = _converted(node, as_block=True)
    writer.body.append(
        f'<div class="math"{name} tabindex="0"><span>{formula}</span>{number}</div>'
    )
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer "mathml"."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}

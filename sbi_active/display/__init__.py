"""Display: tables, pages in one file, cards of a notebook, figures.

This package sets text, Markdown and HTML. The texts themselves are with their subjects:
in ``criticism.report``, and with beliefs and designs.
"""

from sbi_active.display.figures import legible, svg
from sbi_active.display.page import Page, Picture, Section
from sbi_active.display.table import Table

__all__ = ["Page", "Picture", "Section", "Table", "legible", "svg"]

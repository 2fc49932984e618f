"""Display: tables, pages in one file, cards of a notebook, figures.

Here lives how text, Markdown and HTML are set. What is said in them lives with what it
is about: in ``campaign.display``, ``criticism.report``, and with beliefs and designs.
"""

from sbi_active.display.figures import legible, svg
from sbi_active.display.page import Page, Picture, Section
from sbi_active.display.table import Table

__all__ = ["Page", "Picture", "Section", "Table", "legible", "svg"]

"""Pages that travel: one file of HTML, with figures, that refers to nothing else.

Here lives how a page looks and how figures and tables enter it. What it says lives with
what it is about: in ``campaign.display`` and ``criticism.report``.
"""

from sbi_active.page.page import Part, Picture, Table, legible, render

__all__ = ["Part", "Picture", "Table", "legible", "render"]

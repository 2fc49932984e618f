"""The report: its headline, sections, warnings and figures.

Here live words and pictures of finished results. Nothing here simulates or fits.
"""

from sbi_active.criticism.report.cautions import find_warnings
from sbi_active.criticism.report.numbers import with_error
from sbi_active.criticism.report.report import build_report

__all__ = ["build_report", "find_warnings", "with_error"]

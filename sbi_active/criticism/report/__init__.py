"""The report: its headline, sections, warnings and figures.

This package contains the texts and figures of finished results. It does not simulate or
fit.
"""

from sbi_active.criticism.report.cautions import find_warnings
from sbi_active.criticism.report.numbers import with_error
from sbi_active.criticism.report.report import build_report

__all__ = ["build_report", "find_warnings", "with_error"]

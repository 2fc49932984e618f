"""The report: its summary, sections, cautions and figures.

This package contains the texts and figures of finished results. It does not simulate or
fit.
"""

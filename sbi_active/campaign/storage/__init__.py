"""A campaign on disk: what it is, what happened, and what was computed from it.

This package contains the records, their checks, and the way to read them. It does not
infer or design.
"""

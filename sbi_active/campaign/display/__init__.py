"""A campaign as a person sees it: a table, figures, a page of a notebook, a bar.

This package reads a campaign and shows it. It never changes a campaign and decides
nothing for it.
"""

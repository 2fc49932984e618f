"""A campaign as a person sees it: a table, figures, a page of a notebook, a bar.

Here lives what reads a campaign and shows it. Nothing here changes one, or decides
anything that a campaign does.
"""

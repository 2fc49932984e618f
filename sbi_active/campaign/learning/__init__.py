"""A round of a campaign: what trains, designs, scores, updates, compares and adopts.

This package contains the calls of a campaign to the packages below. The course of a
campaign is in the package above.
"""

"""A round of a campaign: what trains, designs, scores, updates, compares and adopts.

Here lives what a campaign calls the packages below with. Its course is one floor up.
"""

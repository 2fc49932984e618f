"""The posterior under declared noise: its likelihood is simulated, and so exact.

This package makes a belief of a fit: its diagnostics, and the trials that contradict
one another. It contains no regression.
"""

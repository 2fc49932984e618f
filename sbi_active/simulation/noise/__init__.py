"""Models of the noise of a measurement, and their estimation from repeats.

Here live densities of x given its mean. What gives the mean does not.
"""

"""The next trial: the action that tells rivals apart, and the severest test.

This package proposes a trial. The conclusions from trials are in ``steps``.
"""

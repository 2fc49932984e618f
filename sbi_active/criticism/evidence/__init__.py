"""The evidence of each rival: its best fit, its posterior draws and its normalizer.

This package contains optimizers and samplers over rivals. The conclusions from them are
in ``steps``.
"""

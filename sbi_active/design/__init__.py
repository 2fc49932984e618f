"""Design: which action to take next.

This package contains the designers and the steps between a belief and a choice. The
estimators of an information gain are in ``information_gain``, and the searches for
candidates in ``search``.
"""

from sbi_active.design.design import Design
from sbi_active.design.designer import InformationGainDesigner
from sbi_active.design.random_designer import RandomDesigner

__all__ = ["Design", "InformationGainDesigner", "RandomDesigner"]

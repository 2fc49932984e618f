"""Design: which action to take next.

Here live the designers and the steps between a belief and a choice. How an information
gain is estimated lives in ``information_gain``, how candidates are searched in
``search``.
"""

from sbi_active.design.design import Design
from sbi_active.design.designer import InformationGainDesigner
from sbi_active.design.random_designer import RandomDesigner

__all__ = ["Design", "InformationGainDesigner", "RandomDesigner"]

"""The trainers: sbi's interface with actions, one method a module.

Here lives what users call to append, train and update. What is trained lives in
``networks``, what they return in ``models`` and ``beliefs``.
"""

from sbi_active.inference.trainers.alhi import ALHI
from sbi_active.inference.trainers.asbi import ASBI
from sbi_active.inference.trainers.base import ActiveInference
from sbi_active.inference.trainers.ratio import SeqBED_B, SeqBED_C
from sbi_active.inference.trainers.seqbed import SeqBED

__all__ = ["ALHI", "ASBI", "ActiveInference", "SeqBED", "SeqBED_B", "SeqBED_C"]

"""Pyro: robust updates by error models, and Pyro models as simulators.

This package contains the error model between a simulator and a measurement, the trainer
that averages over denoised outcomes, and the reader of a Pyro model. It needs the extra
``pyro``. Effects that a simulator lacks are in ``criticism``.
"""

from sbi_active.pyro.denoising import SpikeAndSlab
from sbi_active.pyro.models import from_pyro
from sbi_active.pyro.robust import RobustASBI
from sbi_active.renamed import former_names

__all__ = [
    "RobustASBI",
    "SpikeAndSlab",
    "from_pyro",
]

__getattr__ = former_names(__name__)

"""Pyro: robust updates by error models, and Pyro models as simulators.

This package contains Pyro programs of the error between a simulator and a measurement,
the trainer that averages over denoised outcomes, and the reader of a Pyro model. It
needs the extra ``pyro``. Effects that a simulator lacks are in ``criticism``.
"""

from sbi_active.pyro.error_models import ChannelBias, SpikeAndSlab, StudentError
from sbi_active.pyro.models import from_pyro
from sbi_active.pyro.robust import RobustASBI
from sbi_active.renamed import former_names

__all__ = [
    "ChannelBias",
    "RobustASBI",
    "SpikeAndSlab",
    "StudentError",
    "from_pyro",
]

__getattr__ = former_names(__name__)

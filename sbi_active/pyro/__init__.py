"""Pyro: robust updates by error models, and Pyro models as simulators.

This package contains Pyro programs of the error between a simulator and a measurement,
the trainer that averages over denoised outcomes, and the reader of a Pyro model. It
needs the extra ``pyro``. Effects that a simulator lacks are in ``criticism``.
"""

from sbi_active.pyro.denoising import Denoised, denoise
from sbi_active.pyro.error_models import ChannelBias, SpikeAndSlab, StudentError
from sbi_active.pyro.models import PyroProblem, from_pyro
from sbi_active.pyro.robust import RobustASBI

__all__ = [
    "ChannelBias",
    "Denoised",
    "PyroProblem",
    "RobustASBI",
    "SpikeAndSlab",
    "StudentError",
    "denoise",
    "from_pyro",
]

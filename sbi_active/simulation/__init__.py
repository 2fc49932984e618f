"""Simulators, their noise, and the engine that runs them.

This package turns parameters and an action into outcomes. It does not learn from
outcomes. Names are imported when they are used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sbi_active.renamed import lazy_names

if TYPE_CHECKING:
    from sbi_active.simulation.bank.bank import Bank
    from sbi_active.simulation.check import check_simulator
    from sbi_active.simulation.model import SimulatorModel
    from sbi_active.simulation.noise.autocorrelated import AutocorrelatedNoise
    from sbi_active.simulation.noise.base import NoiseModel
    from sbi_active.simulation.noise.estimation import estimate_noise
    from sbi_active.simulation.noise.gaussian import GaussianNoise
    from sbi_active.simulation.noise.student import StudentTNoise
    from sbi_active.simulation.outcomes import (
        MissingRowsWarning,
        Outcome,
        SimulationError,
        SimulationInterrupted,
        Simulations,
    )
    from sbi_active.simulation.reweighting import reuse
    from sbi_active.simulation.workers.engine import simulate
    from sbi_active.simulation.workers.settings import Workers

__all__ = [
    "AutocorrelatedNoise",
    "Bank",
    "GaussianNoise",
    "MissingRowsWarning",
    "NoiseModel",
    "Outcome",
    "SimulationError",
    "SimulationInterrupted",
    "Simulations",
    "SimulatorModel",
    "StudentTNoise",
    "Workers",
    "check_simulator",
    "estimate_noise",
    "reuse",
    "simulate",
]

__getattr__ = lazy_names(__name__)

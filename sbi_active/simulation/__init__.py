"""Simulators, their noise, and the engine that runs them."""

from sbi_active.simulation.bank import Bank, ReusedRows, reuse
from sbi_active.simulation.check import check_simulator
from sbi_active.simulation.model import Simulator, SimulatorModel, require_noise
from sbi_active.simulation.noise.autocorrelated import AutocorrelatedNoise
from sbi_active.simulation.noise.estimation import estimate_noise
from sbi_active.simulation.noise.gaussian import GaussianNoise, NoiseModel
from sbi_active.simulation.noise.student import StudentTNoise
from sbi_active.simulation.noise.unknown import unknown_noise
from sbi_active.simulation.outcomes import (
    MissingRowsWarning,
    Outcome,
    SimulationError,
    SimulationInterrupted,
    Simulations,
)
from sbi_active.simulation.report import SimulatorReport
from sbi_active.simulation.workers.engine import simulate
from sbi_active.simulation.workers.store import RowStore

__all__ = [
    "AutocorrelatedNoise",
    "Bank",
    "GaussianNoise",
    "MissingRowsWarning",
    "NoiseModel",
    "Outcome",
    "ReusedRows",
    "RowStore",
    "SimulationError",
    "SimulationInterrupted",
    "Simulations",
    "Simulator",
    "SimulatorModel",
    "SimulatorReport",
    "StudentTNoise",
    "check_simulator",
    "estimate_noise",
    "require_noise",
    "reuse",
    "simulate",
    "unknown_noise",
]

"""Simulators, their noise, and the engine that runs them."""

from sbi_active.simulation.engine import simulate
from sbi_active.simulation.model import Simulator, SimulatorModel, require_noise
from sbi_active.simulation.noise import GaussianNoise, NoiseModel
from sbi_active.simulation.outcomes import Outcome, Simulations

__all__ = [
    "GaussianNoise",
    "NoiseModel",
    "Outcome",
    "Simulations",
    "Simulator",
    "SimulatorModel",
    "require_noise",
    "simulate",
]

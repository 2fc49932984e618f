"""Simulators, their noise, and the engine that runs them."""

from sbi_active.simulation.engine import Simulations, simulate
from sbi_active.simulation.model import Simulator, SimulatorModel, require_noise
from sbi_active.simulation.noise import GaussianNoise, NoiseModel

__all__ = [
    "GaussianNoise",
    "NoiseModel",
    "Simulations",
    "Simulator",
    "SimulatorModel",
    "require_noise",
    "simulate",
]

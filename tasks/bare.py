"""Simulators of machines with records, before anything that they lack is added."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from sbi_active.simulation import NoiseModel, SimulatorModel

__all__ = ["bare_simulator"]


def bare_simulator(
    fn: Callable[..., Any],
    parameter_names: Sequence[str],
    noise: NoiseModel,
    bound: Mapping[str, Any],
) -> SimulatorModel:
    """Return a simulator of all its defaults.

    Args:
        fn: Noise-free.
        parameter_names: Of theta.
        noise: Of the sensor.
        bound: Keyword arguments of :class:`SimulatorModel` in place of these.
    """
    options = {"noise": noise, "parameter_names": parameter_names}
    return SimulatorModel(fn, **{**options, **bound})

"""Machines with records: bare simulators, and tables of what they may lack."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch.distributions import Distribution, HalfNormal, Independent, Normal

from sbi_active.criticism import Effect
from sbi_active.simulation import NoiseModel, SimulatorModel

__all__ = ["bare_simulator", "half_normal", "keyword_effects", "normal"]


def bare_simulator(
    fn: Callable[..., Any],
    parameter_names: Sequence[str],
    noise: NoiseModel,
    bound: Mapping[str, Any],
) -> SimulatorModel:
    """Return a simulator of all its defaults.

    Args:
        fn: Noise-free function.
        parameter_names: Names of the parameters.
        noise: Noise of the sensor.
        bound: Keyword arguments of :class:`SimulatorModel` in place of these.
    """
    options = {"noise": noise, "parameter_names": parameter_names}
    return SimulatorModel(fn, **{**options, **bound})


def normal(sd: float, num: int = 1) -> Distribution:
    """Return the prior of numbers of either sign, by its standard deviation."""
    return Independent(Normal(torch.zeros(num), torch.full((num,), sd)), 1)


def half_normal(sd: float, num: int = 1) -> Distribution:
    """Return the prior of numbers >= 0, by the deviation of the normal."""
    return Independent(HalfNormal(torch.full((num,), sd)), 1)


def keyword_effects(table: str) -> list[Effect]:
    """Return effects that are keyword arguments of a simulator.

    Args:
        table: Two lines an effect: name, keywords, family, unit and prior, divided by
            bars, then the sentence of reports. The prior is a standard deviation, with
            "+-" for either sign.
    """
    lines = table.strip().splitlines()
    found = []
    for line, describe in zip(lines[::2], lines[1::2], strict=True):
        name, keywords, family, units, prior = (
            part.strip() for part in line.split("|")
        )
        names = keywords.split()
        make = normal if prior.startswith("+-") else half_normal
        effect = Effect.keyword(
            name,
            *names,
            prior=make(float(prior.removeprefix("+-")), len(names)),
            units=units,
            family=family or None,
            describe=describe.strip(),
        )
        found.append(effect)
    return found

"""The grid over what is unknown of the noise, from what a model declares."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.rivals.error_models import NoiseCell, NoiseGrid
from sbi_active.seeding import forked_generators
from sbi_active.simulation.noise.base import NoiseModel
from sbi_active.simulation.noise.posterior import NoisePosterior, SdGrid

#: Cells of the correlation time, from half a sample step to twice the recording, and
#: the prior probability of no correlation at all.
NUM_TIMES, INDEPENDENT = 14, 0.3
#: Draws that stand for a posterior over noise parameters.
NUM_DRAWS = 24
#: Sizes of what is beside the sensor's error in its deviations, a factor apart.
SMALLEST, LARGEST, FACTOR = 0.3, 40.0, 1.63


def declared_noise(
    noise: NoiseModel | None, measurements: Measurements, *, seed: int = 0
) -> NoiseGrid:
    """Return the errors that a declared noise model gives to the measurements.

    Along a time axis, noise that says nothing of a correlation has an unknown one: the
    correlation time is log-uniform, or zero. A posterior over the noise's parameters is
    represented by draws, or summed if it is a grid of a size and a correlation time.

    Args:
        noise: Noise of the simulator; None if the simulator is the draw, and its own
            deviation is the unit.
        measurements: Measured numbers.
        seed: Seed of the draws of the posterior.

    Raises:
        ValueError: If a declared standard deviation is zero.
    """
    if noise is None:
        return NoiseGrid(_correlated(measurements, np.ones(len(measurements))))
    names, rows = noise.parameter_names, noise.parameters[None]
    if noise.posterior is not None:
        if (grid := _product(noise, measurements)) is not None:
            return grid
        with forked_generators(seed, "noise"):
            rows = noise.posterior.sample(torch.Size([NUM_DRAWS])).double()
        rows = rows.reshape(NUM_DRAWS, -1)  # of one parameter they may be numbers
    cells: list[NoiseCell] = []
    weight = -np.log(len(rows))
    for row in rows:
        values = dict(zip(names, row.tolist(), strict=True))
        sds = np.array([v for k, v in values.items() if k.startswith("sd")])
        if not len(sds):  # a noise model of the user's, taken as Gaussian of its size
            sds = noise.declared_sds().numpy()
        if (sds <= 0).any():
            raise ValueError(
                "expected measurement noise with a standard deviation > 0; got "
                f"{noise}; declare the error of the measurement, since without one "
                "any residual is an effect"
            )
        sd = sds[_channel_of(measurements, len(sds))]
        df = values.get("df", np.inf)
        tau = values.get("correlation_time")
        if tau is None and measurements.has_time and np.isinf(df):
            cells += _correlated(measurements, sd, weight)
            continue
        own = {"correlation_time": tau or 0.0, "df": df, "log_weight": weight}
        cells.append(NoiseCell.of(measurements, sd=sd, **own))
    return NoiseGrid(cells)


def _product(noise: NoiseModel, measurements: Measurements) -> NoiseGrid | None:
    """Return the sum over a grid of standard deviations times a correlation time.

    None unless the posterior is such a grid with independent parts, as one is that
    stands for noise of unknown size, in all channels or in each: a few draws of it
    would miss what the trials tell of the size to some percent.
    """
    posterior = noise.posterior
    if "correlation_time" not in noise.parameter_names or not (
        isinstance(posterior, NoisePosterior) and isinstance(posterior.sd, SdGrid)
    ):
        return None
    sd, weights = posterior.sd, posterior.sd.log_weight
    if not torch.equal(weights, weights[:1].expand_as(weights)):
        return None
    middle = (weights[0].exp() * sd.nodes.log()).sum(1).exp()
    unit = middle.numpy()[_channel_of(measurements, sd.num_channels)]
    cells = [
        NoiseCell.of(measurements, sd=unit, correlation_time=tau, log_weight=log_p)
        for tau, log_p in posterior.cells
    ]
    if sd.num_channels == 1:
        factors = (sd.nodes / middle[:, None]).numpy()[0]
        return NoiseGrid(cells, scales=factors, log_weights=weights[0, 0].numpy())
    # From a thirtieth of the sizes that fits tell to thirty times these.
    return NoiseGrid(cells, scales=np.geomspace(1 / 30, 30, 40), is_by_channel=True)


def measurement_sds(noise: NoiseModel | None, measurements: Measurements) -> Any:
    """Return the declared error of the sensor alone, None if there is none.

    Args:
        noise: The simulator's.
        measurements: Measured numbers.

    Returns:
        A number, or where channels have their own one a measured number, shape (N,).
    """
    sd = getattr(noise, "measurement_sd", None)
    if not isinstance(sd, torch.Tensor):
        return sd
    return sd.numpy()[_channel_of(measurements, len(sd))]


def scattered(noise: NoiseGrid) -> NoiseGrid:
    """Return the noise with an error of unknown size besides, summed out."""
    return noise.scaled(np.hypot(1, sizes(LARGEST)))


def sizes(largest: float) -> Array:
    """Return sizes of what is beside the sensor's error, in its deviations.

    Args:
        largest: The largest one.
    """
    num = 1 + round(np.log(largest / SMALLEST) / np.log(FACTOR))
    return np.geomspace(SMALLEST, largest, num)


def _correlated(
    measurements: Measurements, sd: Array, log_weight: float = 0.0
) -> list[NoiseCell]:
    if not measurements.is_sequence:
        return [NoiseCell.of(measurements, sd=sd, log_weight=log_weight)]
    times = np.geomspace(0.5 * measurements.step, 2 * measurements.span, NUM_TIMES)
    each = np.full(NUM_TIMES, np.log1p(-INDEPENDENT) - np.log(NUM_TIMES))
    some = zip([0.0, *times], [np.log(INDEPENDENT), *each], strict=True)
    return [
        NoiseCell.of(measurements, sd=sd, correlation_time=t, log_weight=log_weight + w)
        for t, w in some
    ]


def _channel_of(measurements: Measurements, num: int) -> NDArray[np.int64]:
    """Return the index of the declared standard deviation of each number."""
    if num == 1:
        return np.zeros(len(measurements), dtype=np.int64)
    last = measurements.shape[-1]
    if last != num:
        raise ValueError(
            f"expected a standard deviation for each of {last} channels; got {num}; "
            "give one an entry of x's last axis"
        )
    return measurements.position % last

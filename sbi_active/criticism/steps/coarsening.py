r"""How much evidence counts between models that are all wrong somewhere.

What a simulator gets wrong along a trajectory is one mistake, seen at many samples. A
noise of unknown size and correlation takes it up, but the evidence between two such
models then grows with the number of samples without end, and is sure of whichever is a
little less wrong. Where the error of measurement is known
(``AutocorrelatedNoise(measurement_sd=)``), the share w of the residual variance that is
measurement counts in full and the rest once a trial: log evidences are multiplied by

.. math::
    \alpha = w + (1 - w) \frac{t}{N}, \qquad
    w = \min\left(1, \frac{\sigma_m^2}{\hat\sigma^2}\right),

with t trials of N numbers in all, and :math:`\hat\sigma^2` the variance of the errors
under the most probable model.

References:
    Miller & Dunson, Journal of the American Statistical Association 114 (2019), 1113-
    1125: the power posterior of data that are near to a model and not from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.evidence.fit import Fit
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.error_models import NoiseGrid
from sbi_active.criticism.rivals.noise_grid import measurement_sds

Array = NDArray[Any]


def coarsening(rivals: RivalSet, log_p: Mapping[ModelKey, float]) -> float:
    r"""Return :math:`\alpha`, 1 where the error of measurement is not known.

    Args:
        rivals: The models, with their evidence.
        log_p: Unnormalized log posterior probabilities of those that count.
    """
    measurement_sd = measurement_sds(rivals.model.noise, rivals.measurements)
    if measurement_sd is None:
        return 1.0
    explained = [k for k in log_p if isinstance(rivals.fit(k).rival.error, NoiseGrid)]
    best = max(explained, key=log_p.__getitem__)
    trials = int(np.unique(rivals.measurements.trial).size)
    fit = rivals.fit(best)
    if np.ndim(measurement_sd) == 0:
        share = measurement_sd**2 / error_variance(fit)
    else:  # channels have units of their own
        share = float(np.minimum(measurement_sd**2 / error_variances(fit), 1).mean())
    return power(
        share,
        num_trials=trials,
        num_measurements=len(rivals.measurements),
    )


def error_variance(fit: Fit) -> float:
    """Return the mean variance of the errors under a model, at its likeliest draw."""
    noise = fit.rival.error
    assert isinstance(noise, NoiseGrid)
    share = noise.posterior(fit.rival.residual(fit.likeliest, penalized=False)[0][0])
    variance = np.array([(cell.sd**2).mean() for cell in noise.cells])
    return float(variance @ share @ noise.scales**2)


def error_variances(fit: Fit) -> Array:
    """Return the variance of each measured number's error, shape (N,), likewise."""
    noise = fit.rival.error
    assert isinstance(noise, NoiseGrid)
    share = noise.posterior(fit.rival.residual(fit.likeliest, penalized=False)[0][0])
    weight = share @ noise.scales**2
    return weight @ np.array([cell.sd**2 for cell in noise.cells])


def power(share: float, *, num_trials: int, num_measurements: int) -> float:
    r"""Return :math:`\alpha` for a share w of the variance that is measurement.

    Example:
        >>> power(0.0, num_trials=3, num_measurements=90)  # a trial counts once
        0.03333333333333333
        >>> power(1.0, num_trials=3, num_measurements=90)
        1.0
    """
    share = min(share, 1.0)
    return share + (1 - share) * num_trials / num_measurements

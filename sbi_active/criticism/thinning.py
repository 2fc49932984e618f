"""Trials without the samples that say again what others say."""

from __future__ import annotations

import numpy as np

from sbi_active.criticism.data.sampling import Sampling, suggested_sampling, thinned
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.linear.fits import sensor_of
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.noise_grid import measurement_sds


def thinned_to_need(rivals: RivalSet, trials: Trials) -> tuple[Trials, Sampling | None]:
    """Return trials without samples that the bare model's fit shows to be redundant.

    Trials are thinned only if ``measurement_sd`` declares the sensor's error: errors
    beyond it are the simulator's, and smooth.

    Args:
        rivals: The models of the trials that may be fitted.
        trials: All trials.

    Returns:
        The trials, as they are where nothing is to be left out; and what was found of
        their sampling, None if it was not looked at.
    """
    fit = rivals.trials
    own = fit.sample_times is not None
    times = fit.sample_times if own else rivals.model.sample_times
    if (
        times is None
        or measurement_sds(rivals.model.noise, rivals.measurements) is None
    ):
        return trials, None
    sensor = sensor_of(rivals)
    bare = Search(rivals, sensor).model(ModelKey())
    left = np.full(fit.x.numel(), np.nan)
    left[rivals.measurements.position] = sensor.unit * bare.residual
    sampling = suggested_sampling(fit, left.reshape(fit.x.shape), times)
    if sampling.every == 1:
        return trials, sampling
    return thinned(trials, sampling, trials.sample_times if own else times), sampling

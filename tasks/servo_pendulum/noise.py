"""Errors of unknown size and correlation."""

from __future__ import annotations

from sbi_active.simulation import AutocorrelatedNoise

__all__ = ["servo_noise"]

#: Standard deviation, rad: from some quanta of the encoder to the size of the motion.
SD = 0.005, 0.5
#: Correlation time, s: from a tenth of a sample's distance to the length of a trial.
CORRELATION_TIME = 0.02, 6.0
ENCODER_SD = 0.0015  # rad, one quantum
NO_TIME = 1e-6, 1.001e-6  # s; far below any distance of samples


def servo_noise(*, correlated: bool = True) -> AutocorrelatedNoise:
    r"""Return autocorrelated noise whose parameters have log-uniform priors.

    The encoder rounds to 1.5 mrad, which is nothing beside what any simulator of the
    servo gets wrong: the error is mostly the model's own, and of unknown size.

    Args:
        correlated: False forces errors that are independent, of unknown size.
    """
    return AutocorrelatedNoise.unknown(
        sd=SD,
        correlation_time=CORRELATION_TIME if correlated else NO_TIME,
        measurement_sd=ENCODER_SD,
        num_sds=60,
        num_times=12 if correlated else 1,
    )

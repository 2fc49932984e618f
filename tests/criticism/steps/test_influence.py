"""What a verdict rests on."""

import numpy as np
import pytest

from sbi_active.criticism.misfit.contrary import unless_refuted
from tests.criticism.report.reports import misfit, tracing


def verdict(left_out, held_out=(None, None), **options):
    """A verdict of models that miss, with errors of the bare one and with drag."""
    found = misfit(left_out, held_out, **options)
    made = tracing("unexplained", chosen=("drag",), beside=("drag",), misfit=found)
    return unless_refuted(made, None)


@pytest.mark.parametrize(
    ("left_out", "held_out", "where"),
    [
        ((1.45, 1.47), (None, None), "left-out trials"),
        ((1.45, 1.47), (0.31, 0.3), "left-out trials"),
        ((1.45, 1.2), (0.31, 5.2), "held-out trials"),
    ],
)
def test_what_raises_an_error_that_is_printed_does_not_help(left_out, held_out, where):
    made = verdict(left_out, held_out)
    assert (made.verdict, made.chosen) == ("unexplained", ())
    assert made.misfit.helps == ()
    assert made.refuted_on == where


def test_channels_count_in_sensor_deviations():
    # Position in meters falls by half, a force in newtons rises by a tenth.
    errors = np.array([0.2, 30.0]), np.array([0.1, 33.0])
    fine, coarse = (0.001, 10.0), (0.1, 1.0)
    assert verdict(errors, sensor=fine).chosen
    made = verdict(errors, sensor=coarse)
    assert not made.chosen
    assert made.refuted_on == "left-out trials in sensor deviations"

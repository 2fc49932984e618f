"""What a verdict rests on."""

import numpy as np
import pytest

from sbi_active.criticism.misfit.contrary import unless_refuted
from sbi_active.criticism.under_misfit import Misfit, ModelError, Support
from tests.criticism.report.reports import flat, report, tracing


def under_misfit(left_out, held_out=None, *, sensor=(0.005,)):
    """A verdict of models that miss, with errors of the bare one and with drag."""

    def model(name, i):
        held = None if held_out is None else np.atleast_1d(held_out[i])
        return ModelError(
            name=name,
            probability=float(i),
            left_out=np.atleast_1d(left_out[i]),
            held_out=held,
            remains=0.9,
        )

    misfit = Misfit(
        models=(model("none", 0), model("drag", 1)),
        helps=("drag",),
        named=(),
        support={"drag": Support(inclusion=0.9, better=0.9, gained=9.0, remains=0.9)},
        sensor=np.array(sensor),
        passes=False,
        size=40.0,
        time_scale=1.0,
    )
    return tracing("unexplained", chosen=("drag",), beside=("drag",), misfit=misfit)


@pytest.mark.parametrize(
    ("left_out", "held_out", "where"),
    [
        ((1.45, 1.47), None, "left-out trials"),
        ((1.45, 1.47), (0.31, 0.3), "left-out trials"),
        ((1.45, 1.2), (0.31, 5.2), "held-out trials"),
    ],
)
def test_what_raises_an_error_that_is_printed_does_not_help(left_out, held_out, where):
    made = unless_refuted(under_misfit(left_out, held_out), None)
    assert (made.verdict, made.chosen) == ("unexplained", ())
    assert made.misfit.helps == ()
    text = flat(report(tracing=made, evaluation=None))
    assert text.startswith(
        "Verdict: unexplained: the model misses the trials, and no declared effect "
        f"helps: drag does not lower the error on {where}"
    )
    assert "predicts better" not in text
    told = f"With drag the error on left-out trials goes from 1.45 to {left_out[1]}"
    told += (
        "" if held_out is None else f", on held-out trials from 0.31 to {held_out[1]}"
    )
    assert f"{told}." in text
    before, after = left_out if where.startswith("left") else held_out
    assert f"on {where}: RMSE {before} before and {after} after" in text


def test_channels_count_in_sensor_deviations():
    # Position in meters falls by half, a force in newtons rises by a tenth.
    errors = np.array([0.2, 30.0]), np.array([0.1, 33.0])
    fine, coarse = (0.001, 10.0), (0.1, 1.0)
    assert unless_refuted(under_misfit(errors, sensor=fine), None).chosen
    made = unless_refuted(under_misfit(errors, sensor=coarse), None)
    assert not made.chosen
    assert made.refuted_on == "left-out trials in sensor deviations"

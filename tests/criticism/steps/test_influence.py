"""What a verdict rests on."""

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

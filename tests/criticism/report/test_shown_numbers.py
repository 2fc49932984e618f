"""Numbers in the report: parameters, effects and actions, with their digits."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from sbi_active.criticism import Trials
from sbi_active.criticism.report import with_error
from tests.criticism.report.reports import (
    first_paragraph,
    flat,
    report,
    residuals,
    tracing,
)


def test_parameters_stand_before_and_after():
    table = report().parameters.set_index("parameter")
    assert [*table.index] == ["mu_1", "mu_2", "drag"]
    assert np.isnan(table.loc["drag", "before"])
    assert table.loc["drag", "after"] == pytest.approx(0.3, abs=4 * 0.01 / 20)


def test_numbers_have_the_digits_that_their_deviation_leaves():
    assert with_error(0.35992, 0.00071) == "0.35992 +- 0.00071"
    assert with_error(-1234.56, 56.7) == "-1235 +- 57"
    assert with_error(0.3, 0.0996) == "0.30 +- 0.10"
    assert with_error(3.2e-7, 1e-8) == "3.2e-07 +- 1e-08"
    assert with_error(2.0, 0.0) == "2 +- 0"
    assert with_error(np.nan, np.nan) == ""


def test_a_mean_has_six_digits_at_most():
    assert with_error(159.873313255026034, 2.8e-14) == "159.873 +- 2.8e-14"
    assert with_error(-0.00123456789, 1e-12) == "-0.00123457 +- 1e-12"
    assert with_error(0.123456, 0.0000071) == "0.123456 +- 7.1e-06"
    assert with_error(123456.4, 0.3) == "123456 +- 0.3"
    assert with_error(0.0, 1e-3) == "0.0000 +- 0.0010"


def test_a_deviation_of_phi_needs_draws_behind_it():
    every = tracing().estimates
    few = [replace(e, effective_sample_size=49.0) for e in every]
    text = flat(report(tracing=replace(tracing(), estimates=(*few,))))
    assert "0.123 +- 0.011 1/m" in flat(report())
    assert "0.123 +- 0.011 1/m" not in text
    assert "about 0.12 1/m" in text
    assert "below 50 too few for a deviation of phi" in text


def test_a_deviation_of_a_parameter_needs_draws_behind_it():
    made = tracing()
    few = replace(made.evidences["none"], effective_sample_size=2.2)
    whole = flat(report())
    text = flat(report(tracing=replace(made, evidences=made.evidences | {"none": few})))
    before, after = re.search(r"mu_1 (\S+ \+- \S+) (\S+ \+- \S+)", whole).groups()
    about = f"about {float(before.split()[0]):.2g}"
    assert f"mu_1 {about} {after}" in text
    assert '"about": below 50 effective samples' in text
    assert "below 50 effective samples" not in whole


def shifted(*shifts):
    """Return a report whose verdict moves the parameters by so many deviations."""
    made = tracing()
    draws = made.evidences["none"].draws
    draws = (draws - draws.mean(0)) / draws.std(0) * 0.01 + 0.3
    names = tuple(f"mu_{i + 1}" for i in range(len(shifts)))
    wide = np.resize(draws[:, :1], (len(draws), 1)).repeat(len(shifts), 1)
    after = wide + 0.01 * np.array(shifts)
    none = replace(made.evidences["none"], names=names, draws=wide)
    drag = replace(
        made.evidences["drag"],
        names=(*names, "drag"),
        draws=np.column_stack([after, draws[:, 0]]),
    )
    evidences = {**made.evidences, "none": none, "drag": drag}
    return first_paragraph(report(tracing=replace(made, evidences=evidences)))


def test_parameters_that_the_verdict_moves_are_told_the_farthest_first():
    assert (
        "Against the bare fit the verdict moves mu_2 by -0.9 to -0.6 (90 of its "
        "standard deviations), mu_1 by +0.02 to 0.32 (2 of its standard deviations)."
    ) in shifted(2.0, -90.0, 0.5)
    assert "moves mu_5 by +0.08 to 0.38" in shifted(1.0, 1.5, 2.0, 4.0, 8.0)
    assert "(2 of its standard deviations), and 2 more" in shifted(1.1, 1.5, 2, 4, 8)
    assert "No parameter moves by more than its standard deviation" in shifted(0.5, 0)


def test_a_bare_fit_of_one_draw_has_no_deviation_to_count_in():
    made = tracing()
    evidences = dict(made.evidences)
    evidences["none"] = replace(evidences["none"], draws=np.full((400, 2), 0.1))
    first = first_paragraph(report(tracing=replace(made, evidences=evidences)))
    assert "(more than 1000 of its standard deviations)" in first
    assert "inf" not in first
    assert "nan" not in first


def test_one_action_alone_is_told_as_one():
    once = replace(residuals(size=6.0), action=np.full((8, 1), 2.0))
    assert "No other action was tried than speed = 2 m/s." in flat(
        report(residuals=once)
    )


def test_many_entries_of_an_action_are_not_all_told():
    action = np.arange(40.0).reshape(8, 5)
    made = report(
        residuals=replace(residuals(size=6.0), action=action),
        trials=Trials(torch.tensor(action), torch.randn(8, 6)),
        actions=None,
        next_action=None,
    )
    assert (
        "these 8: action 1 from 0 to 35, action 2 from 1 to 36, action 3 from 2 to "
        "37, and 2 more entries."
    ) in flat(made)

"""The report from its parts: summary, sections, numbers, and its other forms."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active.criticism import joint_prior
from sbi_active.criticism.contradictions import SevereTest
from sbi_active.criticism.report.summary import sentences
from sbi_active.criticism.report.words import with_error
from tests.criticism.report.reports import (
    DRAG,
    evaluation,
    flat,
    misfit,
    report,
    tracing,
)

TESTS = (
    SevereTest(action=np.array([3.0]), is_permitted=True, difference=1.234),
    SevereTest(action=np.array([4.5]), is_permitted=False, difference=56.7),
)


def test_a_dictionary_has_no_probabilities_where_they_contradict_the_verdict():
    plain = report().to_dict()
    assert plain["probabilities"] == pytest.approx(report().probabilities)
    assert plain["misfit"] is None
    withdrawn = report(tracing=tracing("unexplained", instead_of="drag")).to_dict()
    assert withdrawn["probabilities"] is withdrawn["credible_set"] is None


def test_tables_do_not_contradict_a_verdict_of_other_trials():
    missed = misfit((0.9, 0.2), named=("drag",), sensor=(0.1,))
    made = report(tracing=tracing(misfit=missed), evaluation=None)
    assert flat(made).startswith("Verdict: drag, probably the cause")
    assert "probabilities.png" not in made.to_markdown()
    refuted = tracing("unexplained", instead_of="drag", refuted=(1.0, 2.0))
    withdrawn = report(tracing=refuted)
    assert flat(withdrawn).startswith("Verdict: unexplained, and not drag ")
    for each in (made, withdrawn):  # no probability among wrong models
        assert "model phi log BF ESS" in flat(each)


def test_scores_stand_before_and_after():
    table = report().before_after
    assert [*table.columns] == ["metric", "before", "after", "ratio", "interval"]
    rmse = table.set_index("metric").loc["rmse"]
    assert rmse["interval"] == pytest.approx((0.9 * rmse["ratio"], 1.1 * rmse["ratio"]))
    made = report(evaluation=evaluation(5))
    assert made.before_after["interval"].isna().all()


GROUP = frozenset({"tilt", "none"})
BEYOND = {
    "outside": np.array([-3.0]),
    "outside_separates": ("none", "tilt"),
    "outside_gain": 0.6,
}


@pytest.mark.parametrize("form", [str, "to_markdown", "to_html"])
def test_what_no_permitted_action_separates_is_printed_everywhere(form):
    groups = (GROUP, frozenset({"drag", "bias"}))
    chosen = replace(report().next_action, action=None, inseparable=groups, **BEYOND)
    made = report(next_action=chosen)
    text = " ".join((str(made) if form is str else getattr(made, form)()).split())
    assert (
        "no permitted action separates none and tilt; speed = -3 m/s, which is not "
        "permitted, would: at least 0.60 nats"
    ) in text
    assert "no permitted action separates bias and drag" in text
    assert "no permitted action separates bias and drag;" not in text


def test_a_deviation_needs_draws_behind_it():
    made = tracing()
    estimates = [replace(e, effective_sample_size=49.0) for e in made.estimates]
    few = replace(
        made.evidences["none"], effective_sample_size=2.2, draws=np.full((400, 2), 0.1)
    )
    evidences = made.evidences | {"none": few}
    text = flat(
        report(tracing=replace(made, estimates=(*estimates,), evidences=evidences))
    )
    assert "about 0.12 1/m" in text
    assert "mu_1 about 0.1 " in text
    assert '"about": below 50 effective samples' in text
    assert "(more than 1000 of its standard deviations)" in text
    assert "about" not in flat(report()).split("Parameters")[1].split("Next")[0]


@pytest.mark.parametrize(
    ("mean", "sd", "text"),
    [
        (0.35992, 0.00071, "0.35992 +- 0.00071"),
        (-1234.56, 56.7, "-1235 +- 57"),
        (0.3, 0.0996, "0.30 +- 0.10"),
        (3.2e-7, 1e-8, "3.2e-07 +- 1e-08"),
        (2.0, 0.0, "2 +- 0"),
        (np.nan, np.nan, ""),
        (159.873313255026034, 2.8e-14, "159.873 +- 2.8e-14"),
        (-0.00123456789, 1e-12, "-0.00123457 +- 1e-12"),
        (123456.4, 0.3, "123456 +- 0.3"),
    ],
)
def test_numbers_have_the_digits_that_their_deviation_leaves(mean, sd, text):
    assert with_error(mean, sd) == text


def test_a_report_goes_through_json_with_all_sections():
    made = report(severe_tests=TESTS)
    again = json.loads(json.dumps(made.to_dict(), allow_nan=False))
    assert again["verdict"] == "drag"
    assert " ".join(again["summary"]) == " ".join(sentences(made))
    assert again["next_action"]["action"] == [3.0]
    assert len(again["residuals_by_trial"]) == 8
    titles = [section["title"] for section in again["sections"]]
    assert titles == [t for t in str(made).splitlines() if t in titles]
    assert again["sections"][0]["table"]["header"][0] == "model"


def test_a_report_pickles_with_effects_that_are_local_functions():
    made = report(prior=joint_prior(BoxUniform(torch.zeros(2), torch.ones(2)), [DRAG]))
    with pytest.raises((AttributeError, pickle.PicklingError), match="lambda"):
        pickle.dumps(DRAG)
    again = pickle.loads(pickle.dumps(made))
    assert str(again) == str(made)
    assert again.prior.sample((4,)).shape == (4, 3)
    theta, action = torch.ones(2, 2), torch.ones(2, 1)
    assert (again.simulator.mean(theta, action) == 1).all()

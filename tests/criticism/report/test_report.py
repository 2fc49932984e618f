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
from sbi_active.criticism.report.sections import sentences
from sbi_active.criticism.report.words import with_error
from tests.criticism.report.reports import DRAG, flat, report, tracing

NONE = {"tracing": tracing("none"), "residuals_after": None}


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


def test_only_a_bare_model_that_holds_is_a_stop():
    plan = replace(report().next_action, action=None)
    left, alone = (replace(plan, separates=(name,)) for name in ("none", "drag"))
    text = flat(report(next_action=plan, **NONE))
    assert "Stop: no permitted action tells more" in text
    text = flat(report(next_action=left, **NONE))
    assert "Stop: of the declared models only none is left." in text
    text = flat(report(next_action=alone))
    assert "Of the declared models only drag is left." in text


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
        (2.0, 0.0, "2 +- 0"),
        (np.nan, np.nan, ""),
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

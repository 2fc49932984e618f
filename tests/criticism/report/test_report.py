"""The report from its parts: summary, sections, numbers, and its other forms."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active.criticism import Trials, joint_prior
from sbi_active.criticism.contradictions import SevereTest
from sbi_active.criticism.report.sections import sentences
from sbi_active.criticism.report.words import with_error
from sbi_active.criticism.under_misfit import Misfit, ModelError, Support
from tests.criticism.report.reports import (
    DRAG,
    evaluation,
    flat,
    report,
    residuals,
    tracing,
)

NONE = {"tracing": tracing("none"), "residuals_after": None}
TESTS = (
    SevereTest(action=np.array([3.0]), is_permitted=True, difference=1.234),
    SevereTest(action=np.array([4.5]), is_permitted=False, difference=56.7),
)


def first_line(**changes):
    return str(report(**changes)).splitlines()[0]


def test_the_verdict_line_says_what_limits_it():
    assert first_line() == "Verdict: drag (P = 0.81)"
    limits = {"robust": False, "equivalent": (frozenset({"drag", "bias"}),)}
    assert first_line(tracing=tracing(**limits)) == (
        "Verdict: drag (P = 0.81), not robust to its prior; no permitted action tells "
        "it from bias"
    )
    assert first_line(**NONE) == (
        "Verdict: none (P < .01), no alarm, though drag is likelier (P = 0.81)"
    )
    shares = NONE["tracing"].probabilities | {"none": 0.9, "drag": 0.05}
    sure = replace(NONE["tracing"], probabilities=shares)
    assert first_line(tracing=sure, residuals_after=None) == "Verdict: none (P = 0.90)"


def test_a_dictionary_has_no_probabilities_where_they_contradict_the_verdict():
    plain = report().to_dict()
    assert plain["probabilities"] == pytest.approx(report().probabilities)
    assert plain["misfit"] is None
    withdrawn = report(tracing=tracing("unexplained", instead_of="drag")).to_dict()
    assert withdrawn["probabilities"] is withdrawn["credible_set"] is None


def under_misfit(**changes):
    """Return a report where every model misses, and drag is probably the cause."""
    support = Support(inclusion=0.98, better=0.99, gained=90.0, remains=0.1)
    models = tuple(
        ModelError(
            name=name,
            probability=p,
            left_out=np.array([error]),
            held_out=None,
            remains=remains,
        )
        for name, p, error, remains in (("drag", 0.97, 0.2, 0.15), ("none", 0, 0.9, 1))
    )
    misfit = Misfit(
        models=models,
        helps=("drag",),
        named=("drag",),
        support={"drag": support},
        sensor=np.array([0.1]),
        passes=False,
        size=5.0,
        time_scale=0.25,
    )
    return report(tracing=tracing(misfit=misfit, **changes), evaluation=None)


def test_tables_do_not_contradict_a_verdict_of_other_trials():
    made = under_misfit()
    text = flat(made)
    assert text.startswith(
        "Verdict: drag, probably the cause (inclusion 0.98, leaves 10 % of the "
        "excess), beside something undeclared"
    )
    assert "With drag the error on left-out trials goes from 0.9 to 0.2." in text
    assert "15 % of the excess over the sensor's remains" in text
    assert "a time scale of 0.25 s" in text
    assert "model phi log BF ESS" in text  # and no probability among wrong models
    assert "probabilities.png" not in made.to_markdown()
    withdrawn = report(
        tracing=tracing("unexplained", instead_of="drag", refuted=(1.0, 2.0))
    )
    assert flat(withdrawn).startswith("Verdict: unexplained, and not drag ")
    assert "model phi log BF ESS" in flat(withdrawn)
    assert "drag is not named, as the warnings say" in flat(withdrawn)


def test_a_guess_is_called_a_guess():
    assert report(tracing=tracing("unexplained")).guess is None
    sure = report(tracing=tracing("unexplained", guesses=(("c xi^2", 3.1),)))
    assert sure.guess == "c xi^2"
    assert "a guess, not declared: c xi^2" in str(sure).splitlines()[0]


def test_scores_stand_before_and_after():
    table = report().before_after
    assert [*table.columns] == ["metric", "before", "after", "ratio", "interval"]
    rmse = table.set_index("metric").loc["rmse"]
    assert rmse["interval"] == pytest.approx((0.9 * rmse["ratio"], 1.1 * rmse["ratio"]))
    made = report(evaluation=evaluation(5))
    assert made.before_after["interval"].isna().all()
    assert "Below 8 trials" in flat(made)
    for i in range(5):
        before, after = (
            s["rmse"][i] for s in (made.evaluation.before, made.evaluation.after)
        )
        assert f"- held-out trial {i}: RMSE {before:.3g} -> {after:.3g}" in flat(made)
    folds = replace(
        evaluation(), scheme="leave one out", selected=("drag",) * 7 + ("x",)
    )
    assert "7 of 8 such verdicts are drag" in flat(report(evaluation=folds))


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


def test_only_a_bare_model_that_holds_is_a_stop():
    plan = replace(report().next_action, action=None)
    left = replace(plan, separates=("none",))
    assert "Stop: no permitted action tells more" in flat(
        report(next_action=plan, **NONE)
    )
    assert "Stop: of the declared models only none is left." in flat(
        report(next_action=left, **NONE)
    )
    alone = replace(plan, separates=("drag",))
    assert "Of the declared models only drag is left." in flat(
        report(next_action=alone)
    )


def test_a_label_is_called_by_the_name_of_its_trial():
    names = tuple(f"drop {letter}" for letter in "abcdefgh")
    labelled = Trials(None, torch.randn(8, 6), names=names, start=torch.zeros(8))
    own = replace(residuals(), action=np.arange(8.0)[:, None], names=names)
    plan = replace(report().next_action, action=np.array([3.0]))
    made = report(trials=labelled, residuals=own, next_action=plan, actions=None)
    assert "Measure next at the inputs of trial drop d" in flat(made)
    assert "trial = " not in flat(made)


def shifted(*shifts):
    """Return a report whose verdict moves the parameters by so many deviations."""
    made = tracing()
    draws = made.evidences["none"].draws[:, :1]
    draws = (draws - draws.mean()) / draws.std() * 0.01 + 0.3
    names = tuple(f"mu_{i + 1}" for i in range(len(shifts)))
    wide = draws.repeat(len(shifts), 1)
    none = replace(made.evidences["none"], names=names, draws=wide)
    drag = replace(
        made.evidences["drag"],
        names=(*names, "drag"),
        draws=np.column_stack([wide + 0.01 * np.array(shifts), draws]),
    )
    evidences = {**made.evidences, "none": none, "drag": drag}
    return flat(report(tracing=replace(made, evidences=evidences)))


def test_parameters_that_the_verdict_moves_are_told_the_farthest_first():
    assert (
        "Against the bare fit the verdict moves mu_2 by -0.9 to -0.6 (90 of its "
        "standard deviations), mu_1 by +0.02 to 0.32 (2 of its standard deviations)."
    ) in shifted(2.0, -90.0, 0.5)
    assert "(2 of its standard deviations), and 2 more" in shifted(1.1, 1.5, 2, 4, 8)
    assert "No parameter moves by more than its standard deviation" in shifted(0.5, 0)


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

"""The four sentences that a report begins with."""

from dataclasses import replace

import pytest

from sbi_active.criticism.report.sections import sentences
from tests.criticism.report.reports import flat, report, tracing


def test_the_paragraph_is_four_sentences():
    missing, errors, left, following = sentences(report())
    assert missing == (
        "The bare model misses the 8 trials: it lacks drag (a force against the "
        "speed); not excluded: tilt (P = 0.12)."
    )
    rmse = report().before_after.set_index("metric").loc["rmse"]
    before, after, ratio = (f"{rmse[n]:.3g}" for n in ("before", "after", "ratio"))
    low, high = (f"{end:.3g}" for end in rmse["interval"])
    assert f"goes from {before} to {after} (ratio {ratio}, 90 % interval" in errors
    assert f"{low} to {high})." in errors
    assert left.startswith("What drag leaves has a root mean square of ")
    worst = report().residuals_by_trial.iloc[0]
    assert f"trial {worst['trial']} has most, {worst['deviations']:.3g}" in left
    assert following == "Measure next at speed = 3 m/s, to tell drag and tilt apart."
    whole = " ".join(str(report()).split("\n\n")[0].split())
    assert whole.endswith(" ".join([missing, errors, left, following]))


@pytest.mark.parametrize(
    ("verdict", "missing", "advice"),
    [
        ("none", "The bare model explains the 8 trials.", "Nothing asks for another"),
        ("unexplained", "no declared effect explains", "declare what else may be"),
        ("scatter", "scatter more than the declared noise", "an action again"),
        ("outlier", "one trial does not agree", "Check and repeat one trial"),
    ],
)
def test_the_sentences_of_what_names_no_effect(verdict, missing, advice):
    plan = replace(report().next_action, action=None)
    made = report(tracing=tracing(verdict), evaluation=None, next_action=plan)
    first, errors, _, following = sentences(made)
    assert missing in first
    assert errors == "No trial was scored."
    assert advice in following
    assert "P holds among" not in flat(made)
    assert "stop" not in flat(made).lower() or verdict == "none"

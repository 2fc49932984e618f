"""The report from its parts: what is printed when, and what the page contains."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active.criticism import joint_prior
from sbi_active.criticism.cautions import find_warnings
from sbi_active.criticism.headline import with_error
from tests.criticism.reports import (
    DRAG,
    evaluation,
    flat,
    left_out,
    report,
    residuals,
    tracing,
    trials,
)


def test_the_verdict_is_in_the_first_line():
    first = str(report()).splitlines()[0]
    assert first == "Verdict: drag (P = 0.81)"


def test_the_verdict_line_says_what_limits_it():
    made = report(
        tracing=tracing(
            robust=False,
            equivalent=(frozenset({"drag", "bias"}),),
        )
    )
    assert str(made).splitlines()[0] == (
        "Verdict: drag (P = 0.81), not robust to its prior; no permitted action tells "
        "it from bias"
    )


def test_a_guess_is_called_a_guess():
    unsure = report(tracing=tracing("unexplained"))
    assert unsure.guess is None
    assert "guess, not declared" not in flat(unsure)
    sure = report(tracing=tracing("unexplained", guesses=(("c xi^2", 3.1),)))
    assert sure.guess == "c xi^2"
    assert "a guess, not declared: c xi^2" in flat(sure)


def test_scatter_is_no_cause():
    text = str(report(tracing=tracing("scatter"), residuals_after=None))
    assert text.startswith("Verdict: scatter")
    assert "which is no cause" in text


def test_before_after_has_its_columns_and_intervals():
    table = report().before_after
    assert [*table.columns] == ["metric", "before", "after", "ratio", "interval"]
    rmse = table.set_index("metric").loc["rmse"]
    assert rmse["ratio"] == pytest.approx(rmse["after"] / rmse["before"])
    assert rmse["interval"] == pytest.approx((0.9 * rmse["ratio"], 1.1 * rmse["ratio"]))


def test_few_scored_trials_have_no_interval_and_say_so():
    made = report(evaluation=evaluation(5))
    assert made.before_after["interval"].isna().all()
    assert "Below 8 trials" in flat(made)
    scores = made.evaluation
    for i in range(5):
        before, after = scores.before["rmse"][i], scores.after["rmse"][i]
        assert f"- held-out trial {i}: RMSE {before:.3g} -> {after:.3g}" in flat(made)
    assert "Below 8 trials" not in flat(report())


def test_parameters_stand_before_and_after():
    table = report().parameters.set_index("parameter")
    assert [*table.index] == ["mu_1", "mu_2", "drag"]
    assert np.isnan(table.loc["drag", "before"])
    assert table.loc["drag", "after"] == pytest.approx(0.3, abs=4 * 0.01 / 20)


def test_left_out_trials_say_how_often_the_verdict_was_the_same():
    folds = (*["drag"] * 7, "tilt")
    scores = replace(evaluation(), scheme="leave one out", selected=folds)
    text = flat(report(evaluation=scores))
    assert "8 trials, each predicted by models that were chosen and fitted" in text
    assert "7 of 8 such verdicts are drag" in text


def test_a_report_pickles_with_effects_that_are_local_functions():
    made = report(prior=joint_prior(BoxUniform(torch.zeros(2), torch.ones(2)), [DRAG]))
    with pytest.raises((AttributeError, pickle.PicklingError), match="lambda"):
        pickle.dumps(DRAG)
    again = pickle.loads(pickle.dumps(made))
    assert str(again) == str(made)
    assert again.prior.sample((4,)).shape == (4, 3)
    theta, action = torch.ones(2, 2), torch.ones(2, 1)
    assert (again.simulator.mean(theta, action) == 1).all()


def test_the_first_sentences_have_the_error_with_its_interval():
    rmse = report().before_after.set_index("metric").loc["rmse"]
    before, after, ratio = (f"{rmse[n]:.3g}" for n in ("before", "after", "ratio"))
    low, high = (f"{end:.3g}" for end in rmse["interval"])
    sentence = f"goes from {before} to {after} (ratio {ratio}, 90 % interval {low} to "
    assert f"{sentence}{high})." in flat(report())
    assert f"goes from {before} to {after}." in flat(
        report(
            evaluation=replace(
                evaluation(), table=evaluation().table.assign(low=np.nan, high=np.nan)
            )
        )
    )


def test_numbers_have_the_digits_that_their_deviation_leaves():
    assert with_error(0.35992, 0.00071) == "0.35992 +- 0.00071"
    assert with_error(-1234.56, 56.7) == "-1235 +- 57"
    assert with_error(0.3, 0.0996) == "0.30 +- 0.10"
    assert with_error(3.2e-7, 1e-8) == "3.2e-07 +- 1e-08"
    assert with_error(2.0, 0.0) == "2 +- 0"
    assert with_error(np.nan, np.nan) == ""


def test_tables_stand_in_columns():
    lines = str(report()).splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("model  "))
    rows = lines[start : start + 7]
    assert " ".join(rows[0].split()) == "model P phi log BF ESS 90 % set"
    assert rows[1].startswith("drag  ")
    assert "0.123 +- 0.011 1/m" in rows[1]
    ends = {row.index("312") + 3 for row in rows if "312" in row}
    assert ends == {rows[0].index("ESS") + 3}
    assert max(map(len, lines)) <= 88


def test_leaving_one_out_stands_beside_the_evidence():
    text = flat(report())
    assert "bare model -157.2 0.20 none with drag 18.8 0.20 none" in text
    assert "a trial decides so much" not in text
    assert "k > 0.62" in text  # 1 - 1 / log10 of 400 draws
    unsure = left_out("drag", density=2, k=0.9)
    text = flat(report(leave_one_out=(left_out("none", density=-20), unsure)))
    assert "with drag 18.8 0.90 3, 5" in text
    assert "a trial decides so much" in text


def test_the_residual_process_is_not_left_one_out():
    only = (left_out("none", density=-20),)
    text = flat(report(tracing=tracing("unexplained"), leave_one_out=only))
    assert "The residual process joins the trials" in text
    assert "Leave one out" not in flat(report(leave_one_out=()))


def stopped(**changes):
    """Return a report in which no permitted action is worth a trial."""
    return report(next_action=replace(report().next_action, action=None, **changes))


GROUP = frozenset({"tilt", "none"})
BEYOND = {
    "outside": np.array([-3.0]),
    "outside_separates": ("none", "tilt"),
    "outside_gain": 0.6,
}


@pytest.mark.parametrize("setting", ["text", "markdown", "page"])
def test_what_no_permitted_action_separates_is_printed_everywhere(setting):
    def words(made):
        page = {"text": str, "markdown": type(made).to_markdown}
        return " ".join(page.get(setting, type(made).to_html)(made).split())

    made = words(stopped(inseparable=(GROUP, frozenset({"drag", "bias"})), **BEYOND))
    assert (
        "no permitted action separates none and tilt; speed = -3 m/s, which is not "
        "permitted, would: at least 0.60 nats"
    ) in made
    alone = "no permitted action separates bias and drag"
    assert alone in made
    assert f"{alone};" not in made
    assert "no permitted action separates" not in words(report())


def test_an_action_that_is_chosen_can_leave_a_group_unseparated():
    chosen = replace(report().next_action, inseparable=(GROUP,))
    text = flat(report(next_action=chosen))
    assert "speed = 3 m/s: at least 0.41 nats between drag, tilt" in text
    assert "- no permitted action separates none and tilt" in text


def test_nothing_more_to_do_is_a_stop():
    worth = "Stop: no permitted action tells more about which model is right than 0.410"
    assert worth in flat(stopped())
    assert "Stop: no model but drag is left." in flat(stopped(separates=("drag",)))
    assert "speed = 3 m/s: at least 0.41 nats between drag, tilt" in flat(report())


def test_a_report_of_a_right_model_has_no_warnings():
    arguments = {"trials": trials(), "residuals": residuals(), "tracing": tracing()}
    assert find_warnings(**arguments) == ()
    assert "Warnings" not in str(report())

"""The report from its parts: what is printed when, and what the page contains."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import AutocorrelatedNoise, SimulatorModel
from sbi_active.criticism import Trials, joint_prior
from sbi_active.criticism.contradictions import MissedTrial, SevereTest
from sbi_active.criticism.report import find_warnings
from tests.criticism.report.reports import (
    DRAG,
    evaluation,
    first_paragraph,
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


def test_a_verdict_of_none_says_what_is_likelier():
    made = tracing("none")
    line = str(report(tracing=made, residuals_after=None)).splitlines()[0]
    assert line == (
        "Verdict: none (P < .01), no alarm, though drag is likelier (P = 0.81)"
    )
    sure = replace(made, probabilities=made.probabilities | {"none": 0.9, "drag": 0.05})
    line = str(report(tracing=sure, residuals_after=None)).splitlines()[0]
    assert line == "Verdict: none (P = 0.90)"


def test_what_is_withdrawn_has_no_probability_that_is_another_s():
    made = tracing("unexplained", instead_of="drag", refuted=(1.0, 2.0))
    text = flat(report(tracing=made))
    assert text.startswith("Verdict: unexplained, and not drag ")
    assert "drag is not named, as the warnings say" in text


def test_many_held_out_trials_are_counted_in_the_line_and_named_below():
    missed = tuple(
        MissedTrial(position=i, name=f"{i}", size=60.0 - i, p_value=0.0, by_both=True)
        for i in range(4)
    )
    made = report(evaluation=replace(evaluation(), missed=missed))
    assert str(made).splitlines()[0].endswith("; 4 held-out trials are far outside it")
    for i in range(4):
        assert f"Held-out trial {i} is far outside what" in flat(made)
        assert any(f"held-out trial {i} is far" in w for w in made.warnings)


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


def test_residuals_stand_beside_the_sensor_s_error_in_the_unit_of_x():
    noise = AutocorrelatedNoise(0.1, 1.0, measurement_sd=0.06)
    model = SimulatorModel(lambda theta, action: theta, noise=noise)
    before, after = residuals(size=2.0), residuals(size=0.5)
    rms = [float(np.sqrt(((r.x - r.mean) ** 2).mean())) for r in (before, after)]
    x, times = torch.randn(8, 6), torch.arange(6.0)
    action, labels = trials().action, ["voltage [V]"]
    named = Trials(action, x, sample_times=times, channel_labels=labels)
    text = flat(
        report(
            trials=named,
            simulator=model,
            residuals=before,
            residuals_after=after,
        )
    )
    assert (
        f"What is left, root mean square: {rms[0]:.2g} V with the bare model, "
        f"{rms[0] / 0.06:.2g} times the sensor's 0.06 V, {rms[1]:.2g} V with drag, "
        f"{rms[1] / 0.06:.2g} times."
    ) in text
    assert "What is left" not in flat(report())


def test_residuals_of_channels_have_their_own_units():
    noise = AutocorrelatedNoise(0.1, 1.0, measurement_sd=[0.1, 20.0])
    model = SimulatorModel(lambda theta, action: theta, noise=noise)
    made = residuals((10, 2), times=np.linspace(0, 1, 10))
    scaled = replace(made, x=made.x * [1, 100], mean=made.mean * [1, 100])
    rms = np.sqrt(((scaled.x - scaled.mean) ** 2).mean((0, 1)))
    x, labels = torch.randn(8, 10, 2), ["angle [rad]", "force [N]"]
    named = Trials(trials().action, x, channel_labels=labels)
    text = flat(
        report(
            trials=named,
            simulator=model,
            residuals=scaled,
            residuals_after=None,
            tracing=tracing("none"),
        )
    )
    assert (
        f"root mean square: angle: {rms[0]:.2g} rad with the bare model, "
        f"{rms[0] / 0.1:.2g} times the sensor's 0.1 rad; force: {rms[1]:.2g} N with "
        f"the bare model, {rms[1] / 20:.2g} times the sensor's 20 N."
    ) in text


def test_tables_stand_in_columns():
    lines = str(report()).splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("model  "))
    rows = [lines[start], *lines[start + 2 : start + 8]]
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


def test_only_a_bare_model_that_holds_is_a_stop():
    none = {"tracing": tracing("none"), "residuals_after": None}
    plan = replace(report().next_action, action=None)
    worth = "no permitted action tells more about which declared model is right than 0"
    assert f"Stop: {worth}.410" in flat(report(next_action=plan, **none))
    left = replace(plan, separates=("none",))
    assert "Stop: of the declared models only none is left." in flat(
        report(next_action=left, **none)
    )
    assert "speed = 3 m/s: at least 0.41 nats between drag, tilt" in flat(report())


@pytest.mark.parametrize(
    ("verdict", "advice"),
    [
        ("drag", "Of the declared models only drag is left."),
        ("unexplained", "only unexplained is left. Declare what else the simulator"),
        ("scatter", "only scatter is left. Repeat an action to see how large it is."),
    ],
)
def test_a_model_that_is_left_is_no_stop(verdict, advice):
    told = {"tracing": tracing(verdict)}
    alone = replace(report().next_action, action=None, separates=(verdict,))
    several = replace(report().next_action, action=None)
    assert advice in flat(report(next_action=alone, **told))
    for plan in (alone, several):
        assert "stop" not in flat(report(next_action=plan, **told)).lower()


TESTS = (
    SevereTest(action=np.array([3.0]), is_permitted=True, difference=1.234),
    SevereTest(action=np.array([4.5]), is_permitted=False, difference=56.7),
)


def test_a_named_verdict_is_followed_by_what_it_is_conditional_on():
    first = first_paragraph(report(severe_tests=TESTS))
    assert "P holds among the declared effects alone" in first
    assert (
        "No other action was tried than these 8: speed from -3 to 3 m/s. The verdict "
        "would be put to the test most at speed = 3 m/s, where its prediction and that "
        "of a free residual differ by 1.23 of its standard deviations, and beyond the "
        "permitted range at speed = 4.5 m/s, by 56.7."
    ) in first
    for verdict in ("none", "unexplained", "scatter"):
        other = first_paragraph(report(tracing=tracing(verdict)))
        assert "P holds among" not in other
        assert "No other action was tried" not in other


def test_a_report_of_a_right_model_has_no_warnings():
    arguments = {"trials": trials(), "residuals": residuals(), "tracing": tracing()}
    assert find_warnings(**arguments) == ()
    assert "Warnings" not in str(report())

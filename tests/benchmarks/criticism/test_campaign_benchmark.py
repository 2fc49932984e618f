"""The campaign that starts on the wrong simulator, in small."""

import math

import pytest
import torch

from benchmarks.criticism.campaign import (
    COLUMNS,
    draw_truth,
    non_centrality,
    run_case,
    summary,
)


def test_the_truth_is_drawn_and_clean_is_clean():
    theta, strength = draw_truth("hidden", 1)
    assert theta.shape == (1, 2)
    assert bool((theta.abs() <= 5).all())
    assert strength != 0
    assert draw_truth("clean", 1)[1] == 0
    strengths = torch.tensor([draw_truth("hidden", i)[1] for i in range(200)])
    assert abs(float(strengths.std()) - 1) < 4 / math.sqrt(400)


def test_two_settings_hide_what_a_third_and_the_prior_show():
    theta = torch.tensor([[1.0, -1.0]])
    two = torch.tensor([[-5.0], [5.0], [5.0], [-5.0]]).double()
    assert non_centrality(two, theta, 0.5) < 1e-6
    three = torch.cat([two, torch.tensor([[-2.5]]).double()])
    assert non_centrality(three, theta, 0.5) > 25
    # theta_2 would have to leave its box.
    assert non_centrality(two, torch.tensor([[1.0, 4.0]]), 2.0) > 25


def test_the_summary_counts():
    blank = dict.fromkeys(COLUMNS, "")
    hidden = blank | {
        **{"case": "0", "kind": "hidden", "lambda": "60", "alarm_at": "4"},
        **{"mass_before": "1", "log_p_before": "-16", "adopted": "quadratic"},
        **{"mass_after": "0.4", "log_p_after": "5"},
    }
    missed = hidden | {"alarm_at": "", "adopted": "", "mass_after": ""}
    clean = blank | {"kind": "clean", "lambda": "0", "mass_before": "0.5"}
    text = "\n".join(summary([hidden, missed, clean]))
    assert "false alarms 0.000 (0/1)" in text
    assert "alarm within 6 trials, lambda > 25 0.500 (1/2)" in text
    assert "theta_true in the 90 % region after adoption 1.000 (1/1)" in text


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 3])
def test_a_wrong_simulator_is_noticed_and_the_truth_recovered(number):
    row = run_case("hidden", number)
    assert row["alarm_at"]
    assert float(row["mass_before"]) > 0.99  # the belief excludes theta_true
    assert row["adopted"] == "quadratic"
    assert float(row["mass_after"]) < 0.99
    assert float(row["log_p_after"]) > float(row["log_p_before"]) + 5
    # Within a nat of the posterior of the right model, in closed form.
    assert abs(float(row["log_p_after"]) - float(row["log_p_exact"])) < 1
    assert row["health_after"] == "ok"


@pytest.mark.slow
def test_a_right_simulator_is_left_alone():
    row = run_case("clean", 0)
    assert row["alarm_at"] == ""
    assert "adopted" not in row

"""The campaign that starts on the wrong simulator, in small."""

import torch

from benchmarks.criticism.campaign import (
    COLUMNS,
    non_centrality,
    summary,
)


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

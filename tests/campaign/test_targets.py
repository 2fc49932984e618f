"""What a campaign's next trial is for, and when it stops."""

from dataclasses import replace

import torch

from sbi_active import Campaign, StopRules
from tests.campaign.learning.test_revision import (
    ACTIONS,
    BIAS,
    MODEL,
    OPTIONS,
    PRIOR,
    tell,
)


def campaign(effects=(BIAS,), method="asbi", **changes):
    return Campaign(
        MODEL,
        PRIOR,
        ACTIONS,
        method=method,
        effects=effects,
        options=replace(OPTIONS, **changes),
    )


def test_with_effects_a_trial_is_for_what_it_tells_more_about():
    c = campaign()
    c.tell([1.0], action=[2.0])
    c.tell([1.0], action=[2.0])
    # A slope and a bias explain two like trials; more of the same halves neither.
    trial = c.ask()
    assert trial.target == "model"
    assert float(trial.action) < 0  # the far side of the slope
    assert trial.design.estimator == "ModelIndexGain"
    assert "bias" in trial.design.notes[0]
    assert trial.num_simulations >= trial.design.num_simulations > 0
    assert "criticism" in trial.seconds


def test_where_nothing_is_open_the_trial_is_for_the_parameters():
    c = campaign()
    # Twelve clean trials on both sides: no bias that would matter.
    tell(c, shift=0.0, actions=(2.0, -2.0) * 6)
    assert c.health == "ok"
    assert c.ask().target == "theta"


def run(c, slope=0.5, shift=0.0, num_rounds=6):
    gen = torch.Generator().manual_seed(1)

    def real_system(action):
        return slope * action + shift + 0.1 * torch.randn(1, generator=gen)

    c.run(real_system, num_rounds=num_rounds)
    return c


def test_a_run_stops_once_little_is_left_to_learn():
    c = run(campaign(effects=(), stop=StopRules(min_information_gain=0.5)))
    assert 1 <= len(c.history) < 6
    assert c.pending is not None
    assert c.stop_reason.startswith("the next trial is expected to tell")
    assert "less than 0.5" in c.stop_reason


def test_a_run_stops_once_the_parameters_are_known():
    # One trial at the largest action leaves a deviation of .1 / 2.
    c = run(campaign(effects=(), stop=StopRules(max_sd=0.08)))
    assert len(c.history) == 1
    assert c.pending is None
    assert c.stop_reason.startswith("the parameters' standard deviations are 0.0")


def test_an_alarm_switches_the_stop_rules_off():
    stop = StopRules(max_sd=0.5, min_information_gain=0.5)
    c = campaign(effects=(), method="nsbi", stop=stop)
    tell(c, shift=0.8, actions=(2.0, -2.0))
    c.update()
    assert c.health == "alarm"
    assert float(c.belief.stddev) < 0.5  # as wide as trials scatter, and within
    assert c.stop_reason is None
    num_told = len(c.history)
    run(c, shift=0.8, num_rounds=2)
    assert len(c.history) == num_told + 2

"""What the residual follows where no declared effect helps."""

import pytest
import torch

from sbi_active import SimulatorModel
from sbi_active.criticism import Criticism, Trials
from sbi_active.simulation import GaussianNoise
from tests.criticism.misfit.oscillator import (
    EFFECTS,
    MODEL,
    PRIOR,
    SENSOR,
    TIMES,
    trials,
)

FEW = [e for e in EFFECTS if e.name in ("friction", "bias")]


def loop(own):
    return Criticism(MODEL, PRIOR, own, effects=FEW, seed=0)


def slope(x):
    return torch.gradient(x, spacing=0.2, dim=1)[0]


@pytest.mark.parametrize(
    ("change", "hidden", "formula"),
    [(lambda x: 0.15 * x**2, 0.05, "x^2"), (lambda x: -0.1 * slope(x), 0.3, "x'")],
)
def test_what_the_sensor_does_is_guessed(change, hidden, formula):
    own = trials(hidden=hidden)
    own.x += change(own.x)
    found = loop(own)
    tracing = found.trace()
    assert tracing.misfit is not None
    assert tracing.chosen == ()
    name, gain = tracing.guesses[0]
    assert name == formula
    assert gain > 5
    report = found.report(evaluate=False)
    assert report.guess == formula
    text = " ".join(str(report).split())
    assert f"no declared effect helps, a guess, not declared: {formula}" in text
    assert f"What it leaves follows {formula}, with x the output" in text


def test_a_force_that_no_formula_of_the_output_is_has_no_guess():
    assert loop(trials(hidden=0.6)).trace().guesses == ()


def test_where_an_effect_helps_nothing_is_guessed():
    tracing = loop(trials(friction=0.3, hidden=0.3)).trace()
    assert tracing.misfit is not None
    assert "friction" in tracing.chosen
    assert tracing.guesses == ()


def test_a_guess_says_in_which_channel():
    def both(theta, action):
        x = MODEL.fn(theta, action)
        return torch.stack([x, 100 * x], -1)

    model = SimulatorModel(
        both, noise=GaussianNoise([SENSOR, 100 * SENSOR]), sample_times=TIMES
    )
    own = trials()
    gen = torch.Generator().manual_seed(1)
    noise = SENSOR * torch.randn(own.x.shape, generator=gen, dtype=torch.float64)
    other = 100 * (own.x + 0.15 * own.x**2 + noise)
    x = torch.stack([own.x, other], -1)
    labels = ["place [m]", "force [N]"]
    pair = Trials(own.action, x, sample_times=TIMES, channel_labels=labels)
    found = Criticism(model, PRIOR, pair, seed=0)
    assert found.trace().misfit is not None
    assert found.trace().guesses[0][0] == "x^2 in force"

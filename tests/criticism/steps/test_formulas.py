"""Formula effects: what they add, how large they may be, and which are left out."""

import numpy as np
import pytest
import torch

from sbi_active.criticism import Trials
from sbi_active.criticism.evidence import RivalSet
from sbi_active.criticism.steps.formulas import MARGIN, formula_effects, guess
from tests.criticism.steps.linear_world import ACTION, measured, rivals


def named(some):
    return {effect.name: effect for effect in formula_effects(some)}


def test_formulas_add_their_term_to_the_output():
    effects = named(rivals(measured()))
    x, phi = torch.ones(12, 1), torch.full((12, 1), 2.0)
    for name, expected in {
        "1": 1 + 2 * torch.ones(12, 1),
        "xi^2": 1 + 2 * ACTION**2,
        "|xi|^1.5": 1 + 2 * ACTION.abs() ** 1.5,
        "sin(x)": 1 + 2 * torch.sin(x),
    }.items():
        assert torch.allclose(effects[name].apply(x, phi, ACTION, None), expected)


def test_coefficients_give_every_term_the_same_size():
    some = rivals(measured())
    amplitude = np.median(np.sqrt(some.noise.typical_sd * some.spread))
    effects = named(some)
    for name, term in {
        "xi": ACTION,
        "xi^3": ACTION**3,
        "cos(xi)": ACTION.cos(),
    }.items():
        scale = float(effects[name].prior.base_dist.scale)
        assert scale * float(term.square().mean().sqrt()) == pytest.approx(
            amplitude, rel=1e-5
        )


def test_a_formula_that_is_a_simpler_one_on_these_trials_is_left_out():
    some = rivals(measured())
    assert "1" in named(some)
    assert {"xi", "sign(xi)", "step(xi)"} <= {*named(some)}
    # Where all actions are positive, |xi| is xi and step(xi) is 1.
    forward = RivalSet(some.model, some.prior, Trials(ACTION + 3, measured()), [])
    assert not {"|xi|", "relu(xi)", "step(xi)", "sign(xi)"} & {*named(forward)}


def test_a_guess_is_the_term_that_is_missing():
    formulas = guess(rivals(measured(further=0.8 * ACTION**3)))
    assert formulas[0][0] == "xi^3"
    gains = [gain for _, gain in formulas]
    assert min(gains) > MARGIN

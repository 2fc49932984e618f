"""Designs on simulators whose outcomes are invalid or missing."""

import os
import time

import pytest
import torch

from sbi_active import DiscreteActions, InformationGainDesigner, RandomDesigner
from sbi_active.seeding import row_normals
from sbi_active.simulation import MissingRowsWarning, Workers
from tests.design.test_designer import ACTIONS, VALUES
from tests.linear_gaussian import PRIOR, ExactModel, simulator


def test_invalid_outcomes_count():
    def fails_for_large_actions(theta, action):
        x = simulator(theta, action)
        return torch.where(action > 1.5, torch.nan, x)

    class Model(ExactModel):
        def log_posterior(self, theta, x, action):
            log_q = super().log_posterior(theta, x, action)
            return torch.where(x.isnan().any(1), PRIOR.log_prob(theta), log_q)

    designer = InformationGainDesigner(ACTIONS, num_samples=500, estimator="posterior")
    design = designer.select(Model(), fails_for_large_actions, seed=0)
    assert design.probability_valid.tolist() == [1.0, 1.0, 1.0, 0.0]
    assert design.action.tolist() == [1.0]


def falls_off(theta, action):
    """A measurement with a probability that falls with the push; some are partial."""
    x = simulator(theta, action)
    x[torch.rand(len(x)) < 0.5, 1] = torch.nan  # partly observed: a measurement
    lost = torch.rand(len(x), 1) < 0.3 * action
    return x.masked_fill(lost, torch.nan)


def test_a_measurement_that_is_too_improbable_excludes_an_action():
    designer = InformationGainDesigner(
        ACTIONS, num_samples=2_000, estimator="posterior"
    )

    class Model(ExactModel):
        def log_posterior(self, theta, x, action):
            known = x.isfinite()
            log_q = super().log_posterior(theta, x.nan_to_num(), action)
            return torch.where(known.all(1), log_q, PRIOR.log_prob(theta))

    free = designer.select(Model(), falls_off, seed=0)
    exact = 1 - 0.3 * VALUES
    error = (exact * (1 - exact) / free.num_samples).sqrt()
    assert ((free.probability_valid - exact).abs() <= 4 * error).all()
    safe = designer.select(Model(), falls_off, min_probability_valid=0.6, seed=0)
    assert free.action.tolist() == [2.0]  # negative control
    assert safe.action.tolist() == [1.0]
    assert safe.probability_best[3] == 0
    assert safe.probability_best.sum() == pytest.approx(1.0)
    assert safe.expected_information_gain.isfinite().all()
    (note,) = safe.notes
    assert note.startswith("1 of 4 candidates excluded: a measurement is less probable")
    only_hard = InformationGainDesigner(
        DiscreteActions([1.5, 2.0]), num_samples=400, estimator="posterior"
    )
    with pytest.raises(ValueError, match=r"at least 0.9; got 0\.5\d* at most"):
        only_hard.select(Model(), falls_off, min_probability_valid=0.9, seed=0)


def test_a_random_choice_can_avoid_actions_that_fail():
    designer = RandomDesigner(ACTIONS)

    def select(seed):
        return designer.select(
            None, falls_off, belief=PRIOR, min_probability_valid=0.6, seed=seed
        )

    designs = [select(seed) for seed in range(40)]
    chosen = {float(design.action) for design in designs}
    assert chosen == {0.0, 0.5, 1.0}
    exact = 1 - 0.3 * VALUES
    distance = (designs[0].probability_valid - exact).abs()
    assert (distance <= 4 * (exact * (1 - exact) / 200).sqrt()).all()
    assert designs[0].num_simulations == 800
    with pytest.raises(ValueError, match="got no simulator"):
        designer.select(belief=PRIOR, min_probability_valid=0.5)
    with pytest.raises(ValueError, match="got no belief"):
        designer.select(None, falls_off, min_probability_valid=0.5)


class Hanging:
    """Hangs on one row in 50, and ends its process on another."""

    def __call__(self, theta, action, seeds):
        if bool((seeds % 50 == 0).any()):
            time.sleep(60)
        if bool((seeds % 50 == 1).any()):
            os._exit(1)
        return theta * action + row_normals(seeds, 1)


@pytest.mark.slow
def test_a_simulator_that_hangs_or_dies_costs_rows_and_one_warning():
    designer = InformationGainDesigner(
        DiscreteActions([0.1, 4.0]),
        num_samples=200,
        workers=Workers(num_workers=2, time_limit=0.05),
    )
    belief = torch.distributions.MultivariateNormal(torch.zeros(1), torch.eye(1))
    with pytest.warns(MissingRowsWarning, match="of the design are missing") as caught:
        design = designer.select(None, Hanging(), belief=belief, seed=0)
    assert len([w for w in caught if w.category is MissingRowsWarning]) == 1
    assert design.action.tolist() == [4.0]
    error = (0.04 / design.num_simulations) ** 0.5
    assert abs(design.num_missing / design.num_simulations - 0.04) < 3 * error


def test_missing_rows_are_counted_and_warned_of_once():
    def raises(theta, action, seeds):
        if bool((seeds % 25 == 0).any()):
            raise RuntimeError("licence server")
        return theta * action + row_normals(seeds, 1)

    actions = DiscreteActions([0.1, 4.0])
    belief = torch.distributions.MultivariateNormal(torch.zeros(1), torch.eye(1))
    for designer, options in (
        (InformationGainDesigner(actions, num_samples=400), {}),
        (RandomDesigner(actions, num_samples=400), {"min_probability_valid": 0.5}),
    ):
        with pytest.warns(MissingRowsWarning, match="of the design are miss") as caught:
            design = designer.select(None, raises, belief=belief, seed=0, **options)
        assert len([w for w in caught if w.category is MissingRowsWarning]) == 1
        error = (0.04 / design.num_simulations) ** 0.5
        assert abs(design.num_missing / design.num_simulations - 0.04) < 3 * error

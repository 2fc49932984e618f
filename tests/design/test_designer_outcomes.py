"""Designs on simulators whose outcomes are invalid or missing."""

import warnings

import pytest
import torch

from sbi_active import (
    DiscreteActions,
    GaussianNoise,
    InformationGainDesigner,
    SimulatorModel,
)
from sbi_active.seeding import row_normals
from sbi_active.simulation import MissingRowsWarning
from tests.design.test_designer import ACTIONS, VALUES
from tests.linear_gaussian import PRIOR, ExactModel, simulator


def falls_off(theta, action):
    """A measurement with a probability that falls with the push; some are partial."""
    x = simulator(theta, action)
    x[torch.rand(len(x)) < 0.5, 1] = torch.nan  # partly observed: a measurement
    lost = torch.rand(len(x), 1) < 0.3 * action
    return x.masked_fill(lost, torch.nan)


def test_a_measurement_that_is_too_improbable_excludes_an_action():
    sizes = {"num_samples": 2_000, "estimator": "posterior"}
    designer = InformationGainDesigner(ACTIONS, **sizes)

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
    only_hard = InformationGainDesigner(DiscreteActions([1.5, 2.0]), **sizes)
    with pytest.raises(ValueError, match=r"at least 0.9; got 0\.5\d* at most"):
        only_hard.select(Model(), falls_off, min_probability_valid=0.9, seed=0)


def test_missing_rows_are_counted_and_warned_of_once():
    def raises(theta, action, seeds):
        if bool((seeds % 25 == 0).any()):
            raise RuntimeError("licence server")
        return theta * action + row_normals(seeds, 1)

    actions = DiscreteActions([0.1, 4.0])
    belief = torch.distributions.MultivariateNormal(torch.zeros(1), torch.eye(1))
    designer = InformationGainDesigner(actions, num_samples=400)
    with pytest.warns(MissingRowsWarning, match="of the design are miss") as caught:
        design = designer.select(None, raises, belief=belief, seed=0)
    assert len([w for w in caught if w.category is MissingRowsWarning]) == 1
    error = (0.04 / design.num_simulations) ** 0.5
    assert abs(design.num_missing / design.num_simulations - 0.04) < 3 * error


@pytest.mark.parametrize("declared", [True, False])
def test_a_rare_fault_stops_no_design(declared):
    """Rows were lost in one draw and not in the next, or all that were run again."""

    def fails(theta, action):
        if bool((theta > 2.5).any()):
            raise RuntimeError("diverged")
        return theta * action

    def noisy(theta, action):
        return fails(theta, action) + torch.randn_like(theta)

    model = SimulatorModel(fails, noise=GaussianNoise(1.0)) if declared else noisy
    belief = torch.distributions.MultivariateNormal(torch.zeros(1), torch.eye(1))
    designer = InformationGainDesigner(DiscreteActions([1.0, 1.1]), num_samples=400)
    lost = []
    for seed in range(3):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MissingRowsWarning)
            design = designer.select(None, model, belief=belief, seed=seed)
        assert design.probability_valid.tolist() == [1.0, 1.0]
        lost.append(design.num_missing)
    assert 0 < max(lost) < 60

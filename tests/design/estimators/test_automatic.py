"""The estimator that is chosen by checks, and what is said of its estimate."""

import math

import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import InformationGainDesigner, SimulatorModel
from sbi_active.design import LikelihoodGain, LinearGain, PosteriorGain, RatioGain
from sbi_active.design.estimators.automatic import choose_estimator, find_estimator
from sbi_active.design.estimators.base import CandidateSimulations
from sbi_active.design.estimators.contrast import InfoNCEGain
from sbi_active.simulation import GaussianNoise
from tests.linear_gaussian import (
    PRIOR,
    ExactLikelihood,
    ExactLikelihoodAndPosterior,
    ExactRatio,
    candidates,
    information,
)

NEAR, FAR = torch.tensor([[0.5], [1.0]]), torch.tensor([[0.5], [40.0]])  # 7.4 nats


def heavy(mean):
    return torch.distributions.StudentT(3.0).sample(mean.shape)


def unusable(actions=NEAR):
    """Noise from heavy-tailed pairs, which fails the test of normality."""
    return candidates(actions, 512, noise=heavy, pairs=True)


#: Models, and the estimator by what they can say.
SAYING = [
    (ExactLikelihoodAndPosterior(), PosteriorGain),
    (ExactLikelihood(), LikelihoodGain),
    (ExactRatio(), InfoNCEGain),
    (None, "EntropyGain"),
]


@pytest.mark.parametrize(("model", "estimator"), SAYING)
def test_what_the_model_can_say_is_used_where_the_noise_cannot(model, estimator):
    chosen, notes = choose_estimator(model, unusable(), PRIOR)
    assert "noise is not Gaussian" in notes[0]
    if model is None:
        assert notes[-1] == "used all the same: there is no model"
        estimator = type(
            choose_estimator(None, candidates(NEAR, 512, pairs=True), PRIOR)[0]
        )
    assert type(chosen) is estimator


@pytest.mark.parametrize(
    ("dim", "n", "bend", "linear"),
    [(14, 200, 0, True), (14, 200, 3, False), (14, 16, 0, False), (3, 200, 0, False)],
)
def test_many_parameters_that_outcomes_are_linear_in_have_the_linear_estimate(
    dim, n, bend, linear
):
    torch.manual_seed(0)
    theta, slope = torch.rand(n, dim).double(), 9 * torch.rand(dim, 2).double()
    mean = (theta @ slope + bend * torch.sin(theta @ slope))[None]
    x = mean + torch.randn(mean.shape)
    none, noise = torch.zeros(1, 1), GaussianNoise(1.0)
    given = CandidateSimulations(theta.float(), none, x, mean, noise)
    chosen, _ = choose_estimator(ExactLikelihood(), given, None)
    assert (type(chosen) is LinearGain) == linear


def test_a_ratio_beyond_the_reach_of_info_nce_is_averaged():
    chosen, notes = choose_estimator(ExactRatio(), unusable(FAR), PRIOR)
    assert type(chosen) is RatioGain
    assert "not used: InfoNCEGain is near its largest value, log K = 4.9" in notes[-1]
    assert "at 1 of 2 actions" in notes[-1]


#: Estimators, and what is said of their estimate.
LIMITED = [
    (InfoNCEGain(num_contrastive=63), "near its largest value, log K = 4.2"),
    (LikelihoodGain(num_contrastive=64), "near log L = 4.2 nats or above"),
]


@pytest.mark.parametrize(("estimator", "text"), LIMITED)
def test_an_estimate_near_its_limit_is_said_to_be(estimator, text):
    model = ExactLikelihood()
    far, near = candidates(FAR, 512), candidates(NEAR, 512)
    gain = estimator(model, far, PRIOR)
    notes = estimator.cautions(gain)
    assert len(notes) == 1
    assert text in notes[0]
    assert "at 1 of 2 actions" in notes[0]
    # the estimate is indeed off by more than its error where it is warned of
    wrong = (gain.mean(1) - information(FAR)).abs()
    assert float(wrong[1]) > 0.5
    assert float(wrong[0]) < 0.2
    assert estimator.cautions(estimator(model, near, PRIOR)) == []


def test_a_ratio_whose_normalization_is_off_is_noticed():
    simulations = candidates(NEAR, 512)
    for offset, expected in ((0.0, 0), (1.0, 1)):
        given = ExactRatio(offset=offset), simulations, PRIOR
        notes = RatioGain().compared(*given, RatioGain()(*given))
        assert len(notes) == expected
    assert notes[0].startswith("InfoNCEGain is ")
    assert "nats below" in notes[0]


#: Former names, names, and estimators.
FORMER = [
    ("variational_nested", "likelihood", LikelihoodGain),
    ("contrastive", "info_nce", InfoNCEGain),
]


@pytest.mark.parametrize(("former", "name", "kind"), FORMER)
def test_a_former_name_is_taken_for_one_version(former, name, kind):
    with pytest.warns(DeprecationWarning, match=f'use estimator="{name}"'):
        assert type(find_estimator(former)) is kind


def on_steps(num, dim):
    """Return a design where each parameter is known by the step that it is on."""
    prior = BoxUniform(torch.zeros(dim), torch.ones(dim))
    noise = GaussianNoise(0.05)
    stairs = SimulatorModel(lambda theta, action: (num * theta).floor(), noise=noise)
    designer = InformationGainDesigner([0.0, 1.0], num_samples=750)
    return designer.select(None, stairs, belief=prior, seed=0)


def test_outcomes_on_a_hundred_steps_are_left_to_nested_monte_carlo() -> None:
    """Nearest neighbors were .8 nat too high: what is between steps counted."""
    design = on_steps(100, 1)
    assert design.estimator == "NestedGain"
    assert "on steps" in design.notes[0]
    gain = design.expected_information_gain
    assert float((gain - math.log(100)).abs().max()) < 0.3


def test_flat_steps_have_no_slopes_that_correct_a_gain() -> None:
    """Of sixteen steps it was .5 nat too low; of nine hundred it says that it errs."""
    gain = on_steps(4, 2).expected_information_gain
    assert float((gain - math.log(16)).abs().max()) < 0.1
    assert "on steps" in on_steps(30, 2).notes[0]

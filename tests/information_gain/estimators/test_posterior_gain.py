from dataclasses import replace

import pytest
import torch

from sbi_active.information_gain import CandidateSimulations, PosteriorGain
from tests.linear_gaussian import PRIOR, ExactModel, information, simulator


def simulations(actions=(0.0, 1.0, 2.0), n=4_000, seed=0):
    generator = torch.Generator().manual_seed(seed)
    theta = torch.randn(n, 2, generator=generator)
    action = torch.tensor(actions)[:, None]
    x = torch.stack([simulator(theta, a.expand(n, 1)) for a in action])
    return CandidateSimulations(theta, action, x)


def test_shape_and_rows():
    rows = simulations(n=5)
    gain = PosteriorGain()(ExactModel(), rows, PRIOR)
    assert gain.shape == (3, 5)
    assert gain.dtype == torch.float64
    theta, action = rows.rows()
    assert theta.shape == (15, 2)
    assert (action[5:10] == 1).all()
    assert torch.equal(theta[5:10], rows.theta)


def test_outcomes_at_the_same_parameters_are_averaged():
    rows, other = simulations(n=400), simulations(n=400, seed=1)
    pairs = replace(rows, replicate=other.x)
    again = PosteriorGain()(ExactModel(), replace(rows, x=other.x), PRIOR)
    gain = PosteriorGain()(ExactModel(), rows, PRIOR)
    mean = PosteriorGain()(ExactModel(), pairs, PRIOR)
    assert torch.allclose(mean, (gain + again) / 2)


def test_the_exact_posterior_gives_the_information():
    rows = simulations()
    gain = PosteriorGain()(ExactModel(), rows, PRIOR)
    error = gain.std(1) / gain.shape[1] ** 0.5
    distance = (gain.mean(1) - information(rows.action)).abs()
    assert (distance <= 4 * error + 1e-6).all()


def test_batches_do_not_matter():
    rows = simulations(n=100)
    whole = PosteriorGain()(ExactModel(), rows, PRIOR)
    assert torch.allclose(PosteriorGain(batch_size=7)(ExactModel(), rows, PRIOR), whole)


def test_permuting_candidates_permutes_the_gain():
    rows = simulations(n=50)
    order = torch.tensor([2, 0, 1])
    permuted = CandidateSimulations(rows.theta, rows.action[order], rows.x[order])
    gain = PosteriorGain()(ExactModel(), rows, PRIOR)
    assert torch.allclose(PosteriorGain()(ExactModel(), permuted, PRIOR), gain[order])


def test_a_model_of_the_wrong_spread_loses_what_the_divergence_says():
    """E U = I - KL(N(m, s) || N(m, (k s)^2)) in each of two dimensions."""
    rows = simulations()
    spread = torch.tensor(2.0)
    gain = PosteriorGain()(ExactModel(spread=2.0), rows, PRIOR)
    loss = 2 * (spread.log() + 0.5 / spread**2 - 0.5)
    error = gain.std(1) / gain.shape[1] ** 0.5
    distance = (gain.mean(1) - (information(rows.action) - loss)).abs()
    assert (distance < 4 * error).all()


def test_wrong_shape():
    rows = simulations(n=5)
    wrong = CandidateSimulations(rows.theta[:4], rows.action, rows.x)
    with pytest.raises(ValueError, match=r"expected x of shape \(3, 4, \*x_shape\)"):
        PosteriorGain()(ExactModel(), wrong, PRIOR)

"""Information of outcomes of many numbers, against the exact one of linear models."""

import pytest
import torch
from torch.distributions import MultivariateNormal

from sbi_active import GaussianNoise
from sbi_active.design import LinearGain
from sbi_active.design.estimators.base import CandidateSimulations
from sbi_active.simulation import AutocorrelatedNoise

DIM, NUM = 3, 200
TIMES = torch.linspace(0, 2, NUM, dtype=torch.float64)
BELIEF = MultivariateNormal(
    torch.tensor([1.0, -2.0, 0.5]),
    torch.tensor([[1.0, 0.4, 0.0], [0.4, 0.5, 0.1], [0.0, 0.1, 2.0]]),
)


INVERSE = torch.eye(NUM).double() / 0.01  # of the covariance of white noise


def jacobian(a):
    return torch.stack([a * torch.sin(a * TIMES), a * TIMES, a * torch.ones(NUM)], 1)


def simulations(mean, noise, theta, action):
    x = noise.sample(mean.flatten(0, 1)).reshape(mean.shape)
    return CandidateSimulations(theta, action, x, mean, noise)


def linear_case(noise):
    torch.manual_seed(0)
    theta, action = BELIEF.sample((200,)), torch.tensor([[0.5], [3.0]])
    mean = torch.stack([theta.double() @ jacobian(float(a)).T for a in action])
    return simulations(mean, noise, theta, action)


def exact(a, inverse):
    j = jacobian(a)
    information = j.T @ inverse @ j @ BELIEF.covariance_matrix.double()
    return 0.5 * float(torch.logdet(torch.eye(DIM).double() + information))


LASTING = AutocorrelatedNoise(0.1, correlation_time=0.3).at(TIMES)
LASTING_INVERSE = (0.01 * torch.exp(-(TIMES[:, None] - TIMES).abs() / 0.3)).inverse()


@pytest.mark.parametrize(
    ("noise", "inverse"), [(GaussianNoise(0.1), INVERSE), (LASTING, LASTING_INVERSE)]
)
def test_it_is_exact_where_outcomes_are_linear(noise, inverse):
    gain = LinearGain()(None, linear_case(noise), BELIEF)
    for k, a in enumerate((0.5, 3.0)):
        error = gain[k].std() / len(gain[k]) ** 0.5
        assert error < 0.3
        assert float(gain[k].mean()) == pytest.approx(exact(a, inverse), abs=0.3)


def test_few_simulations_are_unbiased():
    """Without the jackknife 24 simulations of three parameters lose .25 nat."""
    noise, found = GaussianNoise(0.1), []
    for seed in range(15):
        torch.manual_seed(seed)
        theta = BELIEF.sample((24,))
        mean = (theta.double() @ jacobian(3.0).T)[None]
        case = simulations(mean, noise, theta, torch.tensor([[3.0]]))
        found.append(float(LinearGain()(None, case, BELIEF).mean()))
    mean = sum(found) / len(found)
    sd = torch.tensor(found).std() / len(found) ** 0.5
    assert abs(mean - exact(3.0, INVERSE)) < 3 * float(sd) + 0.05


def test_what_is_bent_counts_as_noise():
    torch.manual_seed(0)
    theta = BELIEF.sample((400,))
    straight = theta.double() @ jacobian(3.0).T
    bent = straight + 0.5 * theta[:, :1].double() ** 2 * torch.cos(5 * TIMES)
    action = torch.tensor([[0.0], [1.0]])
    case = simulations(torch.stack([straight, bent]), GaussianNoise(0.1), theta, action)
    gain = LinearGain()(None, case, BELIEF).mean(1)
    assert 0 < float(gain[1]) < float(gain[0])
    (note,) = LinearGain().remarks(case)
    assert "noise deviations off what is linear" in note


def test_of_some_parameters_it_is_exact_with_the_others_as_nuisances():
    """I(theta_S; x) = (log |S| - log |S after|) / 2 by the covariances of theta_S."""
    case = linear_case(GaussianNoise(0.1))
    gain = LinearGain(lambda t: t[:, [0, 2]])(None, case, BELIEF)
    prior = BELIEF.covariance_matrix.double()
    for k, a in enumerate((0.5, 3.0)):
        j = jacobian(a)
        after = (prior.inverse() + j.T @ j / 0.01).inverse()
        own = [torch.logdet(c[[0, 2]][:, [0, 2]]) for c in (prior, after)]
        wanted = 0.5 * float(own[0] - own[1])
        assert float(gain[k].mean()) == pytest.approx(wanted, abs=0.3)
